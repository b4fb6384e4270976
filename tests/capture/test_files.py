"""Captures in files: identical after a round trip, and never half written."""

import os
import subprocess
import sys
from pathlib import Path

import netCDF4
import numpy as np
import pytest
import xarray as xr
from cases import each

from polar_bayes.capture.files import load_capture, save_capture
from polar_bayes.capture.schema import LEADING, validate
from polar_bayes.errors import CaptureError, OutputError


def assert_same(left, right):
    """Equal values, dims, attributes and dtypes."""
    xr.testing.assert_identical(left, right)
    for name in left.variables:
        assert left[name].dtype == right[name].dtype


@each("leading", LEADING, ids=str)
@each("spectral", [False, True])
def test_a_round_trip_is_identical(make_capture, tmp_path, leading, spectral):
    capture = validate(make_capture(*leading, spectral=spectral))
    save_capture(capture, tmp_path / "leaf.nc")
    assert_same(load_capture(tmp_path / "leaf.nc"), capture)
    assert os.listdir(tmp_path) == ["leaf.nc"]


@pytest.mark.thorough
def test_a_round_trip_keeps_labels_gaps_and_odd_text(make_capture, tmp_path):
    capture = make_capture("material", spectral=True)
    capture = capture.assign_coords(material=["../x", "<script>", "Öl 油"])
    capture["dop"][:, :, 1] = np.nan
    capture["dop"].attrs |= {"note": "two\nlines", "valid_range": np.array([0.0, 1.0])}
    capture = validate(capture.assign_attrs(empty="", nothing=np.nan, bytes=b"\xff\0"))
    save_capture(capture, str(tmp_path / "leaf.nc"))
    assert_same(load_capture(str(tmp_path / "leaf.nc")), capture)


def test_a_capture_is_named_after_its_file_unless_it_has_a_name(make_capture, tmp_path):
    capture = make_capture()
    save_capture(capture, tmp_path / "beech.nc")
    assert load_capture(tmp_path / "beech.nc").attrs["name"] == "leaf"
    del capture.attrs["name"]
    save_capture(capture, tmp_path / "beech.nc")
    assert load_capture(tmp_path / "beech.nc").attrs["name"] == "beech"


@pytest.mark.thorough
def test_a_loaded_capture_needs_its_file_no_more(make_capture, tmp_path):
    path = tmp_path / "leaf.nc"
    save_capture(make_capture(), path)
    capture = load_capture(path)
    path.unlink()
    assert np.isfinite(capture["dop"].values).all()


@pytest.mark.thorough
@each("name", ["a b.nc", "x#mode=zarr.nc", "<script>.nc", "http:", "Öl\n.nc"])
def test_odd_file_names_are_file_names(make_capture, tmp_path, name):
    save_capture(make_capture(), tmp_path / name)
    assert_same(load_capture(tmp_path / name), validate(make_capture()))


def test_an_older_capture_is_replaced(make_capture, tmp_path):
    save_capture(make_capture(seed=1), tmp_path / "leaf.nc")
    save_capture(make_capture(seed=2), tmp_path / "leaf.nc")
    assert_same(load_capture(tmp_path / "leaf.nc"), validate(make_capture(seed=2)))


@pytest.mark.thorough
def test_errors_name_the_file_and_the_view(make_capture, tmp_path):
    capture = make_capture()
    capture["dop"][3] = 1.5
    capture.to_netcdf(tmp_path / "leaf.nc")
    with pytest.raises(CaptureError, match=r"leaf\.nc: dop\[view=3\]: 1\.5 is outside .*valid=Fal"):
        load_capture(tmp_path / "leaf.nc")


# --- files by other hands ---------------------------------------------------------------------


@pytest.fixture
def foreign(make_capture, tmp_path):
    """A netCDF file with geometry, opened with the bare library to add what one likes."""
    path = tmp_path / "foreign.nc"
    names = ["view_zenith", "view_azimuth", "light_zenith", "light_azimuth"]
    make_capture()[names].to_netcdf(path)
    with netCDF4.Dataset(path, "a") as file:
        yield file


def load_foreign(file):
    path = file.filepath()
    file.sync()
    return load_capture(path)


def test_packed_integers_are_unpacked_and_gaps_are_seen(foreign):
    dop = foreign.createVariable("dop", "i2", ("view",), fill_value=-1)
    dop.scale_factor = 0.001
    dop[:] = np.ma.masked_equal([0.1, 0.2, 9.0, 0.4, 0.5], 9.0)
    with pytest.raises(CaptureError, match=r"dop\[view=2\]: nan is outside .*mark it valid=False"):
        load_foreign(foreign)
    valid = foreign.createVariable("valid", "i1", ("view",), fill_value=-128)
    valid[:] = [1, 1, 0, 1, 1]
    capture = load_foreign(foreign)
    np.testing.assert_allclose(capture["dop"], [0.1, 0.2, np.nan, 0.4, 0.5], atol=1e-12)
    assert capture["valid"].dtype == bool


