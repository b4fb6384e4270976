"""The door of a capture: what it lets in, in which form, and what it says when it does not."""

import re

import numpy as np
import pytest
import xarray as xr
from cases import each

from polar_bayes.capture.schema import CONTRACT, LEADING, count, validate
from polar_bayes.errors import CaptureError


def refused(capture, what):
    """The one-line message of the refusal."""
    with pytest.raises(CaptureError, match=what) as caught:
        validate(capture, source="leaf.nc")
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith("leaf.nc")
    return message


@each("leading", LEADING, ids=str)
@each("spectral", [False, True])
def test_a_valid_capture_comes_out_canonical_and_stays_so(make_capture, leading, spectral):
    given = make_capture(*leading, spectral=spectral)
    capture = validate(given.transpose(*reversed(tuple(given.sizes))))
    dims = (*leading, "view", *(("wavelength",) if spectral else ()))
    for row in CONTRACT:
        variable = capture[row.name]
        assert variable.dims == {"geometry": ("view",), "trust": leading}.get(row.kind, dims)
        assert variable.dtype == (bool if row.kind == "flag" else np.float64)
        np.testing.assert_array_equal(variable, given[row.name].transpose(*variable.dims))
        assert variable.attrs["units"] == (row.units or "uA")
        assert variable.attrs["long_name"] == row.meaning
    assert capture.attrs == given.attrs
    xr.testing.assert_identical(validate(capture), capture)


@pytest.mark.thorough
def test_the_given_dataset_is_left_alone(make_capture):
    given = make_capture()
    before = given.copy(deep=True)
    validated = validate(given)
    validated["dop"][:] = 0.5
    validated.attrs["name"] = "other"
    xr.testing.assert_identical(given, before)


@each("signal", ["dop", "q", "intensity"])
def test_one_signal_is_enough(make_capture, signal):
    geometry = [row.name for row in CONTRACT if row.kind == "geometry"]
    assert signal in validate(make_capture()[[*geometry, signal]])


@pytest.mark.thorough
def test_geometry_may_differ_from_pixel_to_pixel(make_capture):
    capture = make_capture("y", "x")
    zenith = capture["view_zenith"].broadcast_like(capture["dop"])
    assert validate(capture.assign(view_zenith=zenith))["view_zenith"].dims == ("y", "x", "view")


def test_integers_become_numbers_and_flags(make_capture):
    capture = make_capture()
    for name in ("valid", "saturated", "interpolated"):
        capture[name] = capture[name].astype("int8")
    capture["dop"] = capture["dop"].round().astype("float32")
    capture["view_zenith"] = capture["view_zenith"].astype("int32")
    canonical = validate(capture)
    assert canonical["valid"].dtype == bool
    assert canonical["dop"].dtype == canonical["view_zenith"].dtype == np.float64


def test_masked_entries_may_hold_anything(make_capture):
    capture = make_capture()
    capture["dop"][1] = np.nan
    capture["q"][1] = np.inf
    capture["intensity"][1] = -1.0
    np.testing.assert_array_equal(validate(capture)["dop"], capture["dop"])


@pytest.mark.thorough
def test_wavelengths_may_repeat_and_fall(make_capture):
    capture = make_capture(spectral=True).assign_coords(wavelength=[633.0, 633.0])
    np.testing.assert_array_equal(validate(capture)["wavelength"], [633.0, 633.0])


@pytest.mark.thorough
def test_labels_left_by_selection_are_kept(make_capture):
    capture = make_capture("material", spectral=True).assign_coords(material=["oak", "ash", "elm"])
    chosen = validate(capture.isel(material=1, wavelength=0))
    assert chosen["material"].item() == "ash"
    assert chosen["wavelength"].item() == 633.0
    assert chosen["dop"].dims == ("view",)


def test_noise_may_carry_the_polarization_a_little_past_one(make_capture):
    capture = make_capture()
    capture["q"][0], capture["u"][0] = 0.85, 0.55  # sum of squares 1.025
    validate(capture)
    capture["u"][0] = 0.6  # 1.0825
    message = refused(capture, r"q\^2 \+ u\^2 = 1\.0825 is more than light can have")
    assert message.startswith("leaf.nc: u[view=0]")
    assert "mark it valid=False" in message


@pytest.mark.thorough
def test_the_truth_may_be_unknown_but_not_infinite(make_capture):
    capture = make_capture("material")
    capture["true_roughness"][1] = np.nan
    assert np.isnan(validate(capture)["true_roughness"][1])
    capture["true_roughness"][1] = np.inf
    assert "NaN where the truth is not known" in refused(capture, "true_roughness: .*infinite")


