"""From a capture to arrays: axes, masks, the unit of intensity, and what never gets through."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from cases import each

from polar_bayes.capture.schema import validate
from polar_bayes.observation.data import ANGLES, READINGS, observe

SIZES = {"material": 2, "patch": 3, "y": 2, "x": 3, "view": 4, "wavelength": 3}
ZENITHS = np.array([0.0, 30.0, 60.0, 80.0])


def make_capture(*leading, wavelength=False, level=None, **replaced):
    """A validated capture with every reading; `replaced` variables over the readings' dims."""
    random = np.random.default_rng(3)
    dims = (*leading, "view", *(("wavelength",) if wavelength else ()))
    shape = [SIZES[dim] for dim in dims]
    variables = {
        "dop": random.uniform(0.1, 0.9, shape),
        "q": random.uniform(-0.5, 0.5, shape),
        "u": random.uniform(-0.5, 0.5, shape),
        "intensity": random.uniform(5.0, 40.0, shape),
        "q_error": random.uniform(0.01, 0.02, shape),
        "intensity_error": random.uniform(0.5, 1.0, shape),
        **replaced,
    }
    angles = zip(ANGLES, np.broadcast_arrays(ZENITHS, 120.0, 45.0, 10.0), strict=True)
    capture = xr.Dataset(
        {name: ("view", angle) for name, angle in angles}
        | {name: (dims, value) for name, value in variables.items() if value is not None}
    )
    if wavelength:
        capture = capture.assign_coords(wavelength=[450.0, 550.0, 650.0])
    if level is not None:
        capture["intensity"].attrs["saturation_level"] = level
    return validate(capture)


@each("leading", [(), ("material",), ("patch",), ("y", "x")], ids=str)
@each("wavelength", [False, True])
def test_axes_are_leading_then_wavelength_then_view(leading, wavelength):
    capture = make_capture(*leading, wavelength=wavelength)
    data = observe(capture)
    order = (*leading, *(("wavelength",) if wavelength else ()), "view")
    assert data.dims == tuple((dim, SIZES[dim]) for dim in order)
    assert data.shape == tuple(SIZES[dim] for dim in order)
    for name in ("dop", "q", "u"):
        np.testing.assert_array_equal(data.readings[name], capture[name].transpose(*order))
    np.testing.assert_array_equal(data.errors["q"], capture["q_error"].transpose(*order))
    assert data.brightness.shape == data.valid.shape == data.saturated.shape == data.shape
    for direction in jax.tree.leaves(data.geometry):
        assert np.broadcast_shapes(direction.shape, data.shape) == data.shape
    if wavelength:
        np.testing.assert_array_equal(data.geometry.wavelength.ravel(), [450.0, 550.0, 650.0])
        assert data.geometry.wavelength.shape == (*(1,) * len(leading), 3, 1)
    else:
        assert data.geometry.wavelength is None


@pytest.mark.thorough
def test_the_order_of_the_captures_axes_does_not_matter():
    capture = make_capture("material", wavelength=True)
    turned = capture.transpose("wavelength", "view", "material")
    jax.tree.map(np.testing.assert_array_equal, observe(turned), observe(capture))


@pytest.mark.thorough
def test_a_single_wavelength_left_by_selection_is_no_axis():
    data = observe(make_capture(wavelength=True).isel(wavelength=1))
    assert data.dims == (("view", 4),)


@pytest.mark.thorough
@each("name", READINGS)
def test_only_the_recorded_variables_appear(name):
    absent = dict.fromkeys([*READINGS, "q_error", "intensity_error"], None)
    kept = {"q": np.full(4, 0.1)} if name == "u" else {}  # u means nothing without q
    data = observe(make_capture(**{**absent, **kept, name: np.full(4, 0.2)}))
    assert set(data.readings) == {name, *kept}
    assert data.errors == {}


# --- what is missing ------------------------------------------------------------------------------


@each("junk", [np.nan, np.inf, -np.inf, -7.0, 1e300])
def test_what_a_masked_entry_holds_reaches_nothing(junk):
    valid = np.array([True, False, True, True])
    plain = make_capture(valid=valid)
    spoiled = plain.copy(deep=True)
    for name in (*READINGS, "q_error", "intensity_error"):
        spoiled[name][1] = junk
    data = observe(validate(spoiled))
    for leaf in jax.tree.leaves(data):
        if leaf is not data.full_scale:  # infinite: this sensor names no level
            assert np.all(np.isfinite(leaf))
    np.testing.assert_array_equal(data.valid, valid)
    jax.tree.map(np.testing.assert_array_equal, data, observe(plain))


def test_masked_entries_stand_inside_the_range_of_every_reading():
    data = observe(make_capture(valid=[False, True, True, True]))
    for name in READINGS:
        assert float(data.readings[name][0]) == 0.5
    assert float(data.errors["q"][0]) == 1.0


def test_views_beyond_the_limit_are_set_aside_and_the_limit_itself_stays():
    """Beside what the capture masks."""
    data = observe(make_capture(wavelength=True), largest_view_zenith=60.0)
    np.testing.assert_array_equal(data.valid, np.broadcast_to(ZENITHS <= 60.0, (3, 4)))
    masked = observe(make_capture(valid=[False, True, True, True]), largest_view_zenith=70.0)
    np.testing.assert_array_equal(masked.valid, [False, True, True, False])


# --- the unit of intensity ------------------------------------------------------------------------

INTENSITY = np.array([8.0, 10.0, 20.0, 40.0])


