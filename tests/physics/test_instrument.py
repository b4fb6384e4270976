"""Instrument terms: what a perfect one leaves alone, and what each does to channels s and p."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import each

from polar_bayes.physics.geometry import Geometry
from polar_bayes.physics.instrument import (
    AbstractInstrumentTerm,
    Analyzer,
    AngleZero,
    BeamOverlap,
    ChannelGain,
    DarkLevel,
    Discrepancy,
    DolpGain,
    Instrument,
    Leakage,
    Saturation,
)
from polar_bayes.physics.stokes import Light, to_stokes

ANGLES = jnp.array([0.0, 30.0, 60.0, 89.9])
GEOMETRY = Geometry(ANGLES, jnp.zeros(4), ANGLES, jnp.full(4, 180.0))
LIGHT = Light(jnp.array([0.1, 0.2, 0.5, 1.0]), jnp.array([0.0, 0.4, 1.0, -0.3]), jnp.full(4, 0.0))
TILTED = LIGHT._replace(q=0.5 * LIGHT.q, u=jnp.array([0.0, 0.3, -0.2, 0.1]))
TERMS = (AngleZero(), DolpGain(), ChannelGain(), Leakage(), DarkLevel(), BeamOverlap())
TERMS += (Discrepancy(),)
PERFECT = {
    **{name: jnp.array([value]) for term in TERMS for name, value in term.neutral.items()},
    "discrepancy_weights": jnp.ones((3, 1)),
}


def recorded(term: AbstractInstrumentTerm | Instrument, light: Light, **values: object) -> Light:
    """Light as a term records it."""
    parameters = {name: jnp.atleast_1d(value) for name, value in values.items()}
    return term.record(parameters, GEOMETRY, light)


def channels(light: Light) -> tuple[np.ndarray, np.ndarray]:
    return light.intensity * (1 + light.q) / 2, light.intensity * (1 - light.q) / 2


@pytest.mark.thorough
def test_a_perfect_instrument_changes_nothing() -> None:
    instrument = Instrument(TERMS)
    jax.tree.map(np.testing.assert_allclose, instrument.aim(PERFECT, GEOMETRY), GEOMETRY)
    for there, here in zip(instrument.record(PERFECT, GEOMETRY, TILTED), TILTED, strict=True):
        np.testing.assert_allclose(there, here, rtol=1e-14)


def test_channel_gain_scales_the_ratio_of_channels() -> None:
    found = recorded(ChannelGain(), LIGHT, channel_gain_ratio=1.2)
    (s, p), (s_new, p_new) = channels(LIGHT), channels(found)
    np.testing.assert_allclose(s_new * p, 1.2 * s * p_new, rtol=1e-13, atol=1e-15)


@pytest.mark.thorough
def test_channel_gain_is_a_diattenuator() -> None:
    """It turns the polarization, but fully polarized light stays fully polarized."""
    full = Light(jnp.ones(3), jnp.array([0.6, 0.0, -0.8]), jnp.array([0.8, 1.0, 0.6]))
    _, q, u = recorded(ChannelGain(), full, channel_gain_ratio=3.0)
    np.testing.assert_allclose(np.hypot(q, u), 1.0, rtol=1e-14)


@pytest.mark.thorough
def test_leakage_adds_the_other_channel() -> None:
    (s, p), (s_new, p_new) = channels(LIGHT), channels(recorded(Leakage(), LIGHT, leakage=0.05))
    np.testing.assert_allclose(s_new, (s + 0.05 * p) / 1.05, rtol=1e-13)
    np.testing.assert_allclose(p_new, (p + 0.05 * s) / 1.05, rtol=1e-13, atol=1e-16)


def test_dark_level_adds_unpolarized_light() -> None:
    found = to_stokes(recorded(DarkLevel(), TILTED, dark_level=0.1))
    expected = to_stokes(TILTED) + np.array([0.1, 0.0, 0.0])
    np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-17)


def test_angle_zero_shifts_both_zeniths_and_stops_before_grazing() -> None:
    aimed = AngleZero().aim({"angle_zero": jnp.array([0.5])}, GEOMETRY)
    np.testing.assert_allclose(aimed.view_zenith, [0.5, 30.5, 60.5, 89.999])
    np.testing.assert_allclose(aimed.light_zenith, aimed.view_zenith)
    aimed = AngleZero().aim({"angle_zero": jnp.array([-0.5])}, GEOMETRY)
    np.testing.assert_allclose(aimed.view_zenith[0], -0.5)


@pytest.mark.thorough
def test_discrepancy_scales_the_ratio_of_channels_smoothly() -> None:
    term, weights = Discrepancy(), jnp.array([[1.0], [-0.5], [0.8]])
    found = recorded(term, LIGHT, discrepancy_amplitude=0.2, discrepancy_weights=weights)
    (s, p), (s_new, p_new) = channels(LIGHT), channels(found)
    functions = term.functions(ANGLES)
    assert functions.shape == (3, 4)
    factor = np.exp(0.2 * np.sum(weights * functions, axis=0))
    np.testing.assert_allclose(s_new * p, factor * s * p_new, rtol=1e-12, atol=1e-15)


@each(("basis", "length"), [(3, 25.0), (8, 15.0), (1, 60.0)])
def test_discrepancy_has_the_amplitude_it_says(basis: int, length: float) -> None:
    functions = Discrepancy(basis, length).functions(jnp.linspace(0.0, 90.0, 400))
    np.testing.assert_allclose(np.mean(np.sum(functions**2, axis=0)), 1.0, rtol=5e-3)


@each("basis", [1, 3, 40])
def test_discrepancy_vanishes_at_normal_incidence(basis: int) -> None:
    """An isotropic sample reflects s and p alike there: what they differ by is the gain."""
    at_zero = np.asarray(Discrepancy(basis).functions(jnp.zeros(1)))
    np.testing.assert_allclose(at_zero, 0.0, atol=4.0 * np.finfo(float).eps)


@pytest.mark.thorough
def test_discrepancy_of_many_functions_is_the_kernel() -> None:
    """In the middle of the range the covariance is that of the squared exponential."""
    term = Discrepancy(basis=40, length=12.0)
    functions = np.asarray(term.functions(jnp.array([40.0, 45.0, 52.0])))
    covariance = functions.T @ functions
    gap = np.array([40.0, 45.0, 52.0])[:, None] - np.array([40.0, 45.0, 52.0])
    kernel = np.exp(-0.5 * (gap / 12.0) ** 2)
    np.testing.assert_allclose(covariance / covariance[1, 1], kernel, atol=1e-3)


# --- where light is lost on the way to the number -------------------------------------------------


def test_an_analyzer_obeys_malus() -> None:
    """Fully polarized light at 20 degrees passes as the squared cosine of what is between."""
    angles = (0.0, 20.0, 65.0, 110.0)
    turn = np.deg2rad(40.0)
    light = Light(jnp.full(4, 2.0), jnp.full(4, np.cos(turn)), jnp.full(4, np.sin(turn)))
    found = recorded(Analyzer(angles), light)
    expected = 2.0 * np.cos(np.deg2rad(np.array(angles) - 20.0)) ** 2
    np.testing.assert_allclose(found.intensity, expected, rtol=1e-14, atol=3e-16)
    np.testing.assert_array_equal(found.q, light.q)


def test_four_analyzers_measure_the_polarization() -> None:
    readings = [recorded(Analyzer(a), TILTED).intensity for a in (0.0, 45.0, 90.0, 135.0)]
    total = readings[0] + readings[2]
    np.testing.assert_allclose((readings[0] - readings[2]) / total, TILTED.q, atol=1e-15)
    np.testing.assert_allclose((readings[1] - readings[3]) / total, TILTED.u, atol=1e-15)


def test_a_sensor_stops_at_its_level() -> None:
    found = recorded(Saturation(0.3), TILTED)
    np.testing.assert_array_equal(found.intensity, [0.1, 0.2, 0.3, 0.3])
    np.testing.assert_array_equal(found.q, TILTED.q)
    assert Saturation(0.3).parameters == ()


def test_light_meets_the_terms_in_their_order() -> None:
    """A polarizer before the sensor's stop, or behind it."""
    first = recorded(Instrument((Analyzer(0.0), Saturation(0.3))), LIGHT)
    last = recorded(Instrument((Saturation(0.3), Analyzer(0.0))), LIGHT)
    np.testing.assert_allclose(first.intensity, [0.05, 0.14, 0.3, 0.3], rtol=1e-14)
    np.testing.assert_allclose(last.intensity, [0.05, 0.14, 0.3, 0.105], rtol=1e-14)