@pytest.mark.thorough
def test_the_units_of_a_truth_are_text(make_capture):
    capture = make_capture()
    capture["true_roughness"].attrs |= {"units": 1, "long_name": "slope"}
    attributes = validate(capture)["true_roughness"].attrs
    assert attributes == {"units": "1", "long_name": "slope"}


@pytest.mark.thorough
def test_an_error_takes_the_units_of_the_intensity(make_capture):
    capture = make_capture()
    del capture["intensity_error"].attrs["units"]
    assert validate(capture)["intensity_error"].attrs["units"] == "uA"
    capture["intensity_error"].attrs["units"] = "mA"
    assert "give both in the same units" in refused(capture, "intensity_error: its units are 'mA'")


def test_count_tells_what_was_masked_and_saturated(make_capture):
    capture = validate(make_capture("material", spectral=True))
    with_counter = count(capture)
    assert with_counter["views"] == 3 * 5 * 2
    assert with_counter["masked"] == int((~capture["valid"]).sum()) > 0
    assert with_counter["saturated"] == int(capture["saturated"].sum()) > 0
    bare = capture.drop_vars(["valid", "saturated"])
    assert count(bare) == {"views": 30, "masked": 0, "saturated": 0}


@each("leading", LEADING, ids=str)
def test_trust_in_the_normal_may_be_of_patches_of_views_or_of_both(make_capture, leading):
    capture = make_capture(*leading, spectral=True)
    sizes = {**{dim: capture.sizes[dim] for dim in leading}, "view": 5}
    for dims in (leading, ("view",), (*leading, "view")):
        trust = np.full([sizes[dim] for dim in dims], 0.25)
        found = validate(capture.assign(normal_confidence=(dims, trust)))["normal_confidence"]
        assert found.dims == dims
        assert found.attrs == {"units": "1", "long_name": "trust in the stated normal"}
    colored = capture["normal_confidence"].expand_dims(wavelength=2)
    message = refused(capture.assign(normal_confidence=colored), "normal_confidence: its dims are")
    assert message.endswith(f"or ({', '.join((*leading, 'view'))})")


@pytest.mark.thorough
@each("value", [0.0, -0.1, 1.0001, np.nan, np.inf])
def test_trust_in_the_normal_is_a_share_above_none(make_capture, value):
    capture = make_capture("patch")
    capture["normal_confidence"][1] = value
    message = refused(capture, r"normal_confidence\[patch=1\]: .* is outside 0 < value <= 1")
    assert "what is not to be trusted at all is valid=False" in message


OUT_OF_RANGE = [
    ("view_zenith", 90.0, "0 <= value < 90", "from the surface normal"),
    ("light_zenith", -0.1, "0 <= value < 90", "from the surface normal"),
    ("light_zenith", np.nan, "nan is outside", "from the surface normal"),
    ("view_azimuth", 361.0, "-360 <= value <= 360", "around the surface normal"),
    ("light_azimuth", np.inf, "inf is outside", "around the surface normal"),
    ("dop", 1.01, "0 <= value <= 1", "no light has it"),
    ("dop", -0.01, "0 <= value <= 1", "valid=False"),
    (
        "dop",
        np.nan,
        "nan is outside",
        "valid=False, as by capture['valid'] = capture['dop'].notnull()",
    ),
    ("q", 7.0, "-1 <= value <= 1", "a fraction, not percent"),
    ("u", -np.inf, "-inf is outside", "valid=False"),
    ("intensity", -1e-9, "0 <= value < 1e+30", "valid=False"),
    ("intensity", 1e300, "0 <= value < 1e+30", "valid=False"),
    ("dop_error", 0.0, "1e-30 < value", "standard deviation above zero"),
    ("q_error", np.nan, "1e-30 < value", "standard deviation above zero"),
    ("u_error", -1.0, "1e-30 < value", "standard deviation above zero"),
    ("intensity_error", 1e31, "1e-30 < value", "standard deviation above zero"),
]


@each(("name", "value", "what", "hint"), OUT_OF_RANGE)
def test_a_number_outside_its_range_is_named(make_capture, name, value, what, hint):
    capture = make_capture()
    capture[name][3] = value
    message = refused(capture, re.escape(what))
    assert message.startswith(f"leaf.nc: {name}[view=3]: ")
    assert hint in message


@pytest.mark.thorough
def test_the_first_offending_pixel_is_named(make_capture):
    capture = make_capture("y", "x", spectral=True)
    capture["dop"][1, 2, 3, 0] = 7.0
    capture["dop"][1, 2, 4, 0] = 8.0
    assert "dop[y=1, x=2, view=3, wavelength=0]: 7 is outside" in refused(capture, "7 is outside")


def test_a_flag_is_zero_or_one(make_capture):
    capture = make_capture().assign(valid=("view", [1, 1, 2, 1, 1]))
    assert "True or False" in refused(capture, r"valid\[view=2\]: 2 is outside")