@pytest.mark.thorough
def test_time_units_do_nothing(foreign):
    foreign.createVariable("intensity", "f8", ("view",))[:] = 1.0
    foreign["intensity"].units = "days since 2000-01-01"
    np.testing.assert_array_equal(load_foreign(foreign)["intensity"], np.ones(5))


RAGGED = np.array([np.ones(count) for count in range(1, 6)], object)
PAIR = np.dtype([("a", "f8"), ("b", "f8")])
NO_NUMBERS = {
    "text": (lambda file: str, np.array(["0.1"] * 5, object)),
    "characters": (lambda file: "S1", np.array(list("01234"), "S1")),
    "ragged": (lambda file: file.createVLType(np.float64, "ragged"), RAGGED),
    "records": (lambda file: file.createCompoundType(PAIR, "pair"), np.zeros(5, PAIR)),
}


@pytest.mark.parametrize("kind", NO_NUMBERS)
def test_what_is_no_number_is_no_reading(foreign, kind):
    make, values = NO_NUMBERS[kind]
    foreign.createVariable("dop", make(foreign), ("view",))[:] = values
    says = r"foreign\.nc: (dop: it holds|dop: it|it cannot be read)"
    with pytest.raises(CaptureError, match=says):
        load_foreign(foreign)


@pytest.mark.thorough
def test_attributes_of_arrays_are_kept_as_text(foreign):
    foreign.createVariable("dop", "f8", ("view",))[:] = 0.5
    foreign["dop"].valid_range = np.array([0.0, 1.0])
    foreign.setncattr_string("authors", ["Ada", "Emmy"])
    capture = load_foreign(foreign)
    assert capture["dop"].attrs["valid_range"] == "[0.0, 1.0]"
    assert capture.attrs["authors"] == "['Ada', 'Emmy']"


def test_wrong_packing_is_a_clear_error(foreign):
    foreign.createVariable("dop", "f8", ("view",))[:] = 0.5
    foreign["dop"].scale_factor = "much"
    with pytest.raises(CaptureError, match="it cannot be read as netCDF; write it again"):
        load_foreign(foreign)


# --- files that cannot be read or written -----------------------------------------------------


@pytest.mark.thorough
@each("path", [None, 3, "", "a\0b", b"leaf.nc"])
def test_what_is_no_path_is_refused(make_capture, path):
    with pytest.raises(CaptureError, match=r"capture: .* is not a path; give the path of a file"):
        load_capture(path)
    with pytest.raises(OutputError, match=r"output: .* is not a path; give the path of a file"):
        save_capture(make_capture(), path)


def test_files_that_are_not_there_or_empty_are_named(tmp_path):
    with pytest.raises(CaptureError, match=r"gone\.nc: there is no such file; check the path"):
        load_capture(tmp_path / "gone.nc")
    with pytest.raises(CaptureError, match="it is a folder or device; give the path of a file"):
        load_capture(tmp_path)
    (tmp_path / "empty.nc").touch()
    with pytest.raises(CaptureError, match=r"empty\.nc: the file is empty; write it again"):
        load_capture(tmp_path / "empty.nc")
    with pytest.raises(CaptureError, match="name too long; check the path"):
        load_capture(tmp_path / ("x" * 300))


@each("content", [b"view,dop\n1,2\n", b"\x89HDF\r\n\x1a\n", b"CDF\x01", b"PK"])
def test_what_is_not_netcdf_is_refused(tmp_path, content):
    path = tmp_path / "leaf.nc"
    path.write_bytes(content)
    with pytest.raises(CaptureError, match=r"leaf\.nc: it cannot be read as netCDF; write it ag"):
        load_capture(path)


@pytest.mark.thorough
def test_a_file_without_rights_is_named(make_capture, tmp_path, monkeypatch):
    path = tmp_path / "leaf.nc"
    save_capture(make_capture(), path)

    def refuse(*arguments, **options):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(xr, "open_dataset", refuse)
    with pytest.raises(CaptureError, match=r"leaf\.nc: permission denied; check the path, its ri"):
        load_capture(path)


def test_a_place_that_cannot_be_written_is_named(make_capture, tmp_path):
    capture = make_capture()
    with pytest.raises(OutputError, match="its folder is not there; make the folder first"):
        save_capture(capture, tmp_path / "gone" / "leaf.nc")
    with pytest.raises(OutputError, match="it is a folder; give the path of a file"):
        save_capture(capture, tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="its folder is not there; make the folder first"):
        save_capture(capture, tmp_path / "file" / "leaf.nc")
    with pytest.raises(OutputError, match="name too long"):
        save_capture(capture, tmp_path / ("x" * 300))


# --- damaged files ----------------------------------------------------------------------------


def flip(path, found, at=3):
    """Flip a bit of what stands in a file, once, as these bytes."""
    content = bytearray(path.read_bytes())
    assert content.count(found) == 1
    content[content.index(found) + at] ^= 1
    damaged = path.with_stem("damaged")  # HDF5 keeps a damaged file open: a name of its own
    damaged.unlink(missing_ok=True)
    damaged.write_bytes(content)
    return damaged