UNITS = {  # what is recorded; brightness, unit, full scale and views at which the sensor stopped
    "without a level the largest reading": ({}, INTENSITY / 40.0, 40.0, np.inf, False),
    "a stated level": ({"level": 80.0}, INTENSITY / 80.0, 80.0, 1.0, False),
    "a masked spike dims no other view": (
        {"intensity": [8.0, 10.0, 1e6, 40.0], "valid": [True, True, False, True]},
        [0.2, 0.25, 0.5, 1.0], 40.0, np.inf, False,
    ),
    "without light": ({"intensity": np.zeros(4), "intensity_error": None}, 0.0, 1.0, np.inf, False),
    "unknown light": ({"intensity": None, "intensity_error": None}, 1.0, 1.0, np.inf, False),
    # Brighter than the level is no brighter for the noise; the reading itself stays. A reading at
    # the level has stopped whether flagged or not.
    "stopped": (
        {"level": 20.0, "saturated": [True, False, False, False]},
        [0.4, 0.5, 1.0, 1.0], 20.0, 1.0, [True, False, True, True],
    ),
}  # fmt: skip


@each(("given", "brightness", "unit", "full_scale", "stopped"), UNITS.values(), ids=UNITS)
def test_the_unit_of_readings_and_errors(given, brightness, unit, full_scale, stopped):
    capture = make_capture(**{"intensity": INTENSITY} | given)
    data = observe(capture)
    np.testing.assert_array_equal(data.brightness, np.broadcast_to(brightness, 4))
    np.testing.assert_array_equal(data.saturated, np.broadcast_to(stopped, 4))
    assert (float(data.intensity_unit), float(data.full_scale)) == (unit, full_scale)
    seen = np.asarray(data.valid)
    for arrays, name in ((data.readings, "intensity"), (data.errors, "intensity_error")):
        if name in capture:
            expected = capture[name].to_numpy()[seen] / unit
            np.testing.assert_array_equal(arrays["intensity"][seen], expected)


@pytest.mark.thorough
def test_the_largest_reading_is_that_of_the_whole_capture_not_of_the_views_below_the_limit():
    """Or adding grazing views would lower the concentration of all others."""
    capture = make_capture(intensity=INTENSITY)
    whole, upright = (observe(capture, largest_view_zenith=limit) for limit in (90.0, 70.0))
    np.testing.assert_array_equal(whole.brightness[:3], upright.brightness[:3])
    assert float(upright.intensity_unit) == 40.0


@pytest.mark.thorough
def test_the_largest_reading_is_that_of_all_wavelengths_and_materials():
    capture = make_capture("material", wavelength=True)
    data = observe(capture)
    assert float(data.intensity_unit) == float(capture["intensity"].max())
    assert float(np.max(data.brightness)) == 1.0


# --- trust in the normal --------------------------------------------------------------------------


@pytest.mark.thorough
def test_without_a_stated_trust_there_is_none():
    data = observe(make_capture())
    assert data.confidence is None
    assert len(jax.tree.leaves(data)) < len(jax.tree.leaves(observe(trusted((), 0.5))))


def trusted(dims, value, *leading, **options):
    return validate(make_capture(*leading, **options).assign(normal_confidence=(dims, value)))


@each("leading", [(), ("material",), ("patch",), ("y", "x")], ids=str)
def test_trust_stands_beside_the_readings_and_broadcasts_with_them(leading):
    for dims in (leading, ("view",), (*leading, "view")):
        value = np.random.default_rng(1).uniform(0.1, 1.0, [SIZES[dim] for dim in dims])
        capture = trusted(dims, value, *leading, wavelength=True)
        data = observe(capture)
        order = (*leading, "wavelength", "view")
        expected = capture["normal_confidence"].broadcast_like(capture["dop"]).transpose(*order)
        np.testing.assert_array_equal(np.broadcast_to(data.confidence, data.shape), expected)
        assert data.confidence.ndim == len(data.shape)
        assert data.confidence.size == value.size


# --- directions -----------------------------------------------------------------------------------


def test_a_viewer_on_the_normal_looks_away_from_the_light():
    data = observe(make_capture())
    np.testing.assert_array_equal(data.geometry.view_zenith, ZENITHS)
    np.testing.assert_array_equal(data.geometry.view_azimuth, [190.0, 120.0, 120.0, 120.0])


@pytest.mark.thorough
def test_directions_may_differ_from_pixel_to_pixel():
    capture = make_capture("y", "x", wavelength=True)
    zeniths = np.linspace(1.0, 80.0, 24).reshape(2, 3, 4)
    capture = validate(capture.assign(view_zenith=(("y", "x", "view"), zeniths)))
    data = observe(capture, largest_view_zenith=40.0)
    for name in ANGLES:
        assert getattr(data.geometry, name).shape == (2, 3, 1, 4)
    np.testing.assert_array_equal(data.geometry.view_zenith[:, :, 0], zeniths)
    expected = np.broadcast_to(zeniths[:, :, None] <= 40.0, (2, 3, 3, 4))
    np.testing.assert_array_equal(data.valid, expected)


# --- as an argument of a compiled program ---------------------------------------------------------


def test_a_second_capture_of_the_same_layout_compiles_nothing():
    traces = []

    @jax.jit
    def total(data):
        traces.append(data.dims)
        return jnp.sum(jnp.where(data.valid, data.readings["dop"], 0.0))

    first, second = make_capture(), make_capture(dop=np.full(4, 0.25))
    assert float(total(observe(first))) == pytest.approx(float(first["dop"].sum()))
    assert float(total(observe(second))) == 1.0
    assert traces == [(("view", 4),)]


def test_arrays_take_double_precision_where_it_is_on():
    kinds = {leaf.dtype for leaf in jax.tree.leaves(observe(make_capture()))}
    assert kinds == {np.dtype(np.float64), np.dtype(bool)}
