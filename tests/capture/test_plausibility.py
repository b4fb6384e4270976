"""Captures that no light could make: refused or cautioned, each with its likely cause."""

import numpy as np
import pytest
import xarray as xr
from cases import each
from hypothesis import given, settings
from hypothesis import strategies as st
from plates import at_mirror

import polar_bayes as pb
from polar_bayes.capture.plausibility import (
    DEFAULT_INDICES,
    IndexByEye,
    cautions,
    fresnel,
    index_sentences,
    indices_by_eye,
    inferred,
    stated,
)
from polar_bayes.capture.schema import validate
from polar_bayes.errors import CaptureError
from polar_bayes.priors import support_bounds
from polar_bayes.setups import default_priors

ZENITHS = np.arange(20.0, 79.0, 3.0)


def plate(zeniths=ZENITHS, index=1.5, **variables) -> xr.Dataset:
    """A polished plate at the mirror angle, without noise."""
    s, p = fresnel(np.asarray(zeniths), index)
    q = (s - p) / (s + p)
    readings = {"dop": np.abs(q), "q": q, "q_error": np.full(len(q), 0.01)}
    return at_mirror(zeniths, **readings | variables)


def without(capture, *names) -> xr.Dataset:
    return validate(capture.drop_vars(names))


# --- refused --------------------------------------------------------------------------------------


def refused(capture: xr.Dataset) -> str:
    with pytest.raises(CaptureError) as caught:
        validate(capture, source="plate.nc")
    return str(caught.value)


@each("unit", [1.0, np.pi])
def test_angles_in_radians_are_refused(unit):
    """Also where the azimuths are radians, or the light stands still."""
    angles = np.deg2rad(ZENITHS)
    capture = plate().assign(
        view_zenith=("view", angles),
        light_zenith=("view", angles if unit == 1.0 else np.full(len(angles), np.pi / 4)),
        view_azimuth=("view", np.full(len(angles), 180.0 if unit == 1.0 else np.pi)),
    )
    message = refused(capture)
    assert message.startswith("plate.nc: view_zenith: 0.349066 to 1.3439 looks like radians")
    assert "convert the angles to degrees" in message


def test_a_scan_of_the_light_in_radians_is_refused():
    angles = np.deg2rad(ZENITHS)
    capture = plate().assign(
        view_zenith=("view", np.zeros(len(angles))), light_zenith=("view", angles)
    )
    assert "light_zenith: 0.349066 to " in refused(capture)


def test_views_near_the_normal_are_taken_where_one_far_view_says_so():
    zeniths = np.linspace(0.0, 1.5, 8)
    hint = "say so by one view at 10 degrees or more that is marked valid=False"
    assert hint in refused(plate(zeniths))
    far = np.append(zeniths, 10.0)
    validate(plate(far, valid=np.arange(9) < 8))


@each(
    "zeniths",
    [[0.0, 0.05, 0.1], [0.3, 1.2], [0.0, 0.0, 0.0, 1.0], [0.4, 0.9, 20.0]],
    ids=["all within a tenth", "two views", "two angles", "one view beyond"],
)
def test_few_views_near_the_normal_are_no_radians(zeniths):
    validate(plate(zeniths))


@each(
    ("wavelength", "cause"),
    [(0.633, "micrometers, to be multiplied by 1000"), (633e-9, "meters"), (9.99, "nanometers")],
)
def test_wavelengths_that_no_set_up_has_are_refused(wavelength, cause):
    message = refused(plate().assign_coords(wavelength=wavelength))
    assert "is outside 10 <= value < 1e+30" in message
    assert cause in message


@each("name", ["dop", "q"])
def test_percent_and_an_excess_of_some_percent_have_their_own_hints(name):
    capture = plate()
    assert "not percent" in refused(capture.assign({name: 100.0 * capture[name]}))
    above = refused(capture.assign({name: 1.2 * capture[name]}))
    assert "no light has it: check dark level, background and channel gains" in above


# --- cautioned ------------------------------------------------------------------------------------


def only(capture: xr.Dataset) -> str:
    (sentence,) = cautions(validate(capture))
    return sentence


@each("index", [1.33, 1.5, 2.0])
@each("errors", [True, False])
def test_swapped_s_and_p_are_cautioned(index, errors):
    capture = plate(index=index)
    capture = capture.assign(q=-capture["q"]).drop_vars([] if errors else ["q_error"])
    assert "s and p are likely swapped" in only(capture)


def test_one_swapped_material_of_two_is_named():
    good, bad = plate(), plate()
    both = pb.capture.combine({"good": good, "bad": bad.assign(q=-bad["q"])}, dim="material")
    assert only(both).startswith("q of material bad is negative at ")


def test_light_of_a_bright_body_may_be_p_polarized():
    """What leaves the body at the mirror angle of a dull surface has q below zero."""
    s, p = fresnel(ZENITHS, 1.6)
    capture = plate(q=-(s - p) / (2.0 - s - p), dop=(s - p) / (2.0 - s - p))
    assert cautions(validate(capture)) == ()