@each("part", ["dop", "view_zenith", "valid", "wavelength", "true_exposure", "patch", "note"])
def test_a_flipped_bit_is_an_error_and_no_value(make_capture, tmp_path, part):
    random = np.random.default_rng(0)
    capture = make_capture("patch", spectral=True).assign(true_exposure=((), 1.2345678901))
    capture["dop"][:] = random.uniform(0.1, 0.9, capture["dop"].shape)
    capture["view_zenith"][:] = random.uniform(1.0, 80.0, capture["view_zenith"].shape)
    valid = random.uniform(size=capture["dop"].shape) < 0.9
    capture = capture.assign(valid=(capture["dop"].dims, valid))
    capture = capture.assign_coords(
        patch=[f"a long label {k}" for k in range(capture.sizes["patch"])]
    ).assign_attrs(note="measured on a rainy day")
    save_capture(capture, tmp_path / "leaf.nc")
    assert_same(load_capture(tmp_path / "leaf.nc"), validate(capture.assign_attrs(name="leaf")))
    found = b"rainy" if part == "note" else validate(capture)[part].values.tobytes()
    if part == "patch":
        found = b"long label 1"
    damaged = flip(tmp_path / "leaf.nc", found)
    with pytest.raises(CaptureError, match=r"damaged\.nc: its checksum is wrong: .*; restore it"):
        load_capture(damaged)


@pytest.mark.thorough
def test_a_file_edited_elsewhere_has_no_checksum(make_capture, tmp_path):
    save_capture(make_capture(), tmp_path / "leaf.nc")
    with xr.open_dataset(tmp_path / "leaf.nc", engine="netcdf4") as opened:
        edited = opened.load()
    xr.testing.assert_identical(edited, validate(make_capture()))
    edited["dop"][0] = 0.25
    edited.to_netcdf(tmp_path / "edited.nc")
    assert load_capture(tmp_path / "edited.nc")["dop"][0] == 0.25
    with netCDF4.Dataset(tmp_path / "leaf.nc", "r+") as file:
        file["dop"][0] = 0.5
    assert load_capture(tmp_path / "leaf.nc")["dop"][0] == 0.5


@each(
    ("damage", "what"),
    [
        (lambda content: content[:-1], "its checksum is wrong"),
        (lambda content: content[:-60], "its checksum is wrong"),
        (lambda content: content + b"more", "its checksum is wrong"),
        (lambda content: content[:-200], "it cannot be read as netCDF"),
    ],
)
def test_a_file_that_was_cut_short_or_grew_is_refused(make_capture, tmp_path, damage, what):
    path = tmp_path / "leaf.nc"
    save_capture(make_capture(), path)
    other = tmp_path / "other.nc"
    other.write_bytes(damage(path.read_bytes()))
    with pytest.raises(CaptureError, match=rf"other\.nc: {what}"):
        load_capture(other)


def test_what_is_no_capture_is_not_written(make_capture, tmp_path):
    with pytest.raises(CaptureError, match=r"view_zenith: it is missing; add view_zenith in deg"):
        save_capture(make_capture().drop_vars("view_zenith"), tmp_path / "leaf.nc")
    assert os.listdir(tmp_path) == []


@each("error", [OSError(28, "No space left on device"), RuntimeError("HDF")])
def test_a_failed_write_leaves_the_older_capture(make_capture, tmp_path, monkeypatch, error):
    path = tmp_path / "leaf.nc"
    save_capture(make_capture(seed=1), path)

    def fail(dataset, target, **options):
        Path(target).write_bytes(b"half")
        raise error

    monkeypatch.setattr(xr.Dataset, "to_netcdf", fail)
    with pytest.raises(OutputError, match=r"leaf\.nc: it could not be written \((no space|hdf)"):
        save_capture(make_capture(seed=2), path)
    monkeypatch.undo()
    assert os.listdir(tmp_path) == ["leaf.nc"]
    assert_same(load_capture(path), validate(make_capture(seed=1)))


FULL_DISK = """
import resource, sys
from polar_bayes.capture.files import load_capture, save_capture
from polar_bayes.errors import OutputError
capture = load_capture(sys.argv[1])
resource.setrlimit(resource.RLIMIT_FSIZE, (5000, resource.RLIM_INFINITY))
try:
    save_capture(capture, sys.argv[1])
except OutputError as error:
    sys.exit(f"OutputError: {error}")
"""


@pytest.mark.thorough
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no limit on file sizes")
def test_a_full_disk_is_an_error_and_leaves_the_older_capture(make_capture, tmp_path):
    """In a process of its own, since the netCDF library is left in disorder."""
    path = tmp_path / "leaf.nc"
    save_capture(make_capture(), path)
    root = Path(__file__).parents[2]
    run = subprocess.run(
        [sys.executable, "-c", FULL_DISK, path],
        capture_output=True,
        text=True,
        cwd=root,
        check=False,
    )
    assert run.stderr.startswith("OutputError: ")
    assert "could not be written (netcdf: hdf error); check the path" in run.stderr
    assert os.listdir(tmp_path) == ["leaf.nc"]
    assert_same(load_capture(path), validate(make_capture()))
