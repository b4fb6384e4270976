"""Instrument terms: what a perfect one leaves alone, and what each does to channels s and p."""

import jax.numpy as jnp
import numpy as np
import pytest

from polar_bayes.errors import SceneError
from polar_bayes.physics.discrepancy import Discrepancy
from polar_bayes.physics.geometry import Geometry
from polar_bayes.physics.instrument import (
    AngleZero,
    ChannelGain,
    DarkLevel,
    DolpGain,
    Instrument,
    Leakage,
)
from polar_bayes.physics.stokes import Light

ANGLES = jnp.array([0.0, 30.0, 60.0, 89.9])
GEOMETRY = Geometry(ANGLES, jnp.zeros(4), ANGLES, jnp.full(4, 180.0))
LIGHT = Light(jnp.array([0.1, 0.2, 0.5, 1.0]), jnp.array([0.0, 0.4, 1.0, -0.3]), jnp.full(4, 0.0))
TILTED = LIGHT._replace(q=0.5 * LIGHT.q, u=jnp.array([0.0, 0.3, -0.2, 0.1]))
PERFECT = {
    "angle_zero": jnp.array([0.0]),
    "dolp_gain": jnp.array([1.0]),
    "channel_gain_ratio": jnp.array([1.0]),
    "leakage": jnp.array([0.0]),
    "dark_level": jnp.array([0.0]),
    "discrepancy_amplitude": jnp.array([0.0]),
    "discrepancy_weights": jnp.ones((4, 1)),
}
TERMS = (AngleZero(), DolpGain(), ChannelGain(), Leakage(), DarkLevel(), Discrepancy())


def channels(light: Light) -> tuple[np.ndarray, np.ndarray]:
    return light.intensity * (1 + light.q) / 2, light.intensity * (1 - light.q) / 2


def test_a_perfect_instrument_changes_nothing() -> None:
    instrument = Instrument(TERMS)
    for there, here in zip(instrument.aim(PERFECT, GEOMETRY), GEOMETRY, strict=True):
        np.testing.assert_allclose(there, here)
    for there, here in zip(instrument.record(PERFECT, GEOMETRY, TILTED), TILTED, strict=True):
        np.testing.assert_allclose(there, here, rtol=1e-14)


def test_parameters_come_in_the_order_of_terms() -> None:
    assert Instrument(TERMS).parameters == tuple(PERFECT)


def test_channel_gain_scales_the_ratio_of_channels() -> None:
    recorded = ChannelGain().record({"channel_gain_ratio": jnp.array([1.2])}, GEOMETRY, LIGHT)
    (s, p), (s_new, p_new) = channels(LIGHT), channels(recorded)
    np.testing.assert_allclose(s_new * p, 1.2 * s * p_new, rtol=1e-13, atol=1e-15)


def test_channel_gain_is_a_diattenuator() -> None:
    """It turns the polarization, but fully polarized light stays fully polarized."""
    full = Light(jnp.ones(3), jnp.array([0.6, 0.0, -0.8]), jnp.array([0.8, 1.0, 0.6]))
    recorded = ChannelGain().record({"channel_gain_ratio": jnp.array([3.0])}, GEOMETRY, full)
    np.testing.assert_allclose(np.hypot(recorded.q, recorded.u), 1.0, rtol=1e-14)


def test_leakage_adds_the_other_channel() -> None:
    recorded = Leakage().record({"leakage": jnp.array([0.05])}, GEOMETRY, LIGHT)
    (s, p), (s_new, p_new) = channels(LIGHT), channels(recorded)
    np.testing.assert_allclose(s_new, (s + 0.05 * p) / 1.05, rtol=1e-13)
    np.testing.assert_allclose(p_new, (p + 0.05 * s) / 1.05, rtol=1e-13, atol=1e-16)


def test_dark_level_adds_unpolarized_light() -> None:
    recorded = DarkLevel().record({"dark_level": jnp.array([0.1])}, GEOMETRY, TILTED)
    np.testing.assert_allclose(recorded.intensity, TILTED.intensity + 0.1)
    for new, old in ((recorded.q, TILTED.q), (recorded.u, TILTED.u)):
        np.testing.assert_allclose(
            recorded.intensity * new, TILTED.intensity * old, rtol=1e-13, atol=1e-17
        )


