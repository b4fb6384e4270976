"""Tables with a line for each reading: what becomes a view, what is missing, and every refusal."""

import math

import numpy as np
import pytest
import xarray as xr
from cases import each
from hypothesis import given, settings
from hypothesis import strategies as st

from polar_bayes.errors import CaptureError
from polar_bayes.importers.table import from_table

ANGLES = {"view_azimuth": 180.0, "light_zenith": 45.0, "light_azimuth": 0.0}
PLAIN = "view_zenith,dop,intensity\n10,0.02,812\n20,0.04,790\n# a cloud\n30,0.09,755\n"


@pytest.fixture
def write(tmp_path):
    """A function that writes a table and gives its path."""

    def write_table(text):
        path = tmp_path / "leaf.csv"
        path.write_text(text)
        return path

    return write_table


def test_each_line_is_a_view(write):
    capture = from_table(
        write(PLAIN), constants={**ANGLES, "wavelength": 550.0, "dop_error": 0.01},
        setup="camera", saturation_level=1023.0,
    )  # fmt: skip
    assert capture.sizes == {"view": 3}
    assert capture["dop"].values.tolist() == [0.02, 0.04, 0.09]
    assert capture["view_zenith"].values.tolist() == [10.0, 20.0, 30.0]
    assert set(capture["light_zenith"].values) == {45.0}
    assert set(capture["dop_error"].values) == {0.01}
    assert capture["wavelength"].item() == 550.0
    assert capture["intensity"].attrs["saturation_level"] == 1023.0
    stated = {"source": "leaf.csv", "setup": "camera", "name": "leaf"}
    assert capture.attrs == {**stated, "angle_set_by": "hand"}


def test_columns_of_other_names_are_said_and_the_rest_ignored(write):
    text = "theta;DoLP;time\n10;0,02;7\n20;0,04;8\n"
    columns = {"view_zenith": "theta", "dop": "DoLP"}
    capture = from_table(write(text), columns=columns, constants=ANGLES, ignored=["time"])
    assert set(capture.data_vars) == {"view_zenith", "dop", *ANGLES}
    assert capture["dop"].values.tolist() == [0.02, 0.04]


@pytest.mark.thorough
def test_one_column_may_be_several_variables(write):
    columns = {"view_zenith": "angle", "light_zenith": "angle"}
    azimuths = {"view_azimuth": 180.0, "light_azimuth": 0.0}
    capture = from_table(write("angle,q\n20,.1\n40,.3\n"), columns=columns, constants=azimuths)
    assert capture["view_zenith"].values.tolist() == [20.0, 40.0]
    assert capture["light_zenith"].values.tolist() == [20.0, 40.0]


def test_lines_of_the_same_directions_are_one_view_of_several_wavelengths(write):
    text = (
        "view_zenith,wavelength,dop,saturated\n"
        "10,450,.1,0\n10,650,.2,1\n20,650,.4,0\n20,450,.3,0\n30,650,.6,0\n10,450,.7,0\n"
    )
    capture = from_table(write(text), constants=ANGLES)
    assert capture["wavelength"].values.tolist() == [450.0, 650.0]
    assert capture["view_zenith"].values.tolist() == [10.0, 20.0, 30.0, 10.0]
    nan = np.nan
    expected = [[0.1, 0.2], [0.3, 0.4], [nan, 0.6], [0.7, nan]]
    np.testing.assert_array_equal(capture["dop"], expected)
    np.testing.assert_array_equal(capture["valid"], np.isfinite(expected))
    np.testing.assert_array_equal(capture["saturated"], np.array(expected) == 0.2)


@each("dim", ["patch", "material"])
def test_patches_stand_side_by_side(write, dim):
    text = f"{dim},view_zenith,dop,true_roughness\n2,10,.1,.3\n1,20,.2,.4\n2,30,.3,.3\n"
    capture = from_table(write(text), constants=ANGLES)
    assert capture.sizes == {dim: 2, "view": 2}
    assert capture[dim].values.tolist() == ["1", "2"]
    assert capture["valid"].values.tolist() == [[True, False], [True, True]]
    assert capture["dop"].values[1].tolist() == [0.1, 0.3]
    assert capture.attrs["name"] == "leaf"


@pytest.mark.thorough
def test_long_numbers_of_patches_stay_apart(write):
    text = "patch,view_zenith,dop\n20261122,10,.1\n20261123,20,.2\n"
    capture = from_table(write(text), constants=ANGLES)
    assert capture["patch"].values.tolist() == ["20261122", "20261123"]


