"""From file to file: broken off, gone on with, damaged, refused."""

import contextlib
import errno
import itertools
import os
import re
import shutil
import threading
import time
import tracemalloc
from pathlib import Path

import dask.array as da
import numpy as np
import pytest
import xarray as xr
from cases import each
from plate_images import ASKED, NAMES, plate_image

import polar_bayes as pb
from polar_bayes.inference import compiled_model
from polar_bayes.interrupts import clean_up
from polar_bayes.maps import lazy
from polar_bayes.maps import store as module
from polar_bayes.maps.blocks import BLOCK_THREADS, workers
from polar_bayes.maps.fit_map import MapPlan
from polar_bayes.reporting.report import render

METHOD = pb.methods.CorrectedLaplace(draws=64, sampler=None)
ROWS = 2  # of a block of 40 pixels in an image 20 wide


@pytest.fixture(autouse=True, scope="module")
def small_blocks(compiled_in_haste: None) -> None:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(module, "BLOCK", 40)
        yield


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("image") / "plates.zarr"
    image = plate_image(9, 20).assign_coords(y=np.arange(1.0, 10.0))
    image.chunk(y=3, x=20).to_zarr(file, consolidated=False)
    return file


@pytest.fixture(scope="module")
def finished(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("finished") / "map.zarr"
    mapped(capture, out)
    return out


@pytest.fixture(scope="module")
def begun(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("begun") / "map.zarr"
    break_off(capture, out)
    return out


def mapped(capture: Path, out: Path, **asked) -> xr.Dataset:
    return pb.maps.map_file(capture, out, method=METHOD, **{**ASKED, **asked})


class BrokenOff(BaseException):
    """Stands in for a crash or an interrupt."""


def break_off(capture: Path, out: Path) -> None:
    def progress(done: int, every: int) -> None:
        if done >= 80:
            raise BrokenOff

    with pytest.raises(BrokenOff):
        mapped(capture, out, progress=progress)


def test_a_store_is_begun_without_holding_the_maps_in_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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


def copied(store: Path, to: Path, *, ledger: bool = True) -> Path:
    shutil.copytree(store, to)
    if ledger and ledger_of(store).exists():
        shutil.copy(ledger_of(store), ledger_of(to))
    return to


def ledger_of(store: Path) -> Path:
    return store.with_name(f"{store.name}.progress")


def first_done(store: Path) -> int:
    """Which block the first line of the ledger names."""
    label = ledger_of(store).read_text().splitlines()[1].split()[0]
    return int(label.removeprefix("y=").partition(":")[0]) // ROWS


def chunk_of(store: Path, name: str, block: int) -> Path:
    return store / name / "c" / str(block) / "0"


def flip(file: Path, at: int = -6) -> None:
    content = bytearray(file.read_bytes())
    content[at] ^= 0x10
    file.write_bytes(content)


def test_a_map_that_was_broken_off_goes_on_to_the_same_bits(
    capture: Path, finished: Path, begun: Path, tmp_path: Path
) -> None:
    expected = pb.maps.open_map(finished).load()
    assert (
        pb.maps.count_pixels(expected)["good"] + pb.maps.count_pixels(expected)["not trusted"]
        == 180
    )
    assert [path.name for path in finished.parent.iterdir()] == ["map.zarr"]
    out = copied(begun, tmp_path / "map.zarr")
    with ledger_of(out).open("a") as file:
        file.write("y=4:6 x=0")  # a line that a crash cut off
    seen: list[int] = []
    found = mapped(capture, out, resume=True, progress=lambda done, every: seen.append(done))
    assert seen[0] > 80
    assert seen[-1] == 180
    assert len(seen) < 5
    xr.testing.assert_identical(found.load(), expected)
    assert [path.name for path in tmp_path.iterdir()] == ["map.zarr"]


def test_the_maps_are_those_that_are_made_in_memory(
    capture: Path, finished: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    image = xr.open_zarr(capture, consolidated=False).load()
    found = pb.maps.open_map(finished).load()
    xr.testing.assert_equal(found, pb.fit_pixels(image, method=METHOD, **ASKED))
    monkeypatch.delattr(compiled_model, "compile_program")  # nothing is compiled a second time
    xr.testing.assert_equal(found, pb.fit_pixels(image, method=METHOD, **ASKED))


def test_a_finished_map_comes_back_without_an_estimate(
    capture: Path, finished: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(module, "estimate_plan")
    found = mapped(capture, finished, resume=True)
    xr.testing.assert_identical(found.load(), pb.maps.open_map(finished).load())


@pytest.mark.thorough
def test_whoever_is_stopped_before_the_store_is_whole_can_go_on(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(*_: object) -> None:
        raise BrokenOff

    out = tmp_path / "map.zarr"
    with monkeypatch.context() as patched:
        patched.setattr(Path, "rename", stop)
        with pytest.raises(BrokenOff):
            mapped(capture, out)
    assert [path.name for path in tmp_path.iterdir()] == ["map.zarr.progress"]
    ledger_of(out).write_bytes(ledger_of(out).read_bytes()[:20])  # the head was cut off as well
    found = mapped(capture, out, resume=True)
    assert sum(pb.maps.count_pixels(found).values()) == 180
    with pytest.raises(TypeError, match="unexpected keyword argument 'sceen'"):
        mapped(capture, tmp_path / "other.zarr", sceen="paper")
    assert [path.name for path in tmp_path.iterdir()] == ["map.zarr"]


def test_what_cannot_be_gone_on_with_is_refused(
    capture: Path, begun: Path, finished: Path, tmp_path: Path
) -> None:
    with pytest.raises(pb.OutputError, match="there already; give another --out, or --resume"):
        mapped(capture, begun)
    with pytest.raises(pb.OutputError, match="there already; give another --out, or --resume"):
        mapped(capture, finished)
    for out in (begun, finished):
        with pytest.raises(pb.FitError, match="begun with another capture or other settings"):
            mapped(capture, out, resume=True, seed=1)
    ledger_of(tmp_path / "map.zarr").write_bytes(
        ledger_of(begun).read_bytes().replace(b"map ", b"map 0", 1)
    )
    with pytest.raises(pb.FitError, match="progress: it was begun with another capture"):
        mapped(capture, tmp_path / "map.zarr", resume=True)
    assert [path.name for path in finished.parent.iterdir()] == ["map.zarr"]


def test_what_is_the_users_own_is_never_touched(
    capture: Path, finished: Path, tmp_path: Path
) -> None:
    own = tmp_path / "mydata.zarr"
    own.mkdir()
    (own / "notes.txt").write_text("mine")
    for content in (None, b""):
        if content is not None:
            ledger_of(own).write_bytes(content)
        with pytest.raises(pb.OutputError, match="it is not a map that can be resumed"):
            mapped(capture, own, resume=True)
        with pytest.raises(pb.OutputError, match="it is there already"):
            mapped(capture, own)
        assert [path.name for path in own.iterdir()] == ["notes.txt"]
        assert ledger_of(own).exists() == (content is not None)
    for other in (tmp_path / "other.zarr", copied(finished, tmp_path / "map.zarr")):
        ledger_of(other).write_text("shopping list")
        for resume, says in ((False, "there already"), (True, "not the ledger of a map")):
            with pytest.raises(pb.OutputError, match=f"progress: it is {says}"):
                mapped(capture, other, resume=resume)
        assert ledger_of(other).read_text() == "shopping list"


@pytest.mark.thorough
@each("resume", [False, True])
def test_the_capture_is_never_written_to(capture: Path, tmp_path: Path, resume: bool) -> None:
    source = copied(capture, tmp_path / "in" / "plates.zarr")
    (tmp_path / "link.zarr").symlink_to(source)
    for out in (source, source / "map.zarr", source.parent, tmp_path, tmp_path / "link.zarr"):
        ledger_of(out).touch()
        with pytest.raises(pb.OutputError, match="it is the capture, inside it, or around it"):
            mapped(source, out, resume=resume)
        ledger_of(out).unlink()
    with pytest.raises(pb.OutputError, match="its folder is not there; make the folder first"):
        mapped(source, tmp_path / "nowhere" / "map.zarr", resume=resume)
    left = [path.relative_to(source) for path in sorted(source.rglob("*"))]
    assert left == [path.relative_to(capture) for path in sorted(capture.rglob("*"))]


@pytest.mark.thorough
def test_an_unfinished_map_is_not_opened_with_or_without_its_ledger(
    capture: Path, begun: Path, finished: Path, tmp_path: Path
) -> None:
    alone = copied(begun, tmp_path / "map.zarr", ledger=False)
    for store in (begun, alone):
        with pytest.raises(pb.FitError, match="not finished; wait, or go on with"):
            pb.maps.open_map(store)
    unsaid = xr.open_zarr(begun, chunks=None, consolidated=False)
    assert pb.maps.count_pixels(unsaid)["not fitted"] in (40, 60, 100)
    seen: list[int] = []
    found = mapped(capture, alone, resume=True, progress=lambda done, every: seen.append(done))
    assert len(seen) == 5  # no line says that a block is done
    xr.testing.assert_identical(found.load(), pb.maps.open_map(finished).load())


@each("damage", ["lost", "altered"])
def test_a_block_whose_files_are_lost_or_altered_is_fitted_again(
    capture: Path, begun: Path, finished: Path, tmp_path: Path, damage: str
) -> None:
    out = copied(begun, tmp_path / "map.zarr")
    chunk = chunk_of(out, "status", first_done(out))
    chunk.unlink() if damage == "lost" else flip(chunk)
    seen: list[int] = []
    found = mapped(capture, out, resume=True, progress=lambda done, every: seen.append(done))
    assert len(seen) >= 3
    xr.testing.assert_identical(found.load(), pb.maps.open_map(finished).load())


@pytest.mark.thorough
def test_a_chunk_that_a_finished_map_lost_is_not_good(
    capture: Path, finished: Path, tmp_path: Path
) -> None:
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
    capture: Path, begun: Path, finished: Path, tmp_path: Path
) -> None:
    source = copied(capture, tmp_path / "plates.zarr")
    row = first_done(begun) * ROWS + 1
    changed = xr.open_zarr(source, chunks=None, consolidated=False)[["q"]].load()
    changed["q"][row, 3, 2] += 1e-9
    changed.to_zarr(source, mode="r+", consolidated=False)
    out = copied(begun, tmp_path / "map.zarr")
    with pytest.raises(pb.FitError, match=f"changed since block y={row - 1}:{row + 1} x=0:20 was"):
        mapped(source, out, resume=True)
    assert ledger_of(out).exists()
    with pytest.raises(pb.FitError, match="the capture has changed since it was made"):
        mapped(source, finished, resume=True)
    truth = xr.Dataset({"true_refractive_index": (("y", "x"), np.full((9, 20), 1.5))})
    known = copied(capture, tmp_path / "known" / "plates.zarr")
    truth.to_zarr(known, mode="r+", consolidated=False)  # no fit reads it
    ended = copied(finished, tmp_path / "ended.zarr")
    shutil.copy(ledger_of(begun), ledger_of(ended))  # killed before the ledger was removed
    found = mapped(known, ended, resume=True)
    xr.testing.assert_identical(found.load(), pb.maps.open_map(finished).load())
    assert not ledger_of(ended).exists()


@pytest.mark.thorough
@each("what", ["store", "ledger"])
def test_what_another_process_took_away_is_one_line(
    capture: Path, tmp_path: Path, what: str
) -> None:
    out = tmp_path / "map.zarr"

    def take_away(done: int, every: int) -> None:
        if done < every:
            path = out if what == "store" else ledger_of(out)
            path.rename(tmp_path / f"taken-{done}") if path.exists() else None

    says = r"map\.zarr: (it could not be written|another process has finished, moved or removed)"
    with pytest.raises(pb.OutputError, match=says) as error:
        mapped(capture, out, progress=take_away)
    assert "\n" not in str(error.value)


@pytest.mark.thorough
def test_a_full_disk_is_one_line_and_loses_nothing(
    capture: Path, finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, calls = tmp_path / "map.zarr", itertools.count()

    def full(path: Path) -> None:
        if next(calls) > 100:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patched:
        patched.setattr(module, "sync", full)
        with pytest.raises(
            pb.OutputError, match=r"not be written \(no space left on device\); make"
        ):
            mapped(capture, out)
    found = mapped(capture, out, resume=True)
    xr.testing.assert_identical(found.load(), pb.maps.open_map(finished).load())


@pytest.mark.thorough
def test_a_netcdf_file_is_read_once(
    capture: Path, finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pb.save_capture(pb.maps.open_capture(capture), tmp_path / "plates.nc")
    loaded: list[Path] = []

    def load(path: Path) -> xr.Dataset:
        loaded.append(path)
        return pb.load_capture(path)

    monkeypatch.setattr(lazy, "load_capture", load)
    found = mapped(tmp_path / "plates.nc", tmp_path / "map.zarr")
    xr.testing.assert_equal(found.load(), pb.maps.open_map(finished).load())
    assert loaded == [tmp_path / "plates.nc"]


def test_an_interrupt_does_not_wait_and_says_how_to_go_on(capture: Path, tmp_path: Path) -> None:
    started = time.monotonic()
    with contextlib.suppress(KeyboardInterrupt), workers(None) as (pool, _):
        running = pool.submit(time.sleep, 3.0)
        raise KeyboardInterrupt
    assert time.monotonic() - started < 2.0
    out, said = tmp_path / "map.zarr", []

    def interrupt(done: int, every: int) -> None:
        said.extend(clean_up())
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        mapped(capture, out, progress=interrupt)
    assert said == [f"{out}: what is done is kept; repeat the command with --resume to go on"]
    assert pb.maps.count_pixels(mapped(capture, out, resume=True))["not fitted"] == 0
    running.result()


def test_a_store_that_is_broken_is_refused(capture: Path, tmp_path: Path) -> None:
    broken = tmp_path / "plates.zarr"
    shutil.copytree(capture, broken)
    (broken / "q" / "c" / "1" / "0" / "0").unlink()
    with pytest.raises(pb.CaptureError, match=r"plates\.zarr: q: 1 of 3 chunks are missing"):
        mapped(broken, tmp_path / "map.zarr")
    with pytest.raises(pb.CaptureError, match="there is no such store"):
        mapped(tmp_path / "nowhere.zarr", tmp_path / "map.zarr")


@pytest.mark.thorough
def test_a_broken_chunk_of_a_capture_is_one_line(capture: Path, tmp_path: Path) -> None:
    source = copied(capture, tmp_path / "plates.zarr")
    (source / "q_error" / "c" / "2" / "0" / "0").write_bytes(b"\x28\xb5")
    says = r"plates\.zarr: q_error\[y=[68]:[89], x=0:20\]: it cannot be read"
    with pytest.raises(pb.CaptureError, match=says):
        mapped(source, tmp_path / "map.zarr")


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
