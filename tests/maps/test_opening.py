"""Maps are opened where they are whole, and refused in one line where they are not."""

import json
import pickle
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from cases import each
from plate_images import ASKED, plate_image
from synthetic_maps import make_maps
from zarr.codecs import Crc32cCodec, ZstdCodec

import polar_bayes as pb
from polar_bayes.inference.batching import Status


def test_what_is_no_whole_map_is_refused(tmp_path: Path) -> None:
    store, maps = tmp_path / "map.zarr", make_maps({"roughness": np.full((4, 5), 0.3)})
    (tmp_path / "empty.zarr").mkdir()
    maps.assign_attrs(request_sha256="0").to_zarr(tmp_path / "begun.zarr", consolidated=False)
    maps.drop_vars("status").to_zarr(tmp_path / "other.zarr", consolidated=False)
    for name, what in (
        ("map", "there is no such store"),
        ("empty", "cannot be read as Zarr"),
        ("begun", "not finished; wait, or go on with"),
        ("other", "it holds no maps"),
    ):
        with pytest.raises(pb.FitError, match=what):
            pb.maps.open_map(tmp_path / f"{name}.zarr")
    maps.to_zarr(store, consolidated=False)
    found = pb.maps.open_map(store)
    assert not found.chunks
    assert pb.maps.count_pixels(found)["good"] == 20
    assert found.attrs == maps.attrs


def test_a_capture_may_be_a_zarr_store_or_a_file(tmp_path: Path) -> None:
    with pytest.raises(pb.CaptureError, match="there is no such store"):
        pb.maps.open_capture(str(tmp_path / "leaf.zarr"))
    with pytest.raises(pb.CaptureError, match="there is no such file"):
        pb.maps.open_capture(str(tmp_path / "leaf.nc"))


@pytest.mark.thorough
def test_a_capture_in_a_store_can_be_cut_into_chunks(tmp_path: Path) -> None:
    image = plate_image(4, 6)
    image.to_zarr(tmp_path / "leaf.zarr", consolidated=False)
    opened = pb.maps.open_capture(tmp_path / "leaf.zarr")
    assert not opened["q"].variable._in_memory
    xr.testing.assert_equal(opened.chunk(y=2).compute(scheduler="threads"), image)
    xr.testing.assert_equal(pickle.loads(pickle.dumps(opened)).load(), image)
    xr.testing.assert_equal(
        opened.isel(y=[3, 0], x=slice(1, None, 2), view=2),
        image.isel(y=[3, 0], x=slice(1, None, 2), view=2),
    )


def test_what_a_user_has_not_written_yet_is_not_good(tmp_path: Path) -> None:
    maps = pb.fit_pixels(plate_image(4, 6).chunk(y=2), **ASKED)
    maps.to_zarr(tmp_path / "map.zarr", consolidated=False, compute=False)
    found = pb.maps.open_map(tmp_path / "map.zarr")
    assert (found["status"] == Status.NOT_FITTED).all()
    counts = pb.maps.count_pixels(found)
    assert {name: count for name, count in counts.items() if count} == {"not fitted": 24}


def changes(store: Path) -> Iterator[str]:
    """Every file of a store cut off, emptied, lost, and with a byte changed; one at a time."""
    for file in sorted(path for path in store.rglob("*") if path.is_file()):
        content = file.read_bytes()
        middle = len(content) // 2
        flipped = content[:middle] + bytes([content[middle] ^ 4]) + content[middle + 1 :]
        for kind, changed in (("cut", content[:middle]), ("empty", b""), ("flipped", flipped)):
            file.write_bytes(changed)
            yield f"{file.relative_to(store)}: {kind}"
        file.unlink()
        yield f"{file.relative_to(store)}: lost"
        file.write_bytes(content)


def test_a_broken_map_is_an_error_of_one_line(tmp_path: Path) -> None:
    store = tmp_path / "map.zarr"
    maps = make_maps({"refractive_index": np.full((4, 3, 2), 1.5)}, wavelengths=(450.0, 650.0))
    maps = maps.assign_attrs(request_sha256="1", capture_sha256="2")
    compressors = {"compressors": (ZstdCodec(), Crc32cCodec())}
    encoding = {name: compressors for name in maps.variables}
    maps.chunk(y=2).to_zarr(store, consolidated=False, encoding=encoding)
    expected = maps.load()
    said: list[str] = []
    for change in changes(store):
        try:
            found = pb.maps.open_map(store).load()
        except pb.FitError as error:
            said.append(str(error))
            continue
        if not change.endswith("lost"):  # else it is counted as not fitted, or good once more
            xr.testing.assert_equal(found, expected)
    assert len(said) > 60
    assert all(each.startswith(str(store)) and "\n" not in each for each in said)


def alter(**fields: object):
    def change(source: Path) -> None:
        metadata = json.loads((source / "q" / "zarr.json").read_text())
        (source / "q" / "zarr.json").write_text(json.dumps(metadata | fields))

    return change


DAMAGE = {
    "a chunk": (
        lambda source: (source / "q" / "c" / "0" / "0" / "0").write_bytes(b"\x28\xb5"),
        r"q\[y=0, x=0:4\]: it cannot be read",
    ),
    "no group": (lambda source: (source / "zarr.json").write_text("{"), "cannot be read as Zarr"),
    "no metadata": (lambda source: (source / "q" / "zarr.json").write_text(""), "cannot be read"),
    "a dtype": (alter(data_type="complex128"), "."),
    "a shape": (alter(shape=[3, -4, 6]), "."),
    "another shape": (alter(shape=[3, 5, 6]), "."),
    "names": (alter(dimension_names=["y", "x", "x"]), "."),
    "no names": (alter(dimension_names=None), "."),
    "codecs": (alter(codecs=[]), "."),
    "attributes": (alter(attributes={"units": ["a", 1]}), "."),
}


@pytest.mark.thorough
@each("damage", DAMAGE)
def test_a_damaged_capture_is_one_line(tmp_path: Path, damage: str) -> None:
    source = tmp_path / "plates.zarr"
    plate_image(3, 4).to_zarr(source, consolidated=False)
    spoil, says = DAMAGE[damage]
    spoil(source)
    with pytest.raises(pb.CaptureError, match=says) as error:
        pb.maps.map_file(source, tmp_path / "map.zarr", **ASKED)
    assert "\n" not in str(error.value)
    assert str(error.value).startswith(str(source))
    assert [path.name for path in tmp_path.iterdir()] == ["plates.zarr"]
