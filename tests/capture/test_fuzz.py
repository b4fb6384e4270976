"""Thousands of damaged captures and tables: each is refused in one line, or is inside the contract.

Every mutation comes from a seed. Files are cut short but their bits are not flipped: the HDF5
library itself may hang on a flipped bit of its structure, which no reader above it can stop.
"""

import numpy as np
import pytest
import xarray as xr
from cases import each
from mutations import (
    ODD_ATTRIBUTES,
    ODD_NUMBERS,
    PIECES,
    assert_inside_contract,
    damage_text,
    mutate,
    pick,
    table_text,
)

from polar_bayes.capture.files import load_capture, save_capture
from polar_bayes.capture.schema import LEADING, validate
from polar_bayes.errors import CaptureError
from polar_bayes.importers.columns import read_table
from polar_bayes.importers.detector import read_array, read_frame
from polar_bayes.importers.goniometer import from_goniometer


def sample(count):
    """Seeds, of which the first one is always run."""
    return [0, *(pytest.param(seed, marks=pytest.mark.thorough) for seed in range(1, count))]


def outcome(function, *arguments, **options):
    """Return the result of a reader, or None after a refusal in one line."""
    try:
        return function(*arguments, **options)
    except CaptureError as error:
        message = str(error)
        assert message.isprintable()
        assert message.count(": ") >= 1
        assert "; " in message
        return None


@pytest.mark.filterwarnings("ignore:Duplicate dimension names", "ignore:.*rename", "ignore:.*cast")
@pytest.mark.parametrize("seed", sample(8))
def test_a_damaged_capture_is_refused_or_inside_the_contract(make_capture, tmp_path, seed):
    random = np.random.default_rng([1, seed])
    passed = 0
    for trial in range(400):
        leading = pick(random, LEADING)
        damaged = mutate(make_capture(*leading, spectral=bool(random.integers(2))), random)
        capture = outcome(validate, damaged)
        if capture is None:
            continue
        passed += 1
        assert_inside_contract(capture)
        xr.testing.assert_identical(validate(capture), capture)
        if trial % 10 == 0:
            save_capture(capture, tmp_path / "leaf.nc")
            loaded = load_capture(tmp_path / "leaf.nc")
            xr.testing.assert_identical(loaded, capture.assign_attrs(name=loaded.attrs["name"]))
    assert 40 < passed < 300  # the mutations damage many captures, not all


# --- damaged tables ---------------------------------------------------------------------------


@pytest.mark.parametrize("seed", sample(4))
def test_a_damaged_table_is_refused_or_all_numbers(tmp_path, seed):
    random = np.random.default_rng([2, seed])
    path = tmp_path / "table.txt"
    passed = 0
    for _ in range(500):
        path.write_bytes(damage_text(table_text(random), random))
        table = outcome(read_table, path)
        if table is None:
            continue
        passed += 1
        assert len(table.lines) > 0
        for name in table.names:
            assert name.isprintable()
            assert table.columns[name].shape == table.steps[name].shape == (len(table.lines),)
            blank = np.isnan(table.columns[name])
            assert not blank.any() or f"of {name} taken as no reading" in " ".join(table.notes)
            assert np.isfinite(table.columns[name][~blank]).all()
            assert (table.steps[name][~blank] > 0.0).all()
        if len(table.names) == 3:
            angle, s, p = table.names
            capture = outcome(from_goniometer, table=path, angle=angle, s=s, p=p)
            if capture is not None:
                assert_inside_contract(capture)
                xr.testing.assert_identical(validate(capture), capture)
    assert 100 < passed < 400


@pytest.mark.thorough
@each("seed", range(4))
def test_odd_readings_are_refused_or_inside_the_contract(seed):
    random = np.random.default_rng([3, seed])
    passed = 0
    for _ in range(250):
        channels = []
        for _ in "sp":
            rows = int(random.integers(1, 8))
            angles = np.sort(random.choice(np.arange(0.0, 90.0, 2.5), rows, replace=False))
            readings = 10.0 ** random.uniform(-3.0, 3.0, rows)
            for values in (angles, readings):
                if random.random() < 0.1:
                    values[random.integers(rows)] = pick(random, ODD_NUMBERS)
            channels.append((angles, readings))
        options = {}
        if random.random() < 0.3:
            names = ["dark_level", "relative_error", "s_error", "p_error", "wavelength"]
            options = {pick(random, names): pick(random, [*ODD_NUMBERS, *ODD_ATTRIBUTES])}
        elif random.random() < 0.3:
            options = {"s_incident": 2e3, "p_incident": pick(random, [*ODD_NUMBERS, 2e3])}
        capture = outcome(from_goniometer, *channels, **options)
        if capture is not None:
            passed += 1
            assert_inside_contract(capture)
            xr.testing.assert_identical(validate(capture), capture)
    assert 50 < passed < 230


