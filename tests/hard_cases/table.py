"""Where textbook formulas fail: their errors beside ours, as a table of the documentation.

`python -m tests.hard_cases.table` prints it; `docs/hard_cases.md` holds what it printed.
"""

import functools
from collections.abc import Callable
from typing import Literal, NamedTuple

import click
import jax
import jax.numpy as jnp
import jax.scipy.special
import mpmath as mp
import numpy as np

from polar_bayes.observation.distributions import MeanConcentrationBeta
from polar_bayes.observation.links import ScaleSchedule
from polar_bayes.physics.geometry import Geometry, cos_degrees, mirror_facet, sin_degrees
from polar_bayes.physics.microfacet import Beckmann
from polar_bayes.physics.mixing import StokesMixing
from polar_bayes.physics.stack import Layer, Stack
from polar_bayes.physics.stokes import Light, degree_of_linear_polarization, mirror_light

mp.mp.dps = 50


class Case(NamedTuple):
    """One quantity at one hard point.

    Args:
        where: The hard point.
        what: The quantity.
        at: Its arguments; the gradient is taken in all of them.
        textbook: The usual formula.
        ours: This package's.
        exact: Its value with 50 digits: the textbook's formula in mpmath, or a limit where that
            has none; None where only a finite value and slope are asked for.
    """

    where: str
    what: str
    at: tuple[float, ...]
    textbook: Callable
    ours: Callable
    exact: Callable | Literal["textbook"] | None = "textbook"


# --- textbook forms, on whatever numbers they are given (`m` is jax.numpy or mpmath) ----------


def powers(angle, n, m):
    """Reflectances from Snell's law and the angles."""
    inside = m.asin(m.sin(angle) / n)
    s = (m.cos(angle) - n * m.cos(inside)) / (m.cos(angle) + n * m.cos(inside))
    p = (n * m.cos(angle) - m.cos(inside)) / (n * m.cos(angle) + m.cos(inside))
    return s**2, p**2


def reflected_dolp(zenith, n, m=jnp):
    s, p = powers(zenith * m.pi / 180, n, m)
    return (s - p) / (s + p)


def exit_dolp(zenith, n, m=jnp):
    s, p = powers(zenith * m.pi / 180, n, m)
    return (s - p) / (2 - s - p)


def transmitted(zenith, n, m=jnp):
    s, p = powers(zenith * m.pi / 180, n, m)
    return 1 - (s + p) / 2


def contrast(zenith, n, m=jnp):
    s, p = powers(zenith * m.pi / 180, n, m)
    return (s - p) / 2


def coated_contrast(zenith, n, m=jnp):
    """A clear coat of index 1.5 on the body, powers of s and p stacked apart."""
    angle = zenith * m.pi / 180
    inside = m.asin(m.sin(angle) / 1.5)
    stacked = []
    for top, bottom in zip(powers(angle, 1.5, m), powers(inside, n / 1.5, m), strict=True):
        stacked.append(top + (1 - top) ** 2 * bottom / (1 - top * bottom))
    return (stacked[0] - stacked[1]) / 2


def tilt(view, light, m=jnp):
    """Squared slope of the mirror facet from vectors, light opposite to the viewer."""
    view, light = view * m.pi / 180, light * m.pi / 180
    x, z = m.sin(view) - m.sin(light), m.cos(view) + m.cos(light)
    length = m.sqrt(x**2 + z**2)
    return m.tan(m.acos(z / length)) ** 2


def density(tan_squared, roughness, m=jnp):
    exponent = m.exp(-tan_squared / roughness**2)
    return exponent * (1 + tan_squared) ** 2 / (m.pi * roughness**2)


def beta_density(mean, concentration, value, m=jnp):
    a, b = mean * concentration, (1 - mean) * concentration
    gamma = jax.scipy.special.gammaln if m is jnp else mp.loggamma
    normal = gamma(a + b) - gamma(a) - gamma(b)
    return normal + (a - 1) * m.log(value) + (b - 1) * m.log(1 - value)


# --- ours --------------------------------------------------------------------------------------


def angles(zenith):
    return cos_degrees(zenith), sin_degrees(zenith) ** 2


def our_reflected_dolp(zenith, n):
    power = Stack(n).relative_reflection(*angles(zenith))
    return power.contrast * power.sin_squared / power.mean


def our_exit_dolp(zenith, n):
    power = Stack(n).transmission(*angles(zenith))
    return -power.contrast * power.sin_squared / power.mean


def our_contrast(zenith, n):
    power = Stack(n).reflection(*angles(zenith))
    return power.contrast * power.sin_squared


def our_coated_contrast(zenith, n):
    power = Stack(n, (Layer(jnp.asarray(1.5, n.dtype)),)).reflection(*angles(zenith))
    return power.contrast * power.sin_squared


def our_tilt(view, light):
    one = jnp.ones((1,), view.dtype)
    geometry = Geometry(view * one, 180.0 * one, light * one, 0.0 * one)
    return mirror_facet(geometry).tan_squared_tilt[0]


def our_retroreflected(zenith, n):
    one = jnp.ones((1,), zenith.dtype)
    geometry = Geometry(zenith * one, 0.0 * one, zenith * one, 0.0 * one)
    half = jnp.asarray(0.5, zenith.dtype) * one
    light = mirror_light(Stack(n * one), mirror_facet(geometry), geometry, (half, half))
    return light.u[0]


