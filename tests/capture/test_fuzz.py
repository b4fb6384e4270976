"""Thousands of damaged captures and tables: each is refused in one line, or is inside the contract.

Every mutation comes from a seed. Files are cut short but their bits are not flipped: the HDF5
library itself may hang on a flipped bit of its structure, which no reader above it can stop.
"""

import math

import numpy as np
import pytest
import xarray as xr

from polar_bayes.capture.contract import LEADING
from polar_bayes.capture.files import load_capture, save_capture
from polar_bayes.capture.frames import read_array, read_frame
from polar_bayes.capture.goniometer import from_goniometer
from polar_bayes.capture.schema import count, validate
from polar_bayes.capture.tables import read_table
from polar_bayes.errors import CaptureError

ODD_NAMES = [
    "../x", "<script>alert(1)</script>", "a\nb", "Öl 油", "", " ", "true_", "true_\N{SNOWMAN}",
    "DOP", "dop ", "view", "wavelength", "y", "material", "_FillValue", "\ud800", "x" * 1000, 7,
    None, ("a",),
]  # fmt: skip
ODD_NUMBERS = [
    math.nan, math.inf, -math.inf, 0.0, -0.0, -1.0, 1.0, 1.0 + 1e-15, 89.999999, 90.0, 180.0, 361.0,
    1e-320, 1e-31, 1e30, 1e300, -1e300, 2.0**63,
]  # fmt: skip
ODD_ATTRIBUTES = [
    None, True, 3, 10**30, math.nan, math.inf, "radian", "", "two\nlines", "\0", "\ud800",
    b"\xff", (), [1, 2], ["a"], [[1], [1, 2]], {"a": 1}, np.arange(3), np.array("x"),
    np.float32(0.1), np.bool_(True), np.datetime64("2020-01-01"), 1j, object(), print,
    np.array([None]),
]  # fmt: skip
ODD_TYPES = ["U3", "S3", "object", "complex64", "bool", "M8[ns]", "m8[ns]", "int8", "uint64"]
ODD_TYPES += ["float16", "float32", "longdouble"]


def pick(random, options):
    return options[random.integers(len(options))]


def any_variable(capture, random):
    return pick(random, list(capture.variables))


# --- mutations of a capture: each takes a dataset and gives another ---------------------------


def drop(capture, random):
    return capture.drop_vars(any_variable(capture, random))


def rename(capture, random):
    return capture.rename({any_variable(capture, random): pick(random, ODD_NAMES)})


def add(capture, random):
    return capture.assign({pick(random, ODD_NAMES): capture[any_variable(capture, random)]})


def swap(capture, random):
    one, other = any_variable(capture, random), any_variable(capture, random)
    return capture.assign({one: capture[other], other: capture[one]})


def retype(capture, random):
    name = any_variable(capture, random)
    values = np.asarray(capture[name].values)
    return capture.assign({name: (capture[name].dims, values.astype(pick(random, ODD_TYPES)))})


def renumber(capture, random):
    name = any_variable(capture, random)
    values = np.array(capture[name].values, dtype=np.float64)
    values.ravel()[random.integers(values.size)] = pick(random, ODD_NUMBERS)
    return capture.assign({name: (capture[name].dims, values)})


def fill(capture, random):
    name = any_variable(capture, random)
    return capture.assign({name: xr.full_like(capture[name], pick(random, ODD_NUMBERS), float)})


def transpose(capture, random):
    return capture.transpose(*random.permutation(list(capture.sizes)))


def rename_dim(capture, random):
    dim = pick(random, list(capture.sizes))
    return capture.swap_dims(
        {dim: pick(random, ["x", "y", "view", "patch", "angle", "<b>", "wavelength"])}
    )


def select(capture, random):
    dim = pick(random, list(capture.sizes))
    return capture.isel({dim: pick(random, [0, slice(0), slice(1), [0, 0], slice(None, None, -1)])})


def widen(capture, random):
    name = any_variable(capture, random)
    return capture.assign({name: capture[name].expand_dims({pick(random, ["patch", "t", "y"]): 2})})


def annotate(capture, random):
    capture = capture.copy()
    owner = capture if random.random() < 0.3 else capture[any_variable(capture, random)]
    names = ["units", "saturation_level", "name", "long_name", *ODD_NAMES]
    owner.attrs[pick(random, names)] = pick(random, ODD_ATTRIBUTES)
    return capture


def label(capture, random):
    dim = pick(random, list(capture.sizes))
    values = [pick(random, [*ODD_NUMBERS, *ODD_NAMES]) for _ in range(capture.sizes[dim])]
    cells = np.empty(len(values), dtype=object)
    cells[:] = values
    kind = pick(random, [object, str])
    return capture.assign_coords(
        {dim: (dim, np.array([str(v) for v in values]) if kind is str else cells)}
    )


MUTATIONS = (
    drop, rename, add, swap, retype, renumber, renumber, fill, transpose, rename_dim, select, widen,
    annotate, annotate, label,
)  # fmt: skip


def mutate(capture, random):
    """One to three mutations; those that xarray itself refuses are no captures."""
    for _ in range(random.integers(1, 4)):
        mutation = pick(random, MUTATIONS)
        try:
            capture = mutation(capture, random)
        except (ValueError, TypeError, KeyError, IndexError, UnicodeError, OverflowError):
            continue
    return capture