@pytest.mark.thorough
@each(("number", "label"), [(1.5, "1.5"), (-0.0, "0"), (7, "7"), (1e300, "1e+300")])
def test_a_patch_may_be_a_constant(write, number, label):
    capture = from_table(write(PLAIN), constants={**ANGLES, "patch": number})
    assert capture["patch"].values.tolist() == [label]
    assert capture.sizes == {"patch": 1, "view": 3}


@pytest.mark.thorough
def test_readings_that_are_not_valid_are_not_looked_at(write):
    capture = from_table(write("view_zenith,dop,valid\n10,7,0\n20,.2,1\n"), constants=ANGLES)
    assert capture["valid"].values.tolist() == [False, True]


@settings(deadline=None)  # a machine may be busy
@given(data=st.data())
def test_the_order_of_lines_changes_nothing(in_order, data):
    """Of directions that are read once at each wavelength."""
    read, capture = in_order
    xr.testing.assert_identical(read(data.draw(st.permutations(LINES))), capture)


LINES = [f"{zenith},{wave},{zenith / 100 + wave / 1e4}" for zenith in (10, 20, 30)
         for wave in (450, 550)]  # fmt: skip


@pytest.fixture(scope="module")
def in_order(tmp_path_factory):
    """A function that reads lines, and the capture of the lines in order."""
    path = tmp_path_factory.mktemp("tables") / "leaf.csv"

    def read(rows):
        path.write_text("\n".join(["view_zenith,wavelength,dop", *rows]))
        return from_table(path, constants=ANGLES).sortby("view_zenith")

    return read, read(LINES)


REFUSED = [
    (PLAIN, {}, "nothing gives view_azimuth", "constants={'view_azimuth': NUMBER} (give deg"),
    (PLAIN, {"columns": {"u": "v"}}, "there is no column 'v'", "view_zenith, dop, intensity"),
    (PLAIN, {"ignored": ["time"]}, "there is no column 'time'", "choose from"),
    (PLAIN, {"columns": {"dopp": "dop"}}, "no variable 'dopp'", "nearest: dop"),
    (PLAIN, {"constants": {"ligth": 3.0}}, "no variable 'ligth'", "nearest: light"),
    (PLAIN, {"constants": {"dop_error": "1%"}}, "dop_error is '1%'", "give a finite number"),
    (PLAIN, {"constants": {**ANGLES, "patch": math.nan}}, "patch is nan", "give a finite number"),
    (PLAIN, {"constants": {**ANGLES, "material": math.inf}}, "material is inf", "finite number"),
    (PLAIN, {"constants": {**ANGLES, "patch": 10**400}}, "patch is 1000", "give a finite number"),
    (PLAIN, {"constants": {**ANGLES, "true_roughness": math.nan}}, "true_roughness is nan", "give"),
    (PLAIN, {"constants": {**ANGLES, "dop_error": 1e300}}, "dop_error is 1e+300", "give a stand"),
    (
        "patch,material,view_zenith,dop\n1,1,10,.1\n",
        {"constants": ANGLES},
        "it has materials and patches",
        "leave one of both out by ignored=",
    ),
    (PLAIN, {"constants": {"dop": 0.1}}, "dop is a constant and the column 'dop'", "one of both"),
    (
        PLAIN,
        {"columns": {"dop": "intensity"}},
        "dop is the column 'intensity', too",
        "leave one of",
    ),
    (
        "view_zenith,DoLP\n10,.1\n",
        {},
        "column DoLP: a capture has no variable",
        "say which",
    ),
    (
        "view_zenith,dop\n# x\n10,.1\n20,12\n",
        {"constants": ANGLES},
        "line 4, column dop: dop is 12, which is outside 0 <= value <= 1",
        "not percent",
    ),
    (
        "view_zenith,dop\n10,.1\n",
        {"constants": {**ANGLES, "light_zenith": 90.0}},
        "line 2: light_zenith is 90, which is outside",
        "from the surface normal",
    ),
    ("view_zenith,dop\n10,x\n", {"constants": ANGLES}, "line 2, column dop: 'x'", "correct it"),
    ("view_zenith\n10\n", {"constants": ANGLES}, "no reading is there", "add dop"),
    ("# nothing\n", {}, "it holds no rows", "a line for each reading"),
]


@each(("text", "given", "what", "hint"), REFUSED)
def test_what_is_wrong_is_named_with_its_line(write, text, given, what, hint):
    with pytest.raises(CaptureError) as caught:
        from_table(write(text), **given)
    assert what in str(caught.value)
    assert hint in str(caught.value)
    assert "leaf.csv" in str(caught.value)
