"""What every store of blocks promises: resumed to the same bits, never mixed, never shared."""

import contextlib
import dataclasses
import errno
import itertools
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
import tracemalloc
from pathlib import Path

import dask.array as da
import numpy as np
import pytest
import xarray as xr
from cases import each
from numpyro import distributions as dist
from numpyro import handlers
from plate_images import ASKED, NAMES, plate_image
from plates import LINKS, PLATE
from stores import BrokenOff, Stored, StoredMap, assert_same_bits, copied, stored

import polar_bayes as pb
from polar_bayes.inference import compiled_model
from polar_bayes.interrupts import clean_up
from polar_bayes.maps import lazy
from polar_bayes.maps import store as map_store
from polar_bayes.maps.blocks import BLOCK_THREADS, workers
from polar_bayes.maps.fit_map import MapPlan
from polar_bayes.models.per_material import per_material
from polar_bayes.reporting.report import render

CRASH, FULL = BrokenOff(), OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
KINDS = ["map", pytest.param("calibration", marks=pytest.mark.thorough)]


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """What asks for an image is tested of maps alone, everything else of both kinds."""
    if "kind" in metafunc.fixturenames:
        kinds = KINDS[:1] if "capture" in metafunc.fixturenames else KINDS
        metafunc.parametrize("kind", kinds, indirect=True, scope="module")


@pytest.fixture(scope="module")
def kind(request, tmp_path_factory):
    with stored(request.param, tmp_path_factory.mktemp("asked")) as found:
        yield found


@pytest.fixture(scope="module")
def capture(kind: StoredMap) -> Path:
    return kind.capture


@pytest.fixture(scope="module")
def made(kind: Stored, tmp_path_factory) -> tuple[Path, xr.Dataset | xr.DataTree]:
    store = tmp_path_factory.mktemp("finished") / "store"
    return store, kind.run(store)


@pytest.fixture(scope="module")
def finished(made) -> Path:
    return made[0]


@pytest.fixture(scope="module")
def whole(made) -> xr.Dataset | xr.DataTree:
    return made[1]


@pytest.fixture(scope="module")
def writes(kind: Stored, tmp_path_factory: pytest.TempPathFactory) -> int:
    """Count how often a run writes to the disk."""
    written: list[int] = []
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(os, "fsync", written.append)
        kind.run(tmp_path_factory.mktemp("counted") / "store")
    return len(written)