@pytest.mark.parametrize("level", [0.0, -0.1, -5.0])
def test_dark_level_survives_darkness(level: float) -> None:
    dark = Light(jnp.zeros(1), jnp.full(1, 0.5), jnp.zeros(1))
    recorded = DarkLevel().record({"dark_level": jnp.array([level])}, GEOMETRY, dark)
    assert np.all(np.isfinite(np.ravel(recorded)))


def test_angle_zero_shifts_both_zeniths_and_stops_before_grazing() -> None:
    aimed = AngleZero().aim({"angle_zero": jnp.array([0.5])}, GEOMETRY)
    np.testing.assert_allclose(aimed.view_zenith, [0.5, 30.5, 60.5, 89.999])
    np.testing.assert_allclose(aimed.light_zenith, aimed.view_zenith)
    aimed = AngleZero().aim({"angle_zero": jnp.array([-0.5])}, GEOMETRY)
    np.testing.assert_allclose(aimed.view_zenith[0], -0.5)


def test_discrepancy_scales_the_ratio_of_channels_smoothly() -> None:
    term = Discrepancy()
    parameters = {
        "discrepancy_amplitude": jnp.array([0.2]),
        "discrepancy_weights": jnp.array([[1.0], [-0.5], [0.3], [0.8]]),
    }
    recorded = term.record(parameters, GEOMETRY, LIGHT)
    (s, p), (s_new, p_new) = channels(LIGHT), channels(recorded)
    functions = term.functions(ANGLES)
    assert functions.shape == (4, 4)
    factor = np.exp(0.2 * np.sum(parameters["discrepancy_weights"] * functions, axis=0))
    np.testing.assert_allclose(s_new * p, factor * s * p_new, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize(("basis", "length"), [(4, 25.0), (8, 15.0), (1, 60.0)])
def test_discrepancy_has_the_amplitude_it_says(basis: int, length: float) -> None:
    functions = Discrepancy(basis, length).functions(jnp.linspace(0.0, 90.0, 400))
    np.testing.assert_allclose(np.mean(np.sum(functions**2, axis=0)), 1.0, rtol=5e-3)


def test_discrepancy_of_many_functions_is_the_kernel() -> None:
    """In the middle of the range the covariance is that of the squared exponential."""
    term = Discrepancy(basis=40, length=12.0)
    functions = np.asarray(term.functions(jnp.array([40.0, 45.0, 52.0])))
    covariance = functions.T @ functions
    gap = np.array([40.0, 45.0, 52.0])[:, None] - np.array([40.0, 45.0, 52.0])
    kernel = np.exp(-0.5 * (gap / 12.0) ** 2)
    np.testing.assert_allclose(covariance / covariance[1, 1], kernel, atol=1e-3)


def test_weights_may_have_leading_axes() -> None:
    parameters = {
        "discrepancy_amplitude": jnp.full((2, 3, 1), 0.2),
        "discrepancy_weights": jnp.ones((2, 3, 4, 1)),
    }
    assert Discrepancy().record(parameters, GEOMETRY, LIGHT).q.shape == (2, 3, 4)


@pytest.mark.parametrize("terms", [DolpGain(), [DolpGain()], (DolpGain,), ("DolpGain",)])
def test_only_terms_make_an_instrument(terms: object) -> None:
    with pytest.raises(SceneError, match=r"Instrument: .* is no tuple of instrument terms; write"):
        Instrument(terms)


def test_a_term_acts_once() -> None:
    with pytest.raises(SceneError, match="repeat one; give each term once"):
        Instrument((DolpGain(), DolpGain()))


@pytest.mark.parametrize("bad", [{"basis": 0}, {"basis": 2.5}, {"length": 0.0}])
def test_discrepancy_is_checked(bad: dict) -> None:
    with pytest.raises(SceneError, match=r"Discrepancy: .* make no smooth function"):
        Discrepancy(**bad)
