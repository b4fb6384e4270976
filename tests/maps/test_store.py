"""Maps from file to file; what they share with other stores is in `contracts/test_stores.py`."""

import contextlib
import re
import shutil
import threading
import time
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import dask.array as da
import numpy as np
import pytest
import xarray as xr
from cases import each
from plate_images import ASKED, NAMES, plate_image
from stores import BrokenOff, StoredMap, stored

import polar_bayes as pb
from polar_bayes.inference import compiled_model
from polar_bayes.maps import lazy
from polar_bayes.maps import store as module
from polar_bayes.maps.blocks import BLOCK_THREADS, workers
from polar_bayes.maps.fit_map import MapPlan
from polar_bayes.reporting.report import render

METHOD = pb.methods.CorrectedLaplace(draws=64, sampler=None)


@pytest.fixture(autouse=True, scope="module")
def kind(tmp_path_factory: pytest.TempPathFactory) -> Iterator[StoredMap]:
    with stored("map", tmp_path_factory.mktemp("image")) as found:
        yield found


@pytest.fixture(scope="module")
def capture(kind: StoredMap) -> Path:
    return kind.capture


@pytest.fixture(scope="module")
def finished(kind: StoredMap, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("finished") / "map.zarr"
    kind.run(out)
    return out


@pytest.fixture(scope="module")
def begun(kind: StoredMap, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return kind.break_off(tmp_path_factory.mktemp("begun") / "map.zarr")


def mapped(capture: Path, out: Path, **asked) -> xr.Dataset:
    return pb.maps.map_file(capture, out, **{"method": METHOD, **ASKED, **asked})


def copied(store: Path, to: Path) -> Path:
    return Path(shutil.copytree(store, to))


def journal_of(store: Path) -> Path:
    return store.with_name(f"{store.name}.progress")


@pytest.mark.thorough
def test_a_store_is_begun_without_holding_the_maps_in_memory(tmp_path, monkeypatch):
    tile, side = plate_image(1, 20), 2000
    image = tile[[name for name in tile if "y" not in tile[name].dims]]
    for name in ("q", "q_error"):
        whole = da.broadcast_to(tile[name].to_numpy()[:, :1], (side, side, 6), chunks=(50, 250, -1))
        image[name] = (("y", "x", "view"), whole)
    image.to_zarr(tmp_path / "large.zarr", consolidated=False)
    written: list[int] = []

    def at_the_first_block(block: xr.Dataset, plan: MapPlan) -> xr.Dataset:
        written.append(tracemalloc.get_traced_memory()[1])
        raise BrokenOff

    monkeypatch.setattr(module, "BLOCK", 65536)
    monkeypatch.setattr(module, "fit_block", at_the_first_block)
    monkeypatch.setattr(module, "estimate_plan", lambda plan, image: plan)  # reads 512 pixels
    tracemalloc.start()
    with pytest.raises(BrokenOff):
        mapped(tmp_path / "large.zarr", tmp_path / "map.zarr")
    for thread in threading.enumerate():  # Python crashes where one of them still allocates
        if thread.name.startswith(BLOCK_THREADS):
            thread.join()
    tracemalloc.stop()
    values = side**2 * len(NAMES) * 9 * 4  # mean, sd and seven quantiles, in single precision
    assert written[0] < values / 4


def chunk_of(store: Path, name: str, block: int) -> Path:
    return store / name / "c" / str(block) / "0"


def flip(file: Path, at: int = -6) -> None:
    content = bytearray(file.read_bytes())
    content[at] ^= 0x10
    file.write_bytes(content)


def test_the_maps_are_those_that_are_made_in_memory(capture, finished, monkeypatch):
    image = xr.open_zarr(capture, consolidated=False).load()
    found = pb.maps.open_map(finished).load()
    counts = pb.maps.count_pixels(found)
    assert counts["good"] + counts["not trusted"] == 180
    assert [path.name for path in finished.parent.iterdir()] == ["map.zarr"]
    xr.testing.assert_equal(found, pb.fit_pixels(image, method=METHOD, **ASKED))
    monkeypatch.delattr(compiled_model, "compile_program")  # nothing is compiled a second time
    xr.testing.assert_equal(found, pb.fit_pixels(image, method=METHOD, **ASKED))


def test_a_finished_map_comes_back_without_an_estimate(capture, finished, monkeypatch):
    monkeypatch.delattr(module, "estimate_plan")
    found = mapped(capture, finished, resume=True)
    xr.testing.assert_identical(found.load(), pb.maps.open_map(finished).load())


def test_a_finished_map_is_never_written_over(capture: Path, finished: Path) -> None:
    with pytest.raises(pb.OutputError, match="there already; give another --out, or --resume"):
        mapped(capture, finished)
    with pytest.raises(pb.FitError, match="begun with another capture or other settings, or by"):
        mapped(capture, finished, resume=True, seed=1)
    with pytest.raises(TypeError, match="unexpected keyword argument 'sceen'"):
        mapped(capture, finished.with_name("other.zarr"), sceen="paper")
    assert [path.name for path in finished.parent.iterdir()] == ["map.zarr"]


def test_a_map_of_an_earlier_version_is_opened_or_begun_again(capture, begun, finished, tmp_path):
    """Its journal began otherwise, and its request had another digest."""
    out = copied(begun, tmp_path / "map.zarr")
    journal_of(out).write_bytes(b'polar_bayes map {"capture or other settings": "00"}\n')
    with pytest.raises(pb.OutputError, match="not the journal of a map that this version can"):
        mapped(capture, out, resume=True)
    old = copied(finished, tmp_path / "old.zarr")
    metadata = (old / "zarr.json").read_text()
    digest = pb.maps.open_map(finished).attrs["request_sha256"]
    (old / "zarr.json").write_text(metadata.replace(digest, "00" * 32))
    assert sum(pb.maps.count_pixels(pb.load(old)).values()) == 180
    with pytest.raises(pb.FitError, match="or by another version"):
        mapped(capture, old, resume=True)


@pytest.mark.thorough
@each("resume", [False, True])
def test_the_capture_is_never_written_to(capture: Path, tmp_path: Path, resume: bool) -> None:
    source = copied(capture, tmp_path / "in" / "plates.zarr")
    (tmp_path / "link.zarr").symlink_to(source)
    for out in (source, source / "map.zarr", source.parent, tmp_path, tmp_path / "link.zarr"):
        journal_of(out).touch()
        with pytest.raises(pb.OutputError, match="it is the capture, inside it, or around it"):
            mapped(source, out, resume=resume)
        journal_of(out).unlink()
    with pytest.raises(pb.OutputError, match="its folder is not there; make the folder first"):
        mapped(source, tmp_path / "nowhere" / "map.zarr", resume=resume)
    left = [path.relative_to(source) for path in sorted(source.rglob("*"))]
    assert left == [path.relative_to(capture) for path in sorted(capture.rglob("*"))]


@pytest.mark.thorough
def test_an_unfinished_map_is_not_opened_with_or_without_its_journal(
    capture, begun, finished, tmp_path
):
    alone = copied(begun, tmp_path / "map.zarr")
    for store in (begun, alone):
        with pytest.raises(pb.FitError, match="not finished; wait, or go on with"):
            pb.maps.open_map(store)
    unsaid = xr.open_zarr(begun, chunks=None, consolidated=False)
    assert pb.maps.count_pixels(unsaid)["not fitted"] in (40, 60, 100)
    seen: list[int] = []
    found = mapped(capture, alone, resume=True, progress=lambda done, every: seen.append(done))
    assert len(seen) == 5  # no line says that a block is done
    xr.testing.assert_identical(found.load(), pb.maps.open_map(finished).load())


@pytest.mark.thorough
def test_a_chunk_that_a_finished_map_lost_is_not_good(capture, finished, tmp_path):
    whole = pb.maps.count_pixels(pb.maps.open_map(finished))
    for name in ("status", "refractive_index", "refractive_index_sd", "criticism"):
        out = copied(finished, tmp_path / f"{name}.zarr")
        chunk_of(out, name, 1).unlink()
        maps = pb.maps.open_map(out)
        counts = pb.maps.count_pixels(maps)
        lost = counts["not fitted"]
        assert lost == 40 if name == "status" else 0 < lost <= 40
        assert counts["good"] <= whole["good"] - (0 if name == "status" else lost)
        page = render(maps)
        assert f"{lost} of 180 pixels are not fitted: this map has holes." in page
        assert "Every pixel" not in page
        assert f"{lost} pixels are not fitted: they are called good" in str(pb.show(maps))
        with pytest.raises(pb.OutputError, match="1 of 65 chunks are missing; copy"):
            mapped(capture, out, resume=True)
    out = copied(finished, tmp_path / "map.zarr")
    for name, says in (("y", "its values are missing"), ("quantile", "its levels are not those")):
        (out / name / "c" / "0").unlink()
        with pytest.raises(pb.FitError, match=rf"map\.zarr: {name}: {says}"):
            pb.maps.open_map(out)


def test_a_changed_byte_of_a_map_is_an_error(finished: Path, tmp_path: Path) -> None:
    out = copied(finished, tmp_path / "map.zarr")
    names = [str(name) for name in pb.maps.open_map(out).variables]
    for name in names:
        file = next(path for path in (out / name / "c").rglob("*") if path.is_file())
        for at in (0, -1):
            flip(file, at)
            with pytest.raises(pb.FitError, match="cannot be read") as error:
                pb.maps.open_map(out).load()
            flip(file, at)
            assert str(out) in str(error.value)
            assert "\n" not in str(error.value)
    flip(chunk_of(out, "status", 1))
    with pytest.raises(pb.FitError, match=r"map\.zarr: status\[y=.*, x=0:20\]: it cannot be read"):
        pb.maps.count_pixels(pb.maps.open_map(out))


def test_a_capture_that_changed_since_is_not_mixed_with_what_is_done(
    kind, capture, begun, finished, tmp_path
):
    source = copied(capture, tmp_path / "plates.zarr")
    name = kind.first_done(begun)
    row = int(name.removeprefix("y=").partition(":")[0]) + 1
    changed = xr.open_zarr(source, chunks=None, consolidated=False)[["q"]].load()
    changed["q"][row, 3, 2] += 1e-9
    changed.to_zarr(source, mode="r+", consolidated=False)
    with pytest.raises(pb.FitError, match=f"changed since block {name} was fitted"):
        mapped(source, begun, resume=True)
    assert journal_of(begun).exists()
    with pytest.raises(pb.FitError, match="the capture has changed since it was made"):
        mapped(source, finished, resume=True)
    truth = xr.Dataset({"true_refractive_index": (("y", "x"), np.full((9, 20), 1.5))})
    known = copied(capture, tmp_path / "known" / "plates.zarr")
    truth.to_zarr(known, mode="r+", consolidated=False)  # no fit reads it
    ended = copied(finished, tmp_path / "ended.zarr")
    shutil.copy(journal_of(begun), journal_of(ended))  # killed before the journal was removed
    found = mapped(known, ended, resume=True)
    xr.testing.assert_identical(found.load(), pb.maps.open_map(finished).load())
    assert not journal_of(ended).exists()


@pytest.mark.thorough
def test_a_netcdf_file_is_read_once(capture, finished, tmp_path, monkeypatch):
    pb.save_capture(pb.maps.open_capture(capture), tmp_path / "plates.nc")
    loaded: list[Path] = []

    def load(path: Path) -> xr.Dataset:
        loaded.append(path)
        return pb.load_capture(path)

    monkeypatch.setattr(lazy, "load_capture", load)
    found = mapped(tmp_path / "plates.nc", tmp_path / "map.zarr")
    xr.testing.assert_equal(found.load(), pb.maps.open_map(finished).load())
    assert loaded == [tmp_path / "plates.nc"]


def test_an_interrupt_does_not_wait_for_blocks() -> None:
    started = time.monotonic()
    with contextlib.suppress(KeyboardInterrupt), workers(None) as (pool, _):
        running = pool.submit(time.sleep, 3.0)
        raise KeyboardInterrupt
    assert time.monotonic() - started < 2.0
    running.result()


def test_a_store_that_is_broken_is_refused(capture: Path, tmp_path: Path) -> None:
    broken = tmp_path / "plates.zarr"
    shutil.copytree(capture, broken)
    (broken / "q" / "c" / "1" / "0" / "0").unlink()
    with pytest.raises(pb.CaptureError, match=r"plates\.zarr: q: 1 of 3 chunks are missing"):
        mapped(broken, tmp_path / "map.zarr")
    with pytest.raises(pb.CaptureError, match="there is no such store"):
        mapped(tmp_path / "nowhere.zarr", tmp_path / "map.zarr")


def test_a_reading_that_cannot_be_is_named_with_its_block(capture: Path, tmp_path: Path) -> None:
    source = copied(capture, tmp_path / "plates.zarr")
    changed = xr.open_zarr(source, chunks=None, consolidated=False)[["q"]].load()
    changed["q"][7, 3, 2] = 1.5
    changed.to_zarr(source, mode="r+", consolidated=False)
    says = "block y=6:8 x=0:20: capture: q[y=1, x=3, view=2]: 1.5 is outside"
    with pytest.raises(pb.CaptureError, match=re.escape(f"{source}: {says}")):
        mapped(source, tmp_path / "map.zarr")


@pytest.mark.thorough
def test_a_scheduler_that_does_not_answer_is_one_line(capture: Path, tmp_path: Path) -> None:
    with pytest.raises(pb.FitError, match="no scheduler answers there"):
        mapped(capture, tmp_path / "map.zarr", scheduler="tcp://127.0.0.1:9")
