"""Outputs: never an input, a device, a folder or a file of another kind; whole and synced."""

import os
import stat
from pathlib import Path

import numpy as np
import pytest
from cases import each
from plates import plate_capture

import polar_bayes as pb
from polar_bayes import interrupts, paths


@pytest.fixture
def capture():
    return plate_capture(np.linspace(20.0, 75.0, 6), 0.01, seed=2)


def write(capture, path: Path) -> None:
    pb.save_capture(capture, path)


def leftovers(folder: Path) -> list[str]:
    return [path.name for path in folder.rglob("*") if path.name.startswith(paths.TEMPORARY_PREFIX)]


def test_an_older_file_keeps_its_mode(capture, tmp_path):
    file = tmp_path / "plate.nc"
    write(capture, file)
    file.chmod(0o600)
    write(capture.assign_attrs(name="other"), file)
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert pb.load_capture(file).attrs["name"] == "other"


def test_a_link_stays_a_link_and_what_it_points_to_is_replaced(capture, tmp_path):
    (tmp_path / "far").mkdir()
    link, target = tmp_path / "plate.nc", tmp_path / "far" / "real.nc"
    link.symlink_to(target)
    write(capture, link)
    write(capture, link)
    assert link.is_symlink()
    assert pb.load_capture(target).sizes == capture.sizes
    assert not leftovers(tmp_path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="only POSIX systems have named pipes")
def test_a_device_or_pipe_is_not_replaced(capture, tmp_path):
    pipe = tmp_path / "pipe.nc"
    os.mkfifo(pipe)
    for place in (pipe, Path(os.devnull)):
        with pytest.raises(pb.OutputError, match="it is no regular file"):
            write(capture, place)
    assert stat.S_ISFIFO(pipe.stat().st_mode)


@pytest.mark.thorough
@each("content", [b"angle,s,p\n1,2,3\n", b"\x89PNG\r\n", b"\x89HDF\r\n\x1a\n..."])
def test_a_file_of_another_kind_is_not_replaced(capture, tmp_path, content):
    file = tmp_path / "mine"
    file.write_bytes(content)
    with pytest.raises(pb.OutputError, match="mine: the file there holds something else; give ano"):
        write(capture, file)
    assert file.read_bytes() == content
    assert not leftovers(tmp_path)


@pytest.mark.thorough
def test_an_empty_file_may_be_written(capture, tmp_path):
    file = tmp_path / "made-by-mktemp.nc"
    file.touch(mode=0o600)
    write(capture, file)
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert pb.load_capture(file).sizes == capture.sizes


@pytest.mark.thorough
def test_a_circle_of_links_is_one_line(capture, tmp_path):
    one, other = tmp_path / "one.nc", tmp_path / "other.nc"
    one.symlink_to(other)
    other.symlink_to(one)
    with pytest.raises(pb.OutputError, match=r"could not be written|no regular file"):
        write(capture, one)


def test_an_input_is_found_under_any_name(capture, tmp_path):
    source, linked, hard = (tmp_path / name for name in ("a.nc", "link.nc", "hard.nc"))
    write(capture, source)
    linked.symlink_to(source)
    hard.hardlink_to(source)
    for name in (source, linked, hard, tmp_path / "x" / ".." / "a.nc"):
        with pytest.raises(pb.OutputError, match="it is one of the inputs"):
            paths.check_output(name, lambda _: True, [source])
    with pytest.raises(pb.OutputError, match="it lies inside one of the inputs"):
        paths.check_output(tmp_path / "new.nc", lambda _: True, [tmp_path])


@pytest.mark.thorough
def test_what_is_moved_is_synced_before_and_its_folder_after(capture, tmp_path, monkeypatch):
    did = []
    monkeypatch.setattr(os, "fsync", lambda opened: did.append(Path(f"/proc/self/fd/{opened}")))
    monkeypatch.setattr(paths, "sync", _noting(did, paths.sync))
    replace = Path.replace
    monkeypatch.setattr(Path, "replace", lambda a, b: (did.append("moved"), replace(a, b))[1])
    write(capture, tmp_path / "plate.nc")
    names = [each for each in did if isinstance(each, str)]
    assert names == ["synced plate.nc", "moved", f"synced {tmp_path.name}"]


def _noting(did, sync):
    def note(path: Path) -> None:
        did.append(f"synced {path.name}")
        sync(path)

    return note


def test_an_interrupt_removes_what_is_not_finished(capture, tmp_path):
    with paths.atomic_write(tmp_path / "plate.nc", lambda _: True) as unfinished:
        unfinished.write_bytes(b"half")
        assert leftovers(tmp_path)
        assert interrupts.clean_up() == []
        assert not leftovers(tmp_path)
        unfinished.parent.mkdir()
        unfinished.write_bytes(b"whole")


def test_cleanups_run_newest_first_whatever_the_others_do():
    did = []

    def fail() -> None:
        did.append("fails")
        raise RuntimeError

    with (
        interrupts.on_interrupt(lambda: did.append("outer") or "go on with --resume"),
        interrupts.on_interrupt(fail),
        interrupts.on_interrupt(lambda: did.append("inner")),
    ):
        assert interrupts.clean_up() == ["go on with --resume"]
    assert did == ["inner", "fails", "outer"]
    assert interrupts.clean_up() == []