@each("name", [row.name for row in CONTRACT if row.kind == "geometry"])
def test_missing_geometry_is_named(make_capture, name):
    message = refused(make_capture().drop_vars(name), f"{name}: it is missing")
    assert f"add {name} in degree" in message


def test_a_capture_without_readings_is_refused(make_capture):
    geometry = [row.name for row in CONTRACT if row.kind == "geometry"]
    assert "add dop, q or intensity" in refused(make_capture()[geometry], "no reading is there")


@each(
    ("name", "needs"),
    [
        ("u", "q"),
        ("dop_error", "dop"),
        ("q_error", "q"),
        ("u_error", "u"),
        ("intensity_error", "intensity"),
    ],
)
def test_a_variable_without_its_companion_is_refused(make_capture, name, needs):
    capture = make_capture()
    dropped = [row.name for row in CONTRACT if needs in (row.name, row.needs) and row.name != name]
    message = refused(capture.drop_vars(dropped), f"{name}: it has no meaning without {needs}")
    assert f"add {needs} or drop {name}" in message


@each(
    ("name", "near"),
    [("view_zenit", "view_zenith"), ("DoP", "dop"), ("intensities", "intensity"), (7, "u")],
)
def test_an_unknown_variable_gets_the_nearest_name(make_capture, name, near):
    message = refused(make_capture().assign({name: ("view", np.ones(5))}), "no such variable")
    assert message.startswith(f"leaf.nc: {name}: ")
    assert "nearest known name: " in message
    if name != 7:
        assert f"nearest known name: {near})" in message


@pytest.mark.thorough
@each("name", ["true_<script>", "true_../x", "true_", "true_a\nb", "true_ä"])
def test_a_truth_has_a_plain_name(make_capture, name):
    message = refused(make_capture().assign({name: 1.0}), "no such variable")
    assert "call it true_<name>" in message


@each(
    ("name", "units", "wanted"),
    [
        ("view_zenith", "radian", "degree"),
        ("light_azimuth", "rad", "degree"),
        ("dop", "%", "1"),
        ("valid", "m", "1"),
        ("wavelength", "um", "nm"),
    ],
)
def test_wrong_units_are_refused(make_capture, name, units, wanted):
    capture = make_capture(spectral=True)
    capture[name].attrs["units"] = units
    message = refused(capture, f"{name}: its units are '{units}'")
    assert f"convert it to units {wanted}" in message


@pytest.mark.thorough
@each("units", ["degree", "degrees", "deg", " degree "])
def test_other_spellings_of_a_unit_are_understood(make_capture, units):
    capture = make_capture()
    capture["view_zenith"].attrs["units"] = units
    assert validate(capture)["view_zenith"].attrs["units"] == "degree"


@each("dims", [("angle",), ("patch", "view"), ("y", "view"), ("wavelength",)])
def test_wrong_dims_of_a_signal_are_refused(make_capture, dims):
    geometry = make_capture()[[row.name for row in CONTRACT if row.kind == "geometry"]]
    capture = geometry.assign(dop=(dims, np.full((5,) * len(dims), 0.5)))
    if dims == ("patch", "view"):
        validate(capture)
    else:
        message = refused(capture, re.escape(f"dop: its dims are ({', '.join(dims)})"))
        assert "use view[, wavelength], alone or behind material" in message


def test_every_reading_has_the_same_dims(make_capture):
    capture = make_capture("patch")
    capture["q"] = capture["q"].isel(patch=0)
    message = refused(capture, re.escape("q: its dims are (view)"))
    assert message.endswith("give it (patch, view)")


@pytest.mark.thorough
def test_geometry_has_no_dim_of_its_own(make_capture):
    capture = make_capture("patch", spectral=True)
    capture["view_zenith"] = capture["view_zenith"].expand_dims(wavelength=2)
    message = refused(capture, re.escape("view_zenith: its dims are (wavelength, view)"))
    assert message.endswith("give it (view) or (patch, view)")


@pytest.mark.thorough
def test_a_truth_has_no_dim_of_its_own(make_capture):
    capture = make_capture().assign(true_roughness=("leaf", [1.0, 2.0]))
    assert "any of (view)" in refused(capture, re.escape("true_roughness: its dims are (leaf)"))


@each("dim", ["view", "patch", "wavelength"])
def test_an_empty_dim_is_refused(make_capture, dim):
    capture = make_capture("patch", spectral=True).isel({dim: slice(0, 0)})
    assert f"give at least one {dim}" in refused(capture, f"dim {dim}: its length is 0")


def test_a_capture_all_masked_is_refused(make_capture):
    capture = make_capture()
    capture["valid"][:] = False
    assert "valid=True" in refused(capture, "valid: every view is masked")