@each("signal", ["dop", "q"])
def test_a_plate_whose_light_stands_beside_the_viewer_is_cautioned(signal):
    capture = without(plate(), *({"dop", "q", "q_error"} - {signal}))
    capture["view_azimuth"][:] = 0.0
    assert "the detector was likely on the mirror side" in only(capture)


def test_angles_counted_from_the_surface_are_cautioned():
    capture = plate()
    for name in ("view_zenith", "light_zenith"):
        capture[name] = 90.0 - capture[name]
    assert "counted from the surface" in only(capture)


def test_an_azimuth_of_pi_is_cautioned():
    capture = plate()
    capture["view_azimuth"][:] = np.pi
    assert "pi degrees of azimuth apart" in cautions(validate(capture))[0]


@each(("error", "cautious"), [(0.002, True), (0.01, False)])
def test_more_than_full_polarization_is_cautioned_where_errors_forbid_it(error, cautious):
    capture = plate(ZENITHS[10:14]).assign(q=("view", [0.8] * 4), u=("view", [0.62] * 4))
    capture = capture.assign(
        q_error=("view", [error] * 4), u_error=("view", [error] * 4)
    ).drop_vars("dop")
    said = cautions(validate(capture))
    assert bool(said) == cautious
    assert not cautious or "4 of 4 readings have sqrt(q^2 + u^2) above 1" in said[0]


@each(
    ("scene", "signal", "wavelengths"),
    [("polarimeter", "dop", ()), ("camera", "q", (450.0, 550.0)), ("camera", "intensity", ())],
)
def test_a_limit_of_a_sensor_that_no_file_states_is_cautioned(scene, signal, wavelengths):
    protocol = pb.simulation.Protocol(views=40, wavelengths=wavelengths)
    capture = pb.simulate("plastic", scene=scene, protocol=protocol, seed=0)
    limit = float(capture[signal].isel(wavelength=-1, missing_dims="ignore").quantile(0.9))
    clipped = capture.assign({signal: np.minimum(capture[signal], limit).assign_attrs(units="")})
    *_, sentence = cautions(validate(clipped))
    assert sentence.startswith(f"The 4 largest readings of {signal}")
    assert f" are {limit:.4g} in every digit" in sentence
    assert cautions(validate(clipped.assign(valid=clipped[signal] < limit))) == ()
    clipped[signal].attrs["saturation_level"] = limit
    assert bool(cautions(validate(clipped))) == (signal != "intensity")


@settings(max_examples=300, deadline=None)
@given(
    index=st.floats(1.2, 2.2),
    body=st.floats(0.0, 0.5),
    step=st.sampled_from([0.5, 1.0, 2.0, 2.5, 5.0]),
    digits=st.integers(0, 6),
    repeats=st.integers(1, 4),
)
def test_a_peak_that_a_table_rounds_is_no_limit(index, body, step, digits, repeats):
    zenith = np.arange(20.0, 80.0, step).repeat(repeats)
    s, p = fresnel(zenith, index)
    q = ((s - p) / (s + p + body)).round(digits)
    assert cautions(validate(at_mirror(zenith, q=q))) == ()


@pytest.mark.thorough
@settings(max_examples=25, deadline=None)
@given(
    scene=st.sampled_from(list(pb.setups.SETUPS)),
    preset=st.sampled_from(list(pb.simulation.PRESETS)),
    azimuths=st.sampled_from([(180.0,), (0.0,), (90.0,), (180.0, 150.0, 120.0, 60.0)]),
    light_zenith=st.floats(0.0, 85.0),
    largest_view_zenith=st.floats(5.0, 89.0),
    seed=st.integers(0, 1000),
)
def test_a_simulated_capture_is_never_refused_nor_cautioned(scene, preset, seed, **protocol):
    protocol = pb.simulation.Protocol(views=16, wavelengths=(), **protocol)
    capture = pb.simulate(preset, scene=scene, protocol=protocol, seed=seed)
    assert cautions(validate(capture)) == ()


# --- what is told ---------------------------------------------------------------------------------


def test_what_was_inferred_is_told():
    readings, sign, brewster = inferred(validate(plate(index=1.5).assign_coords(wavelength=633.0)))
    assert readings == (
        "Readings: dop (no errors stated), q (errors stated); 20 views from 20 to 77 degrees from "
        "the normal, 20 of them at the mirror angle; 633 nm."
    )
    assert sign == "Sign: q is positive (s light) at 20 of 20 mirror angles."
    assert "the polarization is largest near 56 degrees" in brewster
    assert "an index near 1.50 (1.33 to 1.70)" in brewster


@each("index", [1.33, 1.5, 1.77])
def test_brewsters_angle_by_eye_holds_the_index(index):
    sentence = inferred(validate(plate(index=index)))[-1]
    low, high = (float(x) for x in sentence.split("(")[-1].rstrip(").").split(" to "))
    assert low < index < high