# --- damaged files ----------------------------------------------------------------------------


@each("format", ["NETCDF4", "NETCDF3_64BIT"])
def test_a_file_cut_short_is_refused(make_capture, tmp_path, format):
    whole = tmp_path / "whole.nc"
    validate(make_capture("patch", spectral=True)).to_netcdf(whole, format=format)
    content = whole.read_bytes()
    expected = load_capture(whole)
    lengths = {*range(64), *np.linspace(0, len(content) - 1, 400, dtype=int).tolist()}
    for length in sorted(lengths):
        # A file of its own each time: HDF5 keeps a damaged file open and would see the old one.
        path = tmp_path / f"{length}.nc"
        path.write_bytes(content[:length])
        capture = outcome(load_capture, path)
        if capture is not None:  # nothing but padding was lost
            xr.testing.assert_identical(capture, expected)
        path.unlink()


# --- damaged .npy frames ----------------------------------------------------------------------

FRAMES = [
    np.arange(12.0).reshape(3, 4), np.asfortranarray(np.arange(12.0).reshape(3, 4)),
    np.arange(12, dtype=">u2").reshape(3, 4), np.float64(3.5), np.zeros((0, 3)),
    np.zeros(3, dtype=[("a", "f4"), ("b", "i2")]),
]  # fmt: skip


@pytest.mark.thorough
@each("seed", range(2))
def test_a_damaged_header_is_refused_or_of_the_same_size(tmp_path, seed):
    random = np.random.default_rng([4, seed])
    passed = 0
    for trial in range(600):
        path = tmp_path / f"{trial}.npy"
        frame = np.asarray(pick(random, FRAMES))
        np.save(path, frame)
        content = bytearray(path.read_bytes())
        for _ in range(random.integers(1, 4)):
            place = int(random.integers(128))
            if random.random() < 0.5:
                content[place] ^= 1 << int(random.integers(8))
            else:
                content[place : place + 1] = pick(random, PIECES).encode()
        path.write_bytes(content)
        found = outcome(read_array, path, "frame")
        if found is not None:
            passed += 1
            assert type(found) is np.ndarray
            assert found.nbytes == frame.nbytes
            outcome(read_frame, path, "frame")
    assert 5 < passed < 300


@each("frame", FRAMES, ids=str)
def test_a_whole_npy_file_is_read_as_it_was_saved(tmp_path, frame):
    np.save(tmp_path / "frame.npy", frame)
    found = read_array(tmp_path / "frame.npy", "frame")
    assert type(found) is np.ndarray
    np.testing.assert_array_equal(found, frame, strict=True)


@pytest.mark.thorough
@each(
    ("shape", "what"),
    [
        ("(1000000000000, 8)", "cannot be read"),
        (f"({2**70}, 1)", "cannot be read"),
        ("(" * 300 + ")" * 300, "cannot be read"),
        ("(3, 4", "cannot be read"),
        ("(3, -4)", "cannot be read"),
        ("(3, 2)", "its header declares 48 bytes of numbers"),
    ],
)
def test_a_size_that_is_not_that_of_the_file_is_refused(tmp_path, shape, what):
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".encode()
    start = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little")
    path = tmp_path / "frame.npy"
    path.write_bytes(start + header + np.zeros(12).tobytes())
    with pytest.raises(CaptureError, match=what):
        read_array(path, "frame")


@pytest.mark.thorough
def test_several_arrays_are_no_frame(tmp_path):
    np.savez(tmp_path / "frames.npz", np.zeros(3))
    (tmp_path / "frame.npy").write_bytes((tmp_path / "frames.npz").read_bytes())
    with pytest.raises(CaptureError, match="it holds several arrays; save one array"):
        read_array(tmp_path / "frame.npy", "frame")
