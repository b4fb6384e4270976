"""The journal of a store: what it says is done after a crash, and whose it is."""

from pathlib import Path

import pytest

import polar_bayes as pb
from polar_bayes.maps.blocks import open_journal

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
