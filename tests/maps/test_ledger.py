"""The ledger of a map: locked by one process at a time, believed line by line."""

import signal
import subprocess
import sys
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

import polar_bayes as pb
from polar_bayes.maps.blocks import Entry, Ledger, locked_ledger

REQUEST = "ab" * 32
ENTRIES = {f"y={row}:{row + 2} x=0:20": Entry(f"{row:064x}", "cd" * 32) for row in range(0, 6, 2)}

HOLDER = """
import pathlib, sys, time
from polar_bayes.maps.blocks import locked_ledger
file = pathlib.Path(sys.argv[1])
with locked_ledger(file, file.with_suffix(""), "map", {}, resume=True):
    print("locked", flush=True)
    time.sleep(600)
"""


def locked(file: Path, request: str = REQUEST, *, resume: bool) -> AbstractContextManager[Ledger]:
    fingerprint = {"capture or other settings": request}
    return locked_ledger(file, file.with_suffix(""), "map", fingerprint, resume=resume)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """Of three blocks."""
    file = tmp_path / "map.zarr.progress"
    with locked(file, resume=False) as ledger:
        ledger.read()
        ledger.begin()
        for label, entry in ENTRIES.items():
            ledger.add(label, entry)
    return file


def entries(file: Path, request: str = REQUEST) -> dict[str, Entry]:
    with locked(file, request, resume=True) as ledger:
        ledger.read()
        ledger.begin()
        return ledger.entries


def test_it_is_read_as_it_was_written(file: Path) -> None:
    whole = file.read_bytes()
    assert entries(file) == ENTRIES
    assert file.read_bytes() == whole


def test_a_line_that_was_cut_off_counts_as_not_there(file: Path) -> None:
    whole = file.read_bytes()
    ends = [at + 1 for at, byte in enumerate(whole) if byte == ord("\n")]
    for length in range(len(whole)):
        file.write_bytes(whole[:length])
        lines = sum(length >= end for end in ends)
        assert entries(file) == dict(list(ENTRIES.items())[: max(lines - 1, 0)])
        assert file.read_bytes() == whole[: ends[max(lines, 1) - 1]]  # what follows is a whole line


def test_every_changed_byte_is_one_line(file: Path) -> None:
    whole = file.read_bytes()
    for at in range(len(whole) - 1):  # without its end the last line was cut off
        for byte in {whole[at] ^ 1, 0xFF, 0x0A} - {whole[at]}:
            changed = whole[:at] + bytes([byte]) + whole[at + 1 :]
            file.write_bytes(changed)
            with pytest.raises(pb.PolarBayesError, match="progress: ") as error:
                entries(file)
            assert "\n" not in str(error.value)
            assert file.read_bytes() == changed
    line = whole.index(b"\n") + 5
    file.write_bytes(whole[:line] + b"\xff" + whole[line + 1 :])
    with pytest.raises(pb.OutputError, match="line 2 is damaged; remove that file to fit all"):
        entries(file)


def test_what_is_no_ledger_of_this_map_is_refused_and_left_alone(
    file: Path, tmp_path: Path
) -> None:
    whole = file.read_bytes()
    with pytest.raises(pb.FitError, match="begun with another capture or other settings"):
        entries(file, "00" * 32)
    with (
        pytest.raises(pb.OutputError, match="it is there already"),
        locked(file, resume=False),
    ):
        pass
    assert file.read_bytes() == whole
    other = tmp_path / "other.progress"
    other.write_text("shopping list")
    with pytest.raises(pb.OutputError, match="it is not the ledger of a map; move that file"):
        entries(other)
    assert other.read_text() == "shopping list"
    other.unlink()
    other.mkdir()
    with pytest.raises(pb.OutputError, match="it is not the ledger of a map"):
        entries(other)


@pytest.mark.thorough
def test_a_ledger_in_which_nothing_was_written_is_not_left_behind(tmp_path: Path) -> None:
    file = tmp_path / "map.zarr.progress"
    with pytest.raises(ZeroDivisionError), locked(file, resume=True):
        _ = 1 / 0
    assert not file.exists()
    file.touch()  # of somebody else
    with pytest.raises(ZeroDivisionError), locked(file, resume=True):
        _ = 1 / 0
    assert file.exists()


def test_a_second_process_is_refused_and_a_killed_one_leaves_no_lock(file: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER, file], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "locked\n"
        with pytest.raises(pb.OutputError, match=r"map\.zarr: another process is writing it; wait"):
            entries(file)
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert [path.name for path in file.parent.iterdir()] == [file.name]
    assert entries(file) == ENTRIES


@pytest.mark.thorough
def test_a_ledger_that_was_taken_away_is_one_line(file: Path) -> None:
    with locked(file, resume=True) as ledger:
        file.rename(file.with_name("taken"))
        with pytest.raises(pb.OutputError, match="finished, moved or removed it; let one process"):
            ledger.add("y=0:2 x=0:20", Entry("", ""))
        file.touch()
        with pytest.raises(pb.OutputError, match="finished, moved or removed it; let one process"):
            ledger.add("y=0:2 x=0:20", Entry("", ""))
        ledger.end()
    assert file.exists()  # it is another's