@pytest.fixture(scope="module")
def begun(kind: Stored, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store in which two blocks are done, or a few more."""
    return kind.break_off(tmp_path_factory.mktemp("begun") / "store")


def alone(store: Path, to: Path) -> Path:
    """A copy of a store, without its journal."""
    return Path(shutil.copytree(store, to))


def content(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_what_was_broken_off_goes_on_to_the_same_bits(kind, whole, begun, tmp_path) -> None:
    store, seen, said = copied(begun, tmp_path), [], []
    with kind.journal(store).open("a") as file:
        file.write("a line that a cra")
    left = kind.journal(store).parent / ".polar-bayes-crashed"
    left.mkdir()
    (left / "block").write_bytes(b"half a blo")

    def progress(done: int, every: int) -> None:
        seen.append(done)
        said.extend(clean_up())  # as an interrupt does

    found = kind.run(store, resume=True, progress=progress)
    assert said == [
        f"{store}: finished work is saved; repeat the command with --resume to continue"
    ]
    assert seen[0] > 2 * kind.block  # what is done is not done again
    assert seen[-1] == kind.total
    assert_same_bits(found, whole)
    assert_same_bits(kind.run(store, resume=True), whole)


@pytest.mark.thorough
@each("error", [CRASH, FULL], ids=["crash", "full disk"])
@each("share", [0.0, 0.01, 0.3, 0.5, 0.7, 0.85, 0.99, 0.999])
def test_a_run_that_ends_at_any_write_is_resumed(
    kind, whole, writes, tmp_path, monkeypatch, error, share
):
    """After this share of what is written to the disk."""
    calls, last = itertools.count(), int(share * writes)

    def fsync(opened: int) -> None:
        if next(calls) >= last:
            raise error

    store = tmp_path / "store"
    full = r"it could not be written \(no space left on device\); make room"
    monkeypatch.setattr(os, "fsync", fsync)
    with pytest.raises((BrokenOff, pb.OutputError), match=None if error is CRASH else full):
        kind.run(store)
    monkeypatch.undo()
    assert_same_bits(kind.run(store, resume=True), whole)


DAMAGES = ("lost", "cut", "flipped at 0.5", "empty", "flipped at 0.1", "flipped at 0.9")


@pytest.mark.parametrize(
    "damage", [*DAMAGES[:3], *(pytest.param(x, marks=pytest.mark.thorough) for x in DAMAGES[3:])]
)
def test_a_damaged_block_is_fitted_again(kind, whole, begun, tmp_path, damage) -> None:
    store = copied(begun, tmp_path)
    victim = kind.files(store, kind.first_done(store))[-1]
    before = victim.read_bytes()
    if damage == "lost":
        victim.unlink()
    elif damage in ("cut", "empty"):
        victim.write_bytes(before[: len(before) // 2] if damage == "cut" else b"")
    else:
        at = int(float(damage.split()[-1]) * len(before))
        victim.write_bytes(before[:at] + bytes([before[at] ^ 0x10]) + before[at + 1 :])
    seen: list[int] = []
    found = kind.run(store, resume=True, progress=lambda done, every: seen.append(done))
    done = len(kind.journal(begun).read_text().splitlines()) - 1
    assert len(seen) == -(-kind.total // kind.block) - done + 1
    assert_same_bits(found, whole)


@each(
    ("other", "topic"),
    [
        ({"seed": 1}, "seed"),
        ({"method": pb.methods.Laplace()}, "method"),
        ({"priors": {"refractive_index": dist.Uniform(1.2, 2.0 + 1e-9)}}, "priors"),
        ({"links": {"q": dataclasses.replace(LINKS["q"], degrees_of_freedom=5.0)}}, "links"),
        ({"model": handlers.condition(per_material, data={"stokes_error_factor": 1.1})}, "model"),
        ({"scene": dataclasses.replace(PLATE, mixing=pb.DopMixing())}, "scene(, another priors)?"),
        ({"largest_view_zenith": 70.0}, "(capture, another )?largest_view_zenith"),
    ],
    ids=lambda each: each if isinstance(each, str) else "",
)
def test_another_request_is_refused_and_changes_nothing(kind, begun, other, topic) -> None:
    before = content(begun.parent)
    says = f"{kind.journal(begun)}: it was begun with another {topic}; repeat the command as"
    with pytest.raises(pb.FitError, match=says):
        kind.run(begun, resume=True, **other)
    with pytest.raises(pb.OutputError, match="it is there already; give another --out, or --res"):
        kind.run(begun)
    assert content(begun.parent) == before


def test_what_is_the_users_own_is_never_touched(kind, begun, tmp_path) -> None:
    own = tmp_path / "own" / "store"
    own.mkdir(parents=True)
    (own / "letters.txt").write_text("mine")
    store = copied(begun, tmp_path / "copy")
    kind.journal(store).write_text("shopping list")
    for place, says in (
        (own, "it (is not a map|holds no calibration) that"),
        (store, "it is not the journal of a"),
    ):
        before = content(place.parent)
        for resume, message in ((True, says), (False, "it is there already")):
            with pytest.raises(pb.PolarBayesError, match=message):
                kind.run(place, resume=resume)
        assert content(place.parent) == before


HOLDER = """
import pathlib, sys, time
from polar_bayes.maps.blocks import open_journal
file = pathlib.Path(sys.argv[1])
with open_journal(file, file, "store", {}, resume=True):
    print("locked", flush=True)
    time.sleep(600)
"""


def test_a_second_process_is_refused_and_a_killed_one_leaves_no_lock(kind, whole, begun, tmp_path):
    store = copied(begun, tmp_path)
    before = content(tmp_path)
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER, kind.journal(store)], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "locked\n"
        with pytest.raises(pb.OutputError, match="store: another process is writing it; wait"):
            kind.run(store, resume=True)
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert content(tmp_path) == before
    assert_same_bits(kind.run(store, resume=True), whole)


@pytest.mark.thorough
@each("what", ["store", "journal"])
def test_what_another_process_took_away_is_one_line(kind, tmp_path, what) -> None:
    store = tmp_path / "store"

    def take_away(done: int, every: int) -> None:
        path = store if what == "store" else kind.journal(store)
        if done < every and path.exists():
            path.rename(tmp_path / f"taken-{done}")

    says = "store: (it could not be written|another process has finished, moved or removed)"
    with pytest.raises(pb.OutputError, match=says) as error:
        kind.run(store, progress=take_away)
    assert "\n" not in str(error.value)


# --- Processes that are killed: each compiles for itself, and bits agree all the same -------------


@pytest.mark.thorough
@each("moment", [0, 1, 3])
def test_a_killed_process_is_resumed_to_the_same_bits(kind, whole, tmp_path, moment) -> None:
    """Killed as soon as so many blocks are done, or half a second into the work."""
    store = tmp_path / "store"
    with kind.start(store) as process:
        assert process.stdout is not None
        for _ in range(moment):
            process.stdout.readline()
        if not moment:
            while not store.exists():
                time.sleep(0.05)
            time.sleep(0.5)
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
    assert kind.journal(store).exists()
    seen: list[int] = []
    found = kind.run(store, resume=True, progress=lambda done, every: seen.append(done))
    assert seen[0] > kind.block * max(moment - 1, 0)  # what was done is not done again
    assert_same_bits(found, whole)


@pytest.mark.thorough
def test_ten_kills_in_a_row_change_no_bit(kind, whole, tmp_path) -> None:
    """Three are killed when they have done another block, seven some seconds after their start."""
    store = tmp_path / "store"
    for kill in range(10):
        with kind.start(store, resume=kill > 0) as process:
            assert process.stdout is not None
            if kill % 4:
                time.sleep(kill)
            else:
                process.stdout.readline()
            process.send_signal(signal.SIGKILL)
            process.wait()
    assert_same_bits(kind.run(store, resume=True), whole)


@pytest.mark.thorough
def test_a_worker_of_a_cluster_that_is_killed_changes_no_bit(kind, whole, tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed")
    monkeypatch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")  # workers compile in haste, too
    store = tmp_path / "store"
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=":0"
        ) as cluster,
        kind.start(store, scheduler=cluster.scheduler_address) as process,
    ):
        assert process.stdout is not None
        process.stdout.readline()
        victim = next(iter(cluster.workers.values()))
        os.kill(victim.pid, signal.SIGKILL)
        assert process.wait() == 0
    assert_same_bits(kind.run(store, resume=True), whole)


# --- Maps alone --------------------------------------------------------------------------------


@pytest.mark.thorough
def test_a_store_is_begun_without_holding_the_maps_in_memory(kind, capture, tmp_path, monkeypatch):
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

    monkeypatch.setattr(map_store, "BLOCK", 65536)
    monkeypatch.setattr(map_store, "fit_block", at_the_first_block)
    monkeypatch.setattr(map_store, "estimate_plan", lambda plan, image: plan)  # reads 512 pixels
    tracemalloc.start()
    with pytest.raises(BrokenOff):
        kind.run(tmp_path / "map.zarr", capture=tmp_path / "large.zarr")
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


def test_the_maps_are_those_that_are_made_in_memory(kind, capture, finished, monkeypatch):
    image = xr.open_zarr(capture, consolidated=False).load()
    found = pb.maps.open_map(finished).load()
    counts = pb.maps.count_pixels(found)
    assert counts["good"] + counts["not trusted"] == 180
    assert [path.name for path in finished.parent.iterdir()] == [finished.name]
    xr.testing.assert_equal(found, pb.fit_pixels(image, method=kind.method, **ASKED))
    monkeypatch.delattr(compiled_model, "compile_program")  # nothing is compiled a second time
    xr.testing.assert_equal(found, pb.fit_pixels(image, method=kind.method, **ASKED))


def test_a_finished_map_comes_back_without_an_estimate(kind, capture, finished, monkeypatch):
    monkeypatch.delattr(map_store, "estimate_plan")
    found = kind.run(finished, resume=True)
    xr.testing.assert_identical(found.load(), pb.maps.open_map(finished).load())


def test_a_finished_map_is_never_written_over(kind, capture, finished) -> None:
    with pytest.raises(pb.OutputError, match="there already; give another --out, or --resume"):
        kind.run(finished)
    with pytest.raises(pb.FitError, match="begun with another capture or other settings, or by"):
        kind.run(finished, resume=True, seed=1)
    with pytest.raises(TypeError, match="unexpected keyword argument 'sceen'"):
        kind.run(finished.with_name("other.zarr"), sceen="paper")
    assert [path.name for path in finished.parent.iterdir()] == [finished.name]


def test_a_map_of_an_earlier_version_is_opened_or_begun_again(
    kind, capture, begun, finished, tmp_path
):
    """Its journal began otherwise, and its request had another digest."""
    out = alone(begun, tmp_path / "map.zarr")
    kind.journal(out).write_bytes(b'polar_bayes map {"capture or other settings": "00"}\n')
    with pytest.raises(pb.OutputError, match="not the journal of a map that this version can"):
        kind.run(out, resume=True)
    old = alone(finished, tmp_path / "old.zarr")
    metadata = (old / "zarr.json").read_text()
    digest = pb.maps.open_map(finished).attrs["request_sha256"]
    (old / "zarr.json").write_text(metadata.replace(digest, "00" * 32))
    assert sum(pb.maps.count_pixels(pb.load(old)).values()) == 180
    with pytest.raises(pb.FitError, match="or by another version"):
        kind.run(old, resume=True)


@pytest.mark.thorough
@each("resume", [False, True])
def test_the_capture_is_never_written_to(kind, capture, tmp_path: Path, resume: bool) -> None:
    source = alone(capture, tmp_path / "in" / "plates.zarr")
    (tmp_path / "link.zarr").symlink_to(source)
    for out in (source, source / "map.zarr", source.parent, tmp_path, tmp_path / "link.zarr"):
        kind.journal(out).touch()
        with pytest.raises(pb.OutputError, match="it is the capture, inside it, or around it"):
            kind.run(out, capture=source, resume=resume)
        kind.journal(out).unlink()
    with pytest.raises(pb.OutputError, match="its folder is not there; make the folder first"):
        kind.run(tmp_path / "nowhere" / "map.zarr", capture=source, resume=resume)
    left = [path.relative_to(source) for path in sorted(source.rglob("*"))]
    assert left == [path.relative_to(capture) for path in sorted(capture.rglob("*"))]


@pytest.mark.thorough
def test_an_unfinished_map_is_not_opened_with_or_without_its_journal(
    kind, capture, begun, finished, tmp_path
):
    store_alone = alone(begun, tmp_path / "map.zarr")
    for store in (begun, store_alone):
        with pytest.raises(pb.FitError, match="not finished; wait, or go on with"):
            pb.maps.open_map(store)
    unsaid = xr.open_zarr(begun, chunks=None, consolidated=False)
    assert pb.maps.count_pixels(unsaid)["not fitted"] in (40, 60, 100)
    seen: list[int] = []
    found = kind.run(store_alone, resume=True, progress=lambda done, every: seen.append(done))
    assert len(seen) == 5  # no line says that a block is done
    xr.testing.assert_identical(found.load(), pb.maps.open_map(finished).load())


@pytest.mark.thorough
def test_a_chunk_that_a_finished_map_lost_is_not_good(kind, capture, finished, tmp_path):
    whole = pb.maps.count_pixels(pb.maps.open_map(finished))
    for name in ("status", "refractive_index", "refractive_index_sd", "criticism"):
        out = alone(finished, tmp_path / f"{name}.zarr")
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
            kind.run(out, resume=True)
    out = alone(finished, tmp_path / "map.zarr")
    for name, says in (("y", "its values are missing"), ("quantile", "its levels are not those")):
        (out / name / "c" / "0").unlink()
        with pytest.raises(pb.FitError, match=rf"map\.zarr: {name}: {says}"):
            pb.maps.open_map(out)


def test_a_changed_byte_of_a_map_is_an_error(capture, finished, tmp_path) -> None:
    out = alone(finished, tmp_path / "map.zarr")
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
    source = alone(capture, tmp_path / "plates.zarr")
    name = kind.first_done(begun)
    row = int(name.removeprefix("y=").partition(":")[0]) + 1
    changed = xr.open_zarr(source, chunks=None, consolidated=False)[["q"]].load()
    changed["q"][row, 3, 2] += 1e-9
    changed.to_zarr(source, mode="r+", consolidated=False)
    with pytest.raises(pb.FitError, match=f"changed since block {name} was fitted"):
        kind.run(begun, capture=source, resume=True)
    assert kind.journal(begun).exists()
    with pytest.raises(pb.FitError, match="the capture has changed since it was made"):
        kind.run(finished, capture=source, resume=True)
    truth = xr.Dataset({"true_refractive_index": (("y", "x"), np.full((9, 20), 1.5))})
    known = alone(capture, tmp_path / "known" / "plates.zarr")
    truth.to_zarr(known, mode="r+", consolidated=False)  # no fit reads it
    ended = alone(finished, tmp_path / "ended.zarr")
    shutil.copy(kind.journal(begun), kind.journal(ended))  # killed before the journal was removed
    found = kind.run(ended, capture=known, resume=True)
    xr.testing.assert_identical(found.load(), pb.maps.open_map(finished).load())
    assert not kind.journal(ended).exists()


@pytest.mark.thorough
def test_a_netcdf_file_is_read_once(kind, capture, finished, tmp_path, monkeypatch):
    pb.save_capture(pb.maps.open_capture(capture), tmp_path / "plates.nc")
    loaded: list[Path] = []

    def load(path: Path) -> xr.Dataset:
        loaded.append(path)
        return pb.load_capture(path)

    monkeypatch.setattr(lazy, "load_capture", load)
    found = kind.run(tmp_path / "map.zarr", capture=tmp_path / "plates.nc")
    xr.testing.assert_equal(found.load(), pb.maps.open_map(finished).load())
    assert loaded == [tmp_path / "plates.nc"]


def test_an_interrupt_does_not_wait_for_blocks() -> None:
    started = time.monotonic()
    with contextlib.suppress(KeyboardInterrupt), workers(None) as (pool, _):
        running = pool.submit(time.sleep, 3.0)
        raise KeyboardInterrupt
    assert time.monotonic() - started < 2.0
    running.result()


def test_a_store_that_is_broken_is_refused(kind, capture, tmp_path) -> None:
    broken = alone(capture, tmp_path / "plates.zarr")
    (broken / "q" / "c" / "1" / "0" / "0").unlink()
    with pytest.raises(pb.CaptureError, match=r"plates\.zarr: q: 1 of 3 chunks are missing"):
        kind.run(tmp_path / "map.zarr", capture=broken)
    with pytest.raises(pb.CaptureError, match="there is no such store"):
        kind.run(tmp_path / "map.zarr", capture=tmp_path / "nowhere.zarr")


def test_a_reading_that_cannot_be_is_named_with_its_block(kind, capture, tmp_path) -> None:
    source = alone(capture, tmp_path / "plates.zarr")
    changed = xr.open_zarr(source, chunks=None, consolidated=False)[["q"]].load()
    changed["q"][7, 3, 2] = 1.5
    changed.to_zarr(source, mode="r+", consolidated=False)
    says = "block y=6:8 x=0:20: capture: q[y=1, x=3, view=2]: 1.5 is outside"
    with pytest.raises(pb.CaptureError, match=re.escape(f"{source}: {says}")):
        kind.run(tmp_path / "map.zarr", capture=source)


@pytest.mark.thorough
def test_a_scheduler_that_does_not_answer_is_one_line(kind, capture, tmp_path) -> None:
    with pytest.raises(pb.FitError, match="no scheduler answers there"):
        kind.run(tmp_path / "map.zarr", scheduler="tcp://127.0.0.1:9")