def test_the_dim_wavelength_has_a_coordinate(make_capture):
    capture = make_capture(spectral=True).drop_vars("wavelength")
    assert "coordinate wavelength in nm" in refused(capture, "dim wavelength: it has no coordinate")


@each("value", [0.0, 0.5, -633.0, np.nan, np.inf])
def test_a_wavelength_is_above_ten_nanometers(make_capture, value):
    capture = make_capture(spectral=True).assign_coords(wavelength=[633.0, value])
    assert "give nanometers: " in refused(capture, r"wavelength\[wavelength=1\]: ")


@pytest.mark.thorough
def test_a_wavelength_without_its_dim_is_one_number(make_capture):
    assert validate(make_capture().assign_coords(wavelength=633))["wavelength"].item() == 633.0
    capture = make_capture().assign_coords(wavelength=[633.0, 500.0])
    assert refused(capture, re.escape("wavelength: its dims are (wavelength)")).endswith("it ()")


@each(
    ("values", "what"),
    [
        (np.array(["a"] * 5), "str"),
        (np.array([1.0] * 5, dtype=object), "object"),
        (np.array(["2020-01-01"] * 5, dtype="datetime64[ns]"), "datetime64"),
        (np.ones(5, dtype=complex), "complex"),
        (np.ones(5, dtype=bool), "bool"),
    ],
)
@each("name", ["dop", "view_zenith", "true_roughness"])
def test_only_real_numbers_are_readings(make_capture, name, values, what):
    message = refused(make_capture().assign({name: ("view", values)}), f"{name}: it holds {what}")
    assert "store floating-point numbers" in message


@pytest.mark.thorough
@each(
    ("labels", "what"),
    [
        (["a", "", "b"], "neither a finite number nor printable text"),
        (["a", "b\n", "c"], "neither a finite number nor printable text"),
        ([1.0, np.nan, 2.0], "neither a finite number nor printable text"),
        ([True, False, True], "neither a finite number nor printable text"),
        ([b"a", b"b", b"c"], "neither a finite number nor printable text"),
        (["a", "b", "a"], "two labels are the same"),
    ],
)
def test_labels_tell_materials_apart(make_capture, labels, what):
    capture = make_capture("material").assign_coords(material=labels)
    assert "or drop the coordinate" in refused(capture, f"material: .*{what}")


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore:rename 'one' to 'view'")
def test_one_label_cannot_stand_for_many_views(make_capture):
    capture = make_capture().assign_coords(one=1.0).rename(one="view")
    message = refused(capture, re.escape("view: its dims are ()"))
    assert message.endswith("give it (view)")


@each("level", [0.0, -1.0, np.nan, np.inf, "full", [1.0, 2.0]])
def test_a_saturation_level_is_above_zero(make_capture, level):
    capture = make_capture()
    capture["intensity"].attrs["saturation_level"] = level
    assert "at which the detector saturates" in refused(capture, "intensity: saturation_level is")


@each(
    ("given", "kept"),
    [
        (np.float32(0.5), 0.5),
        (np.int16(3), 3),
        (True, 1),
        (np.bool_(False), 0),
        (b"\xff\x00leaf", "\\xff\\x00leaf"),
        (np.arange(3), "[0, 1, 2]"),
        (["a", "b"], "['a', 'b']"),
        (10**30, "1" + "0" * 30),
        ("two\nlines", "two\nlines"),
        ("\ud800", "\\ud800"),
    ],
)
def test_attributes_become_text_and_numbers(make_capture, given, kept):
    capture = make_capture().assign_attrs(note=given)
    attribute = validate(capture).attrs["note"]
    assert attribute == kept
    assert type(attribute) is type(kept)


@each("value", [None, {"a": 1}, {1, 2}, object, 1j, [[1], [1, 2]], [None]])
def test_other_attributes_are_refused(make_capture, value):
    message = refused(make_capture().assign_attrs(note=value), "attribute note: the value is a")
    assert "give a number or text" in message


@pytest.mark.thorough
@each("name", ["_FillValue", "scale_factor", "a/b", "", "a b", 3, "x" * 101])
def test_attribute_names_that_no_file_holds_are_refused(make_capture, name):
    capture = make_capture()
    capture["dop"].attrs[name] = 1.0
    assert "rename it" in refused(capture, "dop: the attribute name .* cannot be stored")


@each("thing", [None, "leaf.nc", np.ones(3), {"dop": 1}, xr.DataArray([1.0])])
def test_only_a_dataset_is_a_capture(thing):
    message = refused(thing, "is not a capture")
    of_path = "read it first: pb.load_capture('leaf.nc')"
    assert (of_path if isinstance(thing, str) else "give an xarray.Dataset") in message
    assert "pb.from_table('leaf.csv')" in refused("leaf.csv", "a str is not a capture")
