"""The door of a capture: what it lets in, in which form, and what it says when it does not."""

import numpy as np
import pytest
import xarray as xr
from cases import each

from polar_bayes.capture.schema import CONTRACT, LEADING, count, validate
from polar_bayes.errors import CaptureError

GEOMETRY = [row.name for row in CONTRACT if row.kind == "geometry"]


@pytest.mark.thorough
def test_the_given_dataset_is_left_alone(make_capture):
    given = make_capture()
    before = given.copy(deep=True)
    validated = validate(given)
    validated["dop"][:] = 0.5
    validated.attrs["name"] = "other"
    xr.testing.assert_identical(given, before)


@pytest.mark.thorough
@each("units", ["degree", "degrees", "deg", " degree "])
def test_other_spellings_of_a_unit_are_understood(make_capture, units):
    capture = with_attribute(make_capture(), "view_zenith", units=units)
    assert validate(capture)["view_zenith"].attrs["units"] == "degree"


def test_what_is_a_little_less_than_what_is_refused_below_passes(make_capture):
    """Noise may carry the polarization past one, and a truth may be unknown."""
    capture = put(put(make_capture(), "q", 0.85, 0), "u", 0.55, 0)  # sum of squares 1.025
    validate(capture)
    capture["true_roughness"] = np.nan
    assert np.isnan(validate(capture)["true_roughness"])
    del capture["intensity_error"].attrs["units"]
    assert validate(capture)["intensity_error"].attrs["units"] == "uA"
    validate(capture[GEOMETRY].assign(dop=(("patch", "view"), np.full((5, 5), 0.5))))
    assert validate(capture.assign_coords(wavelength=633))["wavelength"].item() == 633.0


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


@each("signal", ["dop", "q", "intensity"])
def test_one_signal_is_enough(make_capture, signal):
    assert signal in validate(make_capture()[[*GEOMETRY, signal]])


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


@pytest.mark.thorough
def test_the_units_of_a_truth_are_text(make_capture):
    capture = make_capture()
    capture["true_roughness"].attrs |= {"units": 1, "long_name": "slope"}
    attributes = validate(capture)["true_roughness"].attrs
    assert attributes == {"units": "1", "long_name": "slope"}


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
    hint = f"or ({', '.join((*leading, 'view'))})$"
    check_refused(capture.assign(normal_confidence=colored), "normal_confidence: its dims", hint)


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


# --- refusals -------------------------------------------------------------------------------------


def check_refused(capture, says, *hints):
    """Check the message of one line: where and what, and in it the hints, with $ for its end."""
    with pytest.raises(CaptureError) as caught:
        validate(capture, source="leaf.nc")
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(f"leaf.nc: {says}")
    assert all(hint in f"{message}$" for hint in hints), message


def put(capture, name, value, at=3):
    """The capture with one other value."""
    capture[name][at] = value
    return capture


def with_attribute(capture, name, **attributes):
    capture[name].attrs |= attributes
    return capture