def test_a_peak_that_the_body_lowers_is_told_as_one():
    s, p = fresnel(ZENITHS, 1.34)
    q = (s - p) / (s + p + 0.02)
    sentence = inferred(validate(plate(q=q, dop=q)))[-1]
    assert "light of the body has likely moved it to larger angles" in sentence


@each("zeniths", [ZENITHS[::6], ZENITHS[:6], ZENITHS[15:]], ids=["sparse", "below it", "beyond it"])
def test_no_brewster_angle_where_the_views_do_not_show_it(zeniths):
    assert not any("Brewster" in sentence for sentence in inferred(validate(plate(zeniths))))


# --- an index beyond the prior --------------------------------------------------------------------


def by_eye(capture: xr.Dataset) -> IndexByEye | None:
    (found,) = indices_by_eye(capture).values()
    return found


@each("index", [1.33, 1.5, 2.03, 3.87])
@each("step", [2.0, 3.0, 5.0])
def test_the_middle_of_the_flanks_is_brewsters_angle(index, step):
    found = by_eye(plate(np.arange(20.0, 86.0, step), index))
    assert found is not None
    assert found.is_pure
    assert abs(found.angle - np.rad2deg(np.arctan(index))) < 0.15 * step
    assert found.low < index < found.high


@each("index", [1.33, 1.5, 2.03, 3.87])
@each("value", [-1.0, 0.0, 0.6, 1.0])
def test_one_spoiled_reading_moves_the_index_by_eye_less_than_its_range(index, value):
    """Wherever it is: far from the peak, on its flanks, next to it, or the largest one itself."""
    zeniths = np.arange(20.0, 84.0, 3.0)
    for place in range(len(zeniths) - 1):  # without the last one the peak of 3.87 has no far side
        capture = plate(zeniths, index)
        capture["q"][place] = value
        found = by_eye(capture)
        assert found is not None, place
        assert found.low < index < found.high, place


def test_a_single_high_reading_is_no_peak():
    capture = plate(q=np.full(len(ZENITHS), 0.4))
    capture["q"][10] = 0.99
    assert by_eye(capture) is None


def test_the_limits_of_the_default_priors_are_those_of_every_set_up():
    for setup in pb.setups.SETUPS.values():
        priors = {**pb.PRIORS, **default_priors(setup, plate())}
        assert support_bounds(priors["refractive_index"]) == DEFAULT_INDICES


def test_an_index_beyond_the_prior_is_one_sentence():
    assert index_sentences(indices_by_eye(plate(index=1.5))) == ()
    (sentence,) = index_sentences(indices_by_eye(plate(index=2.4)))
    assert sentence == (
        "Brewster's angle means an index near 2.39 (2.08 to 2.79), but the default prior of "
        "refractive_index ends at 2: give "
        "priors={'refractive_index': TruncatedNormal(2.4, 0.4, low=1)}."
    )
    (sentence,) = index_sentences(indices_by_eye(plate(index=1.3)), (1.4, 1.8), "cauchy_a", "its")
    assert "its of cauchy_a begins at 1.4" in sentence


def test_materials_share_one_prior_that_allows_all():
    parts = {"a": plate(index=1.5), "b": plate(index=2.4), "c": plate(index=1.7)}
    found = indices_by_eye(pb.capture.combine(parts, dim="material"))
    assert list(found) == ["material a", "material b", "material c"]
    (sentence,) = index_sentences(found)
    assert "an index near 2.39 (2.08 to 2.79) of material b, but" in sentence
    assert "TruncatedNormal(2.1, 0.8, low=1)" in sentence


def test_bounds_inside_the_range_by_eye_know_more_than_the_eye():
    found = by_eye(plate(index=1.5))
    assert found is not None
    assert not found.is_beyond((1.40, 1.45))
    assert found.is_beyond((1.2, 1.45))
    assert not found.is_excluded((1.2, 1.45))
    assert found.is_excluded((1.1, 1.3))
    assert not found.is_excluded((1.1, 1.3), degrees=3.0)


def test_a_peak_that_light_of_a_body_may_have_moved_is_beyond_no_prior():
    s, p = fresnel(ZENITHS, 2.4)
    q = (s - p) / (s + p + 0.1)
    found = indices_by_eye(plate(q=q, dop=q))
    assert found[""] is not None
    assert not found[""].is_pure
    assert index_sentences(found) == ()


def test_set_up_and_incident_levels_are_told():
    capture = validate(plate())
    assert stated(capture)[0].startswith("Set-up: not stated, so a fit takes 'polarimeter'")
    capture = capture.assign_attrs(setup="goniometer", incident_levels="not given")
    setup, levels = stated(capture)
    assert setup == "Set-up: goniometer, which its fits take by default."
    assert levels.startswith("Incident levels: not given")