def retroreflected(zenith, n):
    """Return the same quantity from the angle of the s axis, atan2(0, 0)."""
    x = jnp.sin(jnp.deg2rad(zenith - zenith))
    turn = 2.0 * jnp.arctan2(0.0 * x, x)
    return 0.5 * (jnp.cos(turn) ** 2 + jnp.sin(turn) ** 2) + 0.0 * n


def our_share(fraction, surface):
    zero = jnp.zeros_like(fraction)
    mixed = StokesMixing().mix(
        fraction, Light(surface, zero + 1.0, zero), Light(zero + 1.0, zero, zero)
    )
    return mixed.q + 1.0


def sky_dolp(n):
    """Polarization averaged over two facets of a surface that reflects nothing."""
    power = Stack(n).relative_reflection(*angles(jnp.asarray([40.0, 60.0], n.dtype)))
    return jnp.sum(power.contrast * power.sin_squared) / jnp.sum(power.mean)


def textbook_sky_dolp(n):
    s, p = powers(jnp.deg2rad(jnp.asarray([40.0, 60.0], n.dtype)), n, jnp)
    return jnp.sum(s - p) / jnp.sum(s + p)


def exact_sky_dolp(n):
    near = mp.mpf(n) + mp.mpf(10) ** -25
    pairs = [powers(mp.radians(angle), near, mp) for angle in (40, 60)]
    return sum(s - p for s, p in pairs) / sum(s + p for s, p in pairs)


def our_transmittance(zenith, n):
    return Stack(n).transmission(*angles(zenith)).mean


def our_log_density(tan_squared, roughness):
    return jnp.log(Beckmann().density(tan_squared, roughness))


def our_beta_density(mean, concentration, value):
    return MeanConcentrationBeta(mean, concentration).log_prob(value)


def exactly(value):
    """A limit where the formula has no value."""
    return lambda *_: mp.mpf(value)


CASES = (
    Case("89.99 degrees", "DoLP of reflection", (89.99, 1.5), reflected_dolp, our_reflected_dolp),
    Case("n = 1.000001", "DoLP of reflection", (50, 1.000001), reflected_dolp, our_reflected_dolp),
    Case("n = 1", "DoLP under two facets", (1.0,), textbook_sky_dolp, sky_dolp, exact_sky_dolp),
    Case("0.01 degrees", "DoLP of exit", (0.01, 1.5), exit_dolp, our_exit_dolp),
    Case("89.9999 degrees", "transmittance", (89.9999, 1.5), transmitted, our_transmittance),
    Case("0.01 degrees", "contrast of s and p", (0.01, 1.5), contrast, our_contrast),
    Case(
        "0.01 degrees", "contrast under a clear coat", (0.01, 1.7),
        coated_contrast, our_coated_contrast,
    ),
    Case(
        "0.0001 degrees from the mirror direction", "squared slope of the facet", (45.0001, 45.0),
        tilt, our_tilt,
    ),
    Case(
        "roughness 0.05, slope 1", "log density of facets", (1.0, 0.05),
        lambda t, r: jnp.log(density(t, r)), our_log_density, None,
    ),
    Case(
        "viewer = light", "u of reflected light, u = 0.5 coming in", (30.0, 1.5),
        retroreflected, our_retroreflected, exactly("0.5"),
    ),
    Case(
        "no light", "degree of polarization", (0.0, 0.0),
        lambda q, u: 1e-12 + jnp.sqrt(q**2 + u**2), degree_of_linear_polarization,
        exactly("1e-12"),
    ),
    Case(
        "fraction 0 of no surface light", "1 + share of the surface", (0.0, 0.0),
        lambda f, s: 1.0 + (1 - f) * s / ((1 - f) * s + f), our_share, None,
    ),
    Case(
        "concentration 1e8", "Beta log density", (0.3, 1e8, 0.30005),
        beta_density, our_beta_density,
    ),
    Case(
        "reading at full scale", "scale of intensity noise", (0.02, 1.0, 0.5),
        lambda b, i, c: b * (1 - i) ** -0.5 * c**-0.5, ScaleSchedule().scale, None,
    ),
)  # fmt: skip


HEADER = (
    "| hard point | quantity | textbook, double | ours, double | textbook, single | ours, single |"
)


def error(case: Case, formula: Callable, dtype: type) -> float:
    """Relative error of a value, infinite where value or gradient is not finite."""
    at = tuple(jnp.asarray(number, dtype) for number in case.at)
    value = formula(*at)
    slopes = jax.grad(lambda arguments: formula(*arguments))(at)
    if not all(np.isfinite(number).all() for number in (value, *slopes)):
        return np.inf
    if case.exact is None:
        return 0.0
    # The exact value belongs to the numbers as they were rounded.
    with_digits = case.exact if case.exact != "textbook" else functools.partial(case.textbook, m=mp)
    exact = with_digits(*(mp.mpf(float(number)) for number in at))
    return float(abs(mp.mpf(float(value)) - exact) / abs(exact))


def row(case: Case) -> str:
    """One line of the table."""
    cells = []
    for dtype in (np.float64, np.float32):
        for formula in (case.textbook, case.ours):
            found = error(case, formula, dtype)
            if not np.isfinite(found):
                cells.append("not finite")
            else:
                cells.append("finite" if case.exact is None else f"{found:.0e}" if found else "0")
    return f"| {case.where} | {case.what} | {' | '.join(cells)} |"


def table() -> str:
    """The whole table in Markdown."""
    return "\n".join([HEADER, "|---" * 6 + "|", *map(row, CASES)])


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    click.echo(table())