OUT_OF_RANGE = [
    ("view_zenith", 90.0, "0 <= value < 90", "from the surface normal"),
    ("light_zenith", -0.1, "0 <= value < 90", "from the surface normal"),
    ("light_zenith", np.nan, "nan is outside", "from the surface normal"),
    ("view_azimuth", 361.0, "-360 <= value <= 360", "around the surface normal"),
    ("light_azimuth", np.inf, "inf is outside", "around the surface normal"),
    ("dop", 1.01, "0 <= value <= 1", "no light has it"),
    ("dop", -0.01, "0 <= value <= 1", "valid=False"),
    ("dop", np.nan, "nan is outside", "valid=False, as by capture['valid'] = capture['dop'].not"),
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
    check_refused(put(make_capture(), name, value), f"{name}[view=3]: ", what, hint)


COMPANIONS = {"u": "q", "dop_error": "dop", "q_error": "q", "u_error": "u"}
COMPANIONS |= {"intensity_error": "intensity"}


@each(("name", "needs"), COMPANIONS.items())
def test_a_variable_without_its_companion_is_refused(make_capture, name, needs):
    dropped = [row.name for row in CONTRACT if needs in (row.name, row.needs) and row.name != name]
    says = f"{name}: it has no meaning without {needs}"
    check_refused(make_capture().drop_vars(dropped), says, f"add {needs} or drop {name}")


FIVE = np.ones(5)
NO_NUMBERS = {
    "str": np.array(["a"] * 5),
    "object": FIVE.astype(object),
    "datetime64": np.array(["2020-01-01"] * 5, dtype="datetime64[ns]"),
    "complex": FIVE.astype(complex),
    "bool": FIVE.astype(bool),
}


@each(("kind", "values"), NO_NUMBERS.items())
@each("name", ["dop", "view_zenith", "true_roughness"])
def test_only_real_numbers_are_readings(make_capture, name, kind, values):
    capture = make_capture().assign({name: ("view", values)})
    check_refused(capture, f"{name}: it holds {kind}", "store floating-point numbers")


def labeled(make, labels):
    return make("material").assign_coords(material=labels)


NO_LABEL = "neither a finite number nor printable text"
REFUSED = [
    (lambda make: put(put(make(), "q", 0.85, 0), "u", 0.6, 0),
     "u[view=0]: q^2 + u^2 = 1.0825 is more than light can have", "mark it valid=False"),
    (lambda make: put(make("material"), "true_roughness", np.inf, 1),
     "true_roughness: ", "infinite", "NaN where the truth is not known"),
    (lambda make: with_attribute(make(), "intensity_error", units="mA"),
     "intensity_error: its units are 'mA'", "give both in the same units"),
    (lambda make: put(put(make("y", "x", spectral=True), "dop", 7.0, (1, 2, 3, 0)),
                      "dop", 8.0, (1, 2, 4, 0)),
     "dop[y=1, x=2, view=3, wavelength=0]: 7 is outside"),
    (lambda make: make().assign(valid=("view", [1, 1, 2, 1, 1])),
     "valid[view=2]: 2 is outside", "True or False"),
    (lambda make: make()[GEOMETRY], "no reading is there", "add dop, q or intensity"),
    (lambda make: make("patch").assign(q=make()["q"]),
     "q: its dims are (view)", "give it (patch, view)$"),
    (lambda make: make("patch", spectral=True).assign(
        view_zenith=make()["view_zenith"].expand_dims(wavelength=2)),
     "view_zenith: its dims are (wavelength, view)", "give it (view) or (patch, view)$"),
    (lambda make: make().assign(true_roughness=("leaf", [1.0, 2.0])),
     "true_roughness: its dims are (leaf)", "any of (view)"),
    (lambda make: make().assign(valid=("view", [False] * 5)),
     "valid: every view is masked", "valid=True"),
    (lambda make: make(spectral=True).drop_vars("wavelength"),
     "dim wavelength: it has no coordinate", "coordinate wavelength in nm"),
    (lambda make: make().assign_coords(wavelength=[633.0, 500.0]),
     "wavelength: its dims are (wavelength)", "it ()$"),
    (lambda make: make().assign_coords(one=1.0).rename(one="view"),
     "view: its dims are ()", "give it (view)$"),
    (lambda make: "leaf.nc", "a str is not a capture", "read it first: pb.load_capture('leaf.nc')"),
    (lambda make: "leaf.csv", "a str is not a capture", "pb.from_table('leaf.csv')"),
    *((lambda make, name=name: make().drop_vars(name),
       f"{name}: it is missing", f"add {name} in degree") for name in GEOMETRY),
    *((lambda make, name=name: make().assign({name: ("view", FIVE)}),
       f"{name}: ", "no such variable", f"nearest known name: {near}")
      for name, near in {"view_zenit": "view_zenith)", "DoP": "dop)", "intensities": "intensity)",
                         7: ""}.items()),
    *((lambda make, name=name: make().assign({name: 1.0}),
       "", "no such variable", "call it true_<name>")
      for name in ("true_<script>", "true_../x", "true_", "true_a\nb", "true_ä")),
    *((lambda make, name=name, units=units: with_attribute(make(spectral=True), name, units=units),
       f"{name}: its units are '{units}'", f"convert it to units {wanted}")
      for name, units, wanted in (
          ("view_zenith", "radian", "degree"), ("light_azimuth", "rad", "degree"),
          ("dop", "%", "1"), ("valid", "m", "1"), ("wavelength", "um", "nm"))),
    *((lambda make, dims=dims: make()[GEOMETRY].assign(dop=(dims, np.full((5,) * len(dims), 0.5))),
       f"dop: its dims are ({', '.join(dims)})", "use view[, wavelength], alone or behind material")
      for dims in (("angle",), ("y", "view"), ("wavelength",))),
    *((lambda make, dim=dim: make("patch", spectral=True).isel({dim: slice(0, 0)}),
       f"dim {dim}: its length is 0", f"give at least one {dim}")
      for dim in ("view", "patch", "wavelength")),
    *((lambda make, x=x: make(spectral=True).assign_coords(wavelength=[633.0, x]),
       "wavelength[wavelength=1]: ", "give nanometers: ") for x in (0, 0.5, -633, np.nan, np.inf)),
    *((lambda make, x=x: put(make("patch"), "normal_confidence", x, 1),
       "normal_confidence[patch=1]: ", "is outside 0 < value <= 1",
       "what is not to be trusted at all is valid=False")
      for x in (0, -0.1, 1.0001, np.nan, np.inf)),
    *((lambda make, labels=labels: labeled(make, labels),
       "material: ", NO_LABEL, "or drop the coordinate")
      for labels in (["a", "", "b"], ["a", "b\n", "c"], [1.0, np.nan, 2.0], [True, False, True],
                     [b"a", b"b", b"c"])),
    (lambda make: labeled(make, ["a", "b", "a"]),
     "material: ", "two labels are the same", "or drop the coordinate"),
    *((lambda make, level=level: with_attribute(make(), "intensity", saturation_level=level),
       "intensity: saturation_level is", "at which the detector saturates")
      for level in (0.0, -1.0, np.nan, np.inf, "full", [1.0, 2.0])),
    *((lambda make, value=value: make().assign_attrs(note=value),
       "attribute note: the value is a", "give a number or text")
      for value in (None, {"a": 1}, {1, 2}, object, 1j, [[1], [1, 2]], [None])),
    *((lambda make, name=name: with_attribute(make(), "dop", **{name: 1.0}) if name != 3
       else make().assign(dop=make()["dop"].assign_attrs({3: 1.0})),
       "dop: the attribute name ", "cannot be stored", "rename it")
      for name in ("_FillValue", "scale_factor", "a/b", "", "a b", 3, "x" * 101)),
    *((lambda make, thing=thing: thing, "a", "is not a capture", "give an xarray.Dataset")
      for thing in (None, FIVE, {"dop": 1}, xr.DataArray([1.0]))),
]  # fmt: skip
"""What is refused, where and why, and the hints."""


@pytest.mark.filterwarnings("ignore:rename 'one' to 'view'")
@each("row", REFUSED, ids=lambda row: " ".join(row[1:]))
def test_what_no_capture_may_hold_is_refused_with_its_mend(make_capture, row):
    make, *says = row
    check_refused(make(make_capture), *says)