def assert_inside_contract(capture):
    """The contract once more, in other words than the schema's."""
    dims = next(capture[name].dims for name in ("dop", "q", "intensity") if name in capture)
    seen = capture["valid"].values if "valid" in capture else ...
    for name in ("view_zenith", "light_zenith"):
        assert ((capture[name] >= 0.0) & (capture[name] < 90.0)).all()
    for name in ("view_azimuth", "light_azimuth"):
        assert (abs(capture[name]) <= 360.0).all()
    bounds = {"dop": (0.0, 1.0), "q": (-1.0, 1.0), "u": (-1.0, 1.0), "intensity": (0.0, 1e30)}
    for name, (low, high) in bounds.items():
        if name in capture:
            assert capture[name].dims == dims
            values = capture[name].values[seen]
            assert ((values >= low) & (values <= high)).all()
        if f"{name}_error" in capture:
            assert (capture[f"{name}_error"].values[seen] > 0.0).all()
    for variable in capture.variables.values():
        assert isinstance(variable.attrs["units"], str)
        assert isinstance(variable.attrs["long_name"], str)
        assert all(type(value) in (str, int, float) for value in variable.attrs.values())
    assert all(type(value) in (str, int, float) for value in capture.attrs.values())
    counted = count(capture)
    assert 0 <= counted["masked"] < counted["views"]


def outcome(function, *arguments, **options):
    """What comes out of a door: None after a refusal in one line, anything else is returned."""
    try:
        return function(*arguments, **options)
    except CaptureError as error:
        message = str(error)
        assert message.isprintable()
        assert message.count(": ") >= 1
        assert "; " in message
        return None


@pytest.mark.filterwarnings("ignore:Duplicate dimension names", "ignore:.*rename", "ignore:.*cast")
@pytest.mark.parametrize("seed", range(8))
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

PIECES = [
    "nan", "inf", "1e999", "-1e999", "1e-999", "0x1", "1_0", "1,5", "1.5.2", "--1", "", "x", "\0",
    "\n", "\r", "\t", ";", ",", " ", "#", '"', "\N{SNOWMAN}", "\x85", "\u2028", "<script>",
    "9" * 400, "e", "E5", ".", "__import__('os').system('true')",
]  # fmt: skip


def table_text(random):
    """A good table in one of the forms that are read."""
    separator = pick(random, ["\t", ",", ";", " ", "\t\t", ", "])
    comma = separator in "\t; " and random.random() < 0.3
    rows = [["angle", "s", "p"]] if random.random() < 0.5 else []
    for angle in range(20, 80, 10):
        rows.append([str(angle), *(f"{value:.2f}" for value in random.uniform(1.0, 90.0, 2))])
    text = pick(random, ["\n", "\r\n"]).join(separator.join(row) for row in rows)
    return text.replace(".", ",") if comma else text


def damage_text(text, random):
    content = bytearray(text, "utf-8")
    for _ in range(random.integers(0, 4)):
        place = int(random.integers(len(content) + 1))
        match random.integers(4):
            case 0:
                content[place:place] = pick(random, PIECES).encode()
            case 1:
                del content[place : place + int(random.integers(1, 9))]
            case 2:
                content = content[: max(place, 1)]
            case 3 if place < len(content):
                content[place] ^= 1 << int(random.integers(8))
    return bytes(content)


@pytest.mark.parametrize("seed", range(4))
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
            assert np.isfinite(table.columns[name]).all()
            assert (table.steps[name] > 0.0).all()
        if len(table.names) == 3:
            angle, s, p = table.names
            capture = outcome(from_goniometer, table=path, angle=angle, s=s, p=p)
            if capture is not None:
                assert_inside_contract(capture)
                xr.testing.assert_identical(validate(capture), capture)
    assert 100 < passed < 400


@pytest.mark.parametrize("seed", range(4))
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


@pytest.mark.parametrize("format", ["NETCDF4", "NETCDF3_64BIT"])
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


@pytest.mark.parametrize("seed", range(2))
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


@pytest.mark.parametrize("frame", FRAMES, ids=str)
def test_a_whole_npy_file_is_read_as_it_was_saved(tmp_path, frame):
    np.save(tmp_path / "frame.npy", frame)
    found = read_array(tmp_path / "frame.npy", "frame")
    assert type(found) is np.ndarray
    np.testing.assert_array_equal(found, frame, strict=True)


@pytest.mark.parametrize(
    ("shape", "what"),
    [
        ("(1000000000000, 8)", "cannot be read"),
        (f"({2**70}, 1)", "cannot be read"),
        ("(" * 300 + ")" * 300, "cannot be read"),
        ("(3, 4", "cannot be read"),
        ("(3, -4)", "cannot be read"),
        ("(3, 2)", "its header says 48 bytes of numbers"),
    ],
)
def test_a_size_that_is_not_that_of_the_file_is_refused(tmp_path, shape, what):
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".encode()
    start = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little")
    path = tmp_path / "frame.npy"
    path.write_bytes(start + header + np.zeros(12).tobytes())
    with pytest.raises(CaptureError, match=what):
        read_array(path, "frame")


def test_several_arrays_are_no_frame(tmp_path):
    np.savez(tmp_path / "frames.npz", np.zeros(3))
    (tmp_path / "frame.npy").write_bytes((tmp_path / "frames.npz").read_bytes())
    with pytest.raises(CaptureError, match="it holds several arrays; save one array"):
        read_array(tmp_path / "frame.npy", "frame")
