"""What every store of blocks promises: resumed to the same bits, never mixed, never shared."""

import dataclasses
import errno
import itertools
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import xarray as xr
from cases import each
from numpyro import distributions as dist
from numpyro import handlers
from plates import LINKS, PLATE
from stores import BrokenOff, Stored, assert_same_bits, copied, stored

import polar_bayes as pb
from polar_bayes.interrupts import clean_up
from polar_bayes.maps.blocks import open_journal
from polar_bayes.models.per_material import per_material

CRASH, FULL = BrokenOff(), OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
KINDS = ["map", pytest.param("calibration", marks=pytest.mark.thorough)]


@pytest.fixture(scope="module", params=KINDS)
def kind(request, tmp_path_factory):
    with stored(request.param, tmp_path_factory.mktemp("asked")) as found:
        yield found


@pytest.fixture(scope="module")
def whole(kind: Stored, tmp_path_factory: pytest.TempPathFactory) -> xr.Dataset | xr.DataTree:
    return kind.run(tmp_path_factory.mktemp("whole") / "store")


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


# --- The journal alone ----------------------------------------------------------------------------

TOPICS = {"capture": "ab" * 32, "seed": "0"}
DONE = {f"y={row}:{row + 2} x=0:20": f"{row:064x}" for row in range(0, 6, 2)}


def opened(file, topics=TOPICS, *, resume=True):
    return open_journal(file, file.with_suffix(""), "map", topics, resume=resume)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """Return the file of one of three blocks."""
    file = tmp_path / "map.zarr.progress"
    with opened(file, resume=False) as journal:
        journal.read()
        journal.begin()
        for name, made_from in DONE.items():
            journal.add(name, made_from)
    return file


def done(file: Path, topics: dict[str, str] = TOPICS) -> dict[str, str]:
    with opened(file, topics) as journal:
        journal.read()
        journal.begin()
        return journal.done


def test_a_line_that_was_cut_off_counts_as_not_there(file: Path) -> None:
    whole = file.read_bytes()
    ends = [at + 1 for at, byte in enumerate(whole) if byte == ord("\n")]
    for length in range(len(whole) + 1):
        file.write_bytes(whole[:length])
        lines = sum(length >= end for end in ends)
        assert done(file) == dict(list(DONE.items())[: max(lines - 1, 0)])
        assert file.read_bytes() == whole[: ends[max(lines, 1) - 1]]  # what follows is a whole line


def test_a_changed_byte_is_one_line_or_names_no_other_block_as_done(file: Path) -> None:
    whole = file.read_bytes()
    head = whole.index(b"\n") + 1
    for at in range(len(whole)):
        for byte in {whole[at] ^ 1, 0xFF, 0x0A} - {whole[at]}:
            changed = whole[:at] + bytes([byte]) + whole[at + 1 :]
            file.write_bytes(changed)
            if at < head:
                with pytest.raises(pb.PolarBayesError, match="progress: ") as error:
                    done(file)
                assert "\n" not in str(error.value)
                assert file.read_bytes() == changed
            else:
                found = done(file)
                right = {name for name in DONE if found.get(name) == DONE[name]}
                assert len(right) >= len(DONE) - 2  # both lines of a changed end


def test_what_is_no_journal_of_this_request_is_refused(file: Path, tmp_path: Path) -> None:
    with pytest.raises(pb.FitError, match="begun with another capture, another seed; repeat"):
        done(file, {"capture": "00" * 32, "seed": "1"})
    with pytest.raises(pb.FitError, match="it was begun with other versions of the libraries"):
        done(file, {**TOPICS, "versions": "jax 1"})
    file.write_text(f"polar_bayes map {TOPICS}\n")
    with pytest.raises(pb.OutputError, match="not the journal of a map that this version can"):
        done(file)
    (tmp_path / "folder.progress").mkdir()
    with pytest.raises(pb.OutputError, match="it is not the journal of a map; move it away, or"):
        done(tmp_path / "folder.progress")


def test_a_journal_in_which_nothing_was_written_is_not_left_behind(tmp_path: Path) -> None:
    file = tmp_path / "map.zarr.progress"
    with pytest.raises(ZeroDivisionError), opened(file):
        _ = 1 / 0
    assert not file.exists()
    file.touch()  # of somebody else
    with pytest.raises(ZeroDivisionError), opened(file):
        _ = 1 / 0
    assert file.exists()


def test_a_journal_that_was_taken_away_is_one_line(file: Path) -> None:
    with opened(file) as journal:
        file.rename(file.with_name("taken"))
        with pytest.raises(pb.OutputError, match="finished, moved or removed it; let one process"):
            journal.add("y=0:2 x=0:20", "")
        file.touch()
        with pytest.raises(pb.OutputError, match="finished, moved or removed it; let one process"):
            journal.add("y=0:2 x=0:20", "")
        journal.end()
    assert file.exists()  # it is another's
