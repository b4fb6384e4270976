"""From file to file: broken off, gone on with, refused."""

import shutil
from pathlib import Path

import pytest
import xarray as xr
from plate_images import ASKED, plate_image

import polar_bayes as pb
from polar_bayes.pixels import store as module
from polar_bayes.pixels.making import make_engine

pytestmark = pytest.mark.usefixtures("compiled_in_haste")
METHOD = pb.PixelLaplace(draws=64, sampler=None)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("image") / "plates.zarr"
    plate_image(9, 20).chunk(y=3, x=20).to_zarr(file, consolidated=False)
    return file


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "BLOCK", 40)


def mapped(capture: Path, out: Path, **asked) -> xr.Dataset:
    return pb.map_file(capture, out, method=METHOD, **{**ASKED, **asked})


class BrokenOff(Exception):  # noqa: N818 - no mistake of a user
    """Stands in for a crash."""


def break_off(capture: Path, out: Path) -> None:
    def progress(done: int, every: int) -> None:
        if done >= 80:
            raise BrokenOff

    with pytest.raises(BrokenOff):
        mapped(capture, out, progress=progress)


def test_a_map_that_was_broken_off_goes_on_to_the_same_bits(capture: Path, tmp_path: Path) -> None:
    whole, part = tmp_path / "whole.zarr", tmp_path / "part.zarr"
    expected = mapped(capture, whole).load()
    assert pb.count_pixels(expected)["good"] + pb.count_pixels(expected)["not trusted"] == 180
    assert sorted(path.name for path in tmp_path.iterdir()) == ["whole.zarr"]
    break_off(capture, part)
    ledger = tmp_path / "part.zarr.progress"
    with ledger.open("a") as file:
        file.write("y=4:6 x=0")  # a line that a crash cut off
    seen: list[int] = []
    found = mapped(capture, part, resume=True, progress=lambda done, every: seen.append(done))
    assert seen[0] > 80
    assert seen[-1] == 180
    assert len(seen) < 5
    xr.testing.assert_identical(found.load(), expected)
    assert not ledger.exists()


def test_the_maps_are_those_that_are_made_in_memory(capture: Path, tmp_path: Path) -> None:
    found = mapped(capture, tmp_path / "map.zarr").load()
    image = xr.open_zarr(capture, consolidated=False).load()
    made = make_engine.cache_info().misses
    xr.testing.assert_equal(found, pb.fit_pixels(image, method=METHOD, **ASKED))
    assert make_engine.cache_info().misses == made  # nothing is compiled a second time


def test_whoever_is_stopped_before_the_store_is_whole_can_go_on(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(*_: object) -> None:
        (tmp_path / "map.zarr").mkdir()
        raise BrokenOff

    with monkeypatch.context() as patched:
        patched.setattr(module, "_write_blank", stop)
        with pytest.raises(BrokenOff):
            mapped(capture, tmp_path / "map.zarr")
    found = mapped(capture, tmp_path / "map.zarr", resume=True)
    assert sum(pb.count_pixels(found).values()) == 180
    with pytest.raises(TypeError, match="unexpected keyword argument 'sceen'"):
        mapped(capture, tmp_path / "other.zarr", sceen="paper")


def test_what_cannot_be_gone_on_with_is_refused(capture: Path, tmp_path: Path) -> None:
    out = tmp_path / "map.zarr"
    break_off(capture, out)
    with pytest.raises(pb.FitError, match="there already; give another --out, or --resume"):
        mapped(capture, out)
    with pytest.raises(pb.FitError, match="begun with another capture or other settings"):
        mapped(capture, out, resume=True, seed=1)
    done = tmp_path / "done.zarr"
    shutil.copytree(out, done)
    with pytest.raises(pb.FitError, match="nothing is left to resume"):
        mapped(capture, done, resume=True)


def test_a_store_with_a_hole_is_refused(capture: Path, tmp_path: Path) -> None:
    broken = tmp_path / "plates.zarr"
    shutil.copytree(capture, broken)
    (broken / "q" / "c" / "1" / "0" / "0").unlink()
    with pytest.raises(pb.CaptureError, match=r"plates\.zarr: q: 1 of 3 chunks are missing"):
        mapped(broken, tmp_path / "map.zarr")
    with pytest.raises(pb.CaptureError, match="there is no such store"):
        mapped(tmp_path / "nowhere.zarr", tmp_path / "map.zarr")
    (broken / "zarr.json").write_text("{")
    with pytest.raises(pb.CaptureError, match="cannot be read as Zarr"):
        mapped(broken, tmp_path / "map.zarr")


def test_a_scheduler_that_does_not_answer_is_one_line(capture: Path, tmp_path: Path) -> None:
    with pytest.raises(pb.FitError, match="no scheduler answers there"):
        mapped(capture, tmp_path / "map.zarr", scheduler="tcp://127.0.0.1:9")
