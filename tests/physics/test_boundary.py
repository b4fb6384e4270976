"""One boundary, bare or with films: against 80 digits, against matrices."""

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
import vector_optics as twin
from cases import each
from hypothesis import given, settings
from hypothesis import strategies as st
from optics import incidence, one_by_one

from polar_bayes.physics import boundary
from polar_bayes.physics.boundary import Diattenuation, Film, Medium
from polar_bayes.physics.geometry import cos_degrees, sin_degrees

RUN = settings(deadline=None, max_examples=60, derandomize=True)
zenith = st.floats(0.0, 89.9)
index = st.floats(1.0, 3.0)
film = st.tuples(index, st.floats(0.0, 30.0))


def media(degrees: float, *indexes: float) -> list[Medium]:
    cos_squared = cos_degrees(degrees) ** 2
    return [boundary.medium(jnp.asarray(n), cos_squared) for n in indexes]


@jax.jit
def respond(cosine, sin_squared, indexes, wavenumbers) -> tuple[Diattenuation, Diattenuation]:
    """Air, films, body."""
    above, *inside, below = (boundary.medium(n, cosine**2) for n in indexes)
    layers = tuple(
        Film(medium, jnp.exp(1j * wavenumber * medium.normal))
        for medium, wavenumber in zip(inside, wavenumbers, strict=True)
    )
    return boundary.filmed(above, layers, below, sin_squared)


def filmed(degrees: float, layers: list, below: float) -> tuple[Diattenuation, Diattenuation]:
    indexes = [jnp.asarray(n) for n in (1.0, *(layer[0] for layer in layers), below)]
    wavenumbers = [jnp.asarray(2.0 * layer[1]) for layer in layers]
    return respond(*incidence(degrees), indexes, wavenumbers)


@given(theta=zenith, first=index, second=index)
@RUN
def test_what_is_not_reflected_passes(theta: float, first: float, second: float) -> None:
    b = sin_degrees(theta) ** 2
    above, below = media(theta, first, second)
    reflected, passed = boundary.reflection(above, below, b), boundary.transmission(above, below, b)
    np.testing.assert_allclose((one_by_one(reflected) + one_by_one(passed))[:2], 1.0, atol=3e-14)


@each("theta", [0.0, 1e-6, 1.0, 40.0, 56.3, 75.0, 89.0, 89.999])
@each("indexes", [(1.0, 1.5), (1.0, 1.0 + 1e-6), (1.4, 1.6), (1.6, 1.4), (1.5, 1.5001), (2.4, 1.0)])
def test_no_digit_is_lost_against_eighty(theta: float, indexes: tuple[float, float]) -> None:
    """Contrast and shortfall are quotients of differences; here they are taken in 80 digits.

    1e-12 is 5,000 roundings: a shortfall near n = 1 is the square of one.
    """
    with mp.workdps(80):
        c = mp.cos(mp.radians(mp.mpf(theta)))
        b = 1 - c**2
        n, m = (mp.mpf(x) for x in indexes)
        inside, outside = (mp.sqrt(1 - b / x**2) for x in (n, m))
        r_s = (n * inside - m * outside) / (n * inside + m * outside)
        r_p = (n * outside - m * inside) / (n * outside + m * inside)
        truths = []
        for s, p, cross in (
            (r_s**2, r_p**2, r_s * r_p),
            (1 - r_s**2, 1 - r_p**2, mp.sqrt((1 - r_s**2) * (1 - r_p**2))),
        ):
            truths.append([(s + p) / 2, (s - p) / 2, (s + p) / 2 - cross])
        above, below = media(theta, *indexes)
        sin_squared = sin_degrees(theta) ** 2
        for law, truth in zip((boundary.reflection, boundary.transmission), truths, strict=True):
            power = law(above, below, sin_squared)
            for power_of_b, (value, true) in enumerate(zip(power, truth, strict=False)):
                assert abs(mp.mpf(float(value)) * b**power_of_b - true) <= 1e-12 * abs(true)


@given(theta=zenith, layers=st.lists(film, min_size=1, max_size=3), body=index)
@settings(parent=RUN, max_examples=100)
def test_films_agree_with_characteristic_matrices(theta: float, layers: list, body: float) -> None:
    """Fields reflected, powers passed. 1e-12 of 1: phases of 30 carry 30 roundings."""
    reflected, passed = filmed(theta, layers, body)
    b = float(sin_degrees(theta) ** 2)
    fields, _, through = twin.films(1.0, layers, body, b)
    s, p, cross = twin.powers(fields)
    np.testing.assert_allclose(one_by_one(reflected), [s, p, np.real(cross)], atol=1e-12)
    np.testing.assert_allclose(one_by_one(passed)[:2], through, atol=1e-12)


@given(theta=zenith, layer=film, body=index)
@RUN
def test_a_film_turns_passing_light_as_its_fields_do(theta, layer, body) -> None:
    _, passed = filmed(theta, [layer], body)
    _, fields, through = twin.films(1.0, [layer], body, float(sin_degrees(theta) ** 2))
    cross = fields[0] * np.conj(fields[1]) * np.sqrt(np.prod(through / np.abs(fields) ** 2))
    np.testing.assert_allclose(passed.cross, cross.real, atol=1e-12)


@pytest.mark.thorough
def test_trapped_light_next_to_does_not_pass() -> None:
    """Squared sines in air beyond 1 belong to light that a boundary turns back as a whole."""
    beyond = jnp.asarray(1.2)
    body = boundary.medium(jnp.asarray(1.5), 1.0 - beyond)
    air = boundary.medium(jnp.asarray(1.0), 1.0 - beyond)
    assert np.all(one_by_one(boundary.transmission(air, body, beyond))[:2] < 1e-5)
