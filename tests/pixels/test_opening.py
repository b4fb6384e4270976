"""Maps are opened where they are whole, and refused in one line where they are not."""

from pathlib import Path

import numpy as np
import pytest
from synthetic_maps import make_maps

import polar_bayes as pb


def test_what_was_written_is_read_when_it_is_needed(tmp_path: Path) -> None:
    maps = make_maps({"roughness": np.full((4, 5), 0.3)})
    maps.to_zarr(tmp_path / "map.zarr", consolidated=False)
    found = pb.open_map(tmp_path / "map.zarr")
    assert not found.chunks
    assert pb.count_pixels(found)["good"] == 20
    assert found.attrs == maps.attrs


def test_what_is_no_whole_map_is_refused(tmp_path: Path) -> None:
    store = tmp_path / "map.zarr"
    with pytest.raises(pb.FitError, match="there is no such store"):
        pb.open_map(store)
    store.mkdir()
    with pytest.raises(pb.FitError, match="cannot be read as Zarr"):
        pb.open_map(store)
    begun = tmp_path / "begun.zarr"
    maps = make_maps({"roughness": np.ones((1, 1))}).assign_attrs(request_sha256="0")
    maps.to_zarr(begun, consolidated=False)
    with pytest.raises(pb.FitError, match="not finished; wait, or go on with"):
        pb.open_map(begun)
    other = tmp_path / "other.zarr"
    make_maps({"roughness": np.ones((1, 1))}).drop_vars("status").to_zarr(other, consolidated=False)
    with pytest.raises(pb.FitError, match="it holds no maps"):
        pb.open_map(other)


def test_a_capture_may_be_a_zarr_store_or_a_file(tmp_path: Path) -> None:
    with pytest.raises(pb.CaptureError, match="there is no such store"):
        pb.open_capture(str(tmp_path / "leaf.zarr"))
    with pytest.raises(pb.CaptureError, match="there is no such file"):
        pb.open_capture(str(tmp_path / "leaf.nc"))
