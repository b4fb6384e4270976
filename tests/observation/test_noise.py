"""The schedules of the paper's section 2, and the bounds that the printed formulas lack."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import each

from polar_bayes.errors import FitError
from polar_bayes.observation.links import SMOOTHING, ConcentrationSchedule, ScaleSchedule

BRIGHTNESS = np.array([0.0, 0.2, 0.7, 1.0])
COSINES = np.cos(np.deg2rad([0.0, 30.0, 60.0, 85.0]))

# Half a dozen roundings of double precision.
ROUNDING = 1e-14


def test_concentration_is_the_papers_formula():
    schedule = ConcentrationSchedule(minimum=2.0, brightness_exponent=0.6, angle_exponent=1.5)
    expected = 2.0 + 300.0 * BRIGHTNESS**0.6 * COSINES**1.5
    found = schedule.concentration(300.0, BRIGHTNESS, COSINES)
    np.testing.assert_allclose(found, expected, rtol=ROUNDING)


def test_scale_is_the_papers_formula_away_from_its_bounds():
    schedule = ScaleSchedule(headroom_exponent=0.7, angle_exponent=0.3)
    headroom = 1.0 - np.array([0.0, 0.2, 0.7, 0.9])
    expected = 0.01 * headroom**-0.7 * COSINES**-0.3
    found = np.asarray(schedule.scale(0.01, 1.0 - headroom, COSINES))
    # The smooth bound adds at most width * exp(-spare) to the headroom, and so takes this share.
    width = SMOOTHING * schedule.least_headroom
    added = width * np.exp(-(headroom - schedule.least_headroom) / width)
    slack = 0.7 * added / headroom + ROUNDING
    assert np.all(np.abs(found / expected - 1.0) <= slack)
    assert slack[1] < 1e-12


@pytest.mark.thorough
@each("exponent", [0.0, 0.5, 1.0])
def test_a_dark_view_keeps_the_least_concentration(exponent):
    schedule = ConcentrationSchedule(brightness_exponent=exponent)
    found = schedule.concentration(jnp.asarray(200.0), jnp.asarray(0.0), jnp.asarray(1.0))
    assert float(found) == (5.0 if exponent else 205.0)  # without exponent, no dependence


def test_brighter_and_more_upright_views_are_never_less_concentrated():
    schedule = ConcentrationSchedule()
    grid = schedule.concentration(200.0, BRIGHTNESS[:, None], COSINES)
    assert np.all(np.diff(grid, axis=0) > 0.0)
    assert np.all(np.diff(grid[1:], axis=1) < 0.0)  # COSINES fall


def test_noise_of_the_intensity_grows_from_its_base_to_its_bound():
    schedule = ScaleSchedule(headroom_exponent=1.0, angle_exponent=1.0)
    brightness = np.array([0.0, 0.5, 0.95, 1.0, 1.5, 1e8])
    cosines = np.array([1.0, 0.02, np.cos(np.deg2rad(89.999)), 0.0])
    factor = np.asarray(schedule.scale(1.0, brightness[:, None], cosines))
    assert factor.min() == pytest.approx(1.0, abs=1e-12)
    # 1 / 0.05 far past full scale times 1 / 0.02 along the surface.
    assert factor.max() == pytest.approx(1000.0, rel=ROUNDING)
    assert np.all(np.diff(factor, axis=0) >= 0.0)
    assert np.all(np.diff(factor, axis=1) >= 0.0)


def test_the_bound_at_full_scale_has_no_corner():
    """A second derivative that jumps would put a corner on top of a posterior."""
    brightness = jnp.linspace(0.85, 1.05, 401)
    bend = jax.vmap(jax.grad(jax.grad(lambda b: ScaleSchedule().scale(1.0, b, jnp.ones_like(b)))))
    second = np.asarray(jax.jit(bend)(brightness))
    # A corner would be one step as high as the whole curve; smooth, it is 1 / 20 at this spacing.
    assert np.max(np.abs(np.diff(second))) < 0.05 * np.ptp(second)


@pytest.mark.thorough
@each("schedule", [ConcentrationSchedule, ScaleSchedule])
def test_a_schedule_follows_the_precision_of_its_inputs(schedule):
    method = "concentration" if schedule is ConcentrationSchedule else "scale"
    inputs = (jnp.asarray(value, jnp.float32) for value in (1.0, 0.5, 0.5))
    assert getattr(schedule(), method)(*inputs).dtype == jnp.float32


@each("schedule", [ConcentrationSchedule(), ScaleSchedule()])
def test_a_schedule_is_a_constant_of_a_compiled_program(schedule):
    assert hash(schedule) == hash(type(schedule)())
    assert schedule == type(schedule)()
    with pytest.raises(dataclasses.FrozenInstanceError):
        schedule.angle_exponent = 0.1


@each(
    ("schedule", "field", "value"),
    [
        (ConcentrationSchedule, "minimum", 0.0),
        (ConcentrationSchedule, "minimum", -1.0),
        (ConcentrationSchedule, "brightness_exponent", 1.1),
        (ConcentrationSchedule, "brightness_exponent", float("nan")),
        (ConcentrationSchedule, "angle_exponent", 2.1),
        (ScaleSchedule, "headroom_exponent", -0.1),
        (ScaleSchedule, "angle_exponent", 1.1),
        (ScaleSchedule, "least_headroom", 0.0),
        (ScaleSchedule, "least_cosine", 2.0),
    ],
)
def test_a_field_outside_its_range_is_refused_by_name(schedule, field, value):
    with pytest.raises(FitError, match=f"^{schedule.__name__}: {field} is {value}; give a number"):
        schedule(**{field: value})
