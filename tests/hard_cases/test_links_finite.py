"""Every link, at the inputs where noise models break: PHYSICS section 8.

Brightness 0 and 1, a view along the surface, readings and predictions of exactly 0 and 1, and
concentrations from 1e-3 to 1e8. The log density, its gradient and its Hessian with respect to the
prediction and the noise parameters are finite, in both precisions.
"""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from cases import each
from digits import assert_finite, value_gradient_hessian
from synthetic_observations import make_observations

from polar_bayes.observation.links import (
    BetaLink,
    ConcentrationSchedule,
    LogitNormalLink,
    NormalLink,
    ScaleSchedule,
    StokesLink,
    StudentTLink,
)

ZENITHS = (0.0, 60.0, 89.999)
BRIGHTNESS = (0.0, 1e-12, 0.5, 1.0)
UNIT = (0.0, 1e-12, 1e-6, 0.3, 1.0 - 1e-7, 1.0)
SIGNED = (-1.0, -0.3, 0.0, 1e-12, 0.3, 1.0)
INTENSITY = (-0.01, 0.0, 1e-12, 0.5, 0.95, 1.0, 3.0)
SCALES = (1e-4, 0.05, 10.0)

# Concentrations from 1e-3 to 1e8, whatever the brightness: alone, and on top of a least one.
CONCENTRATIONS = (1e-3, 30.0, 1e8)
STEEP = ConcentrationSchedule(minimum=1e-3, brightness_exponent=1.0, angle_exponent=2.0)
FLAT = ConcentrationSchedule(minimum=1e-6, brightness_exponent=0.0, angle_exponent=0.0)

# variable, link, predictions, readings, values of each noise parameter
LINKS = {
    "Beta, steep": ("dop", BetaLink(1e-3, STEEP), UNIT, UNIT, (CONCENTRATIONS,)),
    "Beta, flat": ("dop", BetaLink(1e-6, FLAT), UNIT, UNIT, (CONCENTRATIONS,)),
    "logit-normal": ("dop", LogitNormalLink(margin=1e-6), UNIT, UNIT, (SCALES,)),
    "normal": ("q", NormalLink(), SIGNED, SIGNED, (SCALES,)),
    "Stokes": ("q", StokesLink(), SIGNED, SIGNED, (SCALES,)),
    "Stokes, Student's t": ("u", StokesLink(4.0), SIGNED, SIGNED, (SCALES,)),
    "Stokes, stated": ("q", StokesLink(4.0, stated_errors=True), SIGNED, SIGNED, (SCALES,)),
    "intensity": ("intensity", StudentTLink(), INTENSITY, INTENSITY, ((1e-3, 1.0, 1e3), SCALES)),
    "intensity, steep": (
        "intensity",
        StudentTLink(3.0, ScaleSchedule(1.0, 1.0, least_headroom=1e-3, least_cosine=1e-3)),
        INTENSITY,
        INTENSITY,
        ((1e-3, 1.0, 1e3), SCALES),
    ),
    "intensity, flat": (
        "intensity",
        StudentTLink(7.0, ScaleSchedule(0.0, 0.0)),
        INTENSITY,
        INTENSITY,
        ((1e-3, 1.0, 1e3), SCALES),
    ),
}


FIRST = [(name, np.float64) for name in ("Beta, steep", "Stokes, stated", "intensity")]
FIRST += [("Beta, steep", np.float32)]  # one of each class in double precision, one in single
RUNS = [(name, dtype) for name in LINKS for dtype in (np.float64, np.float32)]


@each(("name", "dtype"), sorted(RUNS, key=lambda run: run not in FIRST), quick=len(FIRST))
def test_density_gradient_and_hessian_of_a_link_are_finite(name, dtype):
    variable, link, predictions, readings, levels = LINKS[name]
    stopped = (False, True) if variable == "intensity" else (False,)
    # A sensor reports nothing below zero, and stops at full scale at the latest.
    possible = [r for r in readings if variable != "intensity" or 0.0 <= r <= 1.0]
    cases = list(
        itertools.product(ZENITHS, BRIGHTNESS, possible, stopped, predictions, *map(tuple, levels))
    )
    rows = np.array(cases, dtype)

    def density(inputs, fixed):
        zenith, brightness, reading, saturated = fixed
        data = make_observations(
            zenith[None],
            brightness=brightness,
            saturated=saturated > 0,
            full_scale=1.0,
            dtype=dtype,
        )
        noise = dict(zip(link.parameters, inputs[1:], strict=True))
        prediction = {variable: inputs[:1]}
        distribution = link.distribution(variable, prediction, data, noise)
        return distribution.log_prob(link.reading(reading[None]))[0]

    found = value_gradient_hessian(density, rows[:, 4:], rows[:, :4])
    assert_finite(found, rows, dtype)


def test_the_concentrations_of_these_cases_span_the_range_of_the_specification():
    least = FLAT.concentration(jnp.asarray(1e-3), jnp.asarray(0.0), jnp.asarray(1.0))
    most = FLAT.concentration(jnp.asarray(1e8), jnp.asarray(0.0), jnp.asarray(1.0))
    assert float(least) == pytest.approx(1e-3, rel=2e-3)  # the least concentration is on top
    assert float(most) == pytest.approx(1e8)
    assert {0.0, 1.0} <= set(BRIGHTNESS)
    assert {0.0, 1.0} <= set(UNIT)
    assert max(ZENITHS) == 89.999
