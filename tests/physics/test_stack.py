"""Layers on a body: against every bounce followed, against matrices, against brute force."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vector_optics as twin
from cases import each
from hypothesis import given, settings
from hypothesis import strategies as st
from optics import incidence, one_by_one
from scipy.integrate import quad

from polar_bayes.physics.stack import Layer, Stack

RUN = settings(deadline=None, max_examples=60, derandomize=True)
zenith = st.floats(0.0, 89.9)
index = st.floats(1.0, 3.0)
reflect = jax.jit(Stack.reflection)
transmit = jax.jit(Stack.transmission)
escape = jax.jit(Stack.escape)


def thick(indexes: list[float], absorbances: list[float | None]) -> Stack:
    """Powers from air to body; None leaves the absorbance out."""
    layers = tuple(
        Layer(jnp.asarray(n), None if a is None else jnp.asarray(a))
        for n, a in zip(indexes[1:-1], absorbances, strict=True)
    )
    return Stack(jnp.asarray(indexes[-1]), layers)


THICK = {
    "one coat, low": ([1.0, 1.3, 1.5], [0.0]),
    "one coat, high": ([1.0, 1.8, 1.5], [0.0]),
    "one coat that absorbs": ([1.0, 1.5, 1.7], [0.3]),
    "two coats, rising": ([1.0, 1.3, 1.5, 1.8], [0.2, 0.1]),
    "two coats, falling": ([1.0, 2.2, 1.6, 1.3], [0.0, 0.5]),
    "low between high": ([1.0, 1.9, 1.1, 1.7], [0.1, 0.4]),
    "high between low": ([1.0, 1.1, 2.3, 1.2], [0.05, 0.0]),
    "three coats": ([1.0, 1.4, 1.9, 1.3, 1.6], [0.1, 0.0, 0.3]),
}


@pytest.mark.thorough
@each("theta", [0.0, 35.0, 60.0, 84.0])
@each("name", THICK)
def test_thick_layers_agree_with_every_bounce_followed(name: str, theta: float) -> None:
    """1,000 bounces leave nothing inside; s, p and the product of their fields, both ways."""
    indexes, absorbances = THICK[name]
    c, b = incidence(theta)
    back, through = twin.bounced(indexes, absorbances, float(b), bounces=1000)
    stack = thick(indexes, absorbances)
    np.testing.assert_allclose(one_by_one(reflect(stack, c, b)), back, atol=2e-14)
    np.testing.assert_allclose(one_by_one(transmit(stack, c, b)), through, atol=2e-14)


@given(
    theta=zenith,
    body=index,
    coats=st.lists(st.tuples(index, st.floats(0.0, 5.0)), min_size=1, max_size=2),
)
@RUN
def test_layers_never_give_more_than_they_get(theta: float, body: float, coats: list) -> None:
    """And without absorption exactly what they get."""
    c, b = incidence(theta)
    for clear in (True, False):
        absorbances = [None if clear else a for _, a in coats]
        stack = thick([1.0, *(n for n, _ in coats), body], absorbances)
        back, through = one_by_one(reflect(stack, c, b)), one_by_one(transmit(stack, c, b))
        assert np.all(back[:2] >= -1e-16)
        assert np.all(through[:2] >= -1e-16)
        if clear:
            np.testing.assert_allclose(back[:2] + through[:2], 1.0, atol=1e-13)
        else:
            assert np.all(back[:2] + through[:2] <= 1.0 + 1e-13)
        for s, p, cross in (back, through):
            assert abs(cross) <= np.sqrt(max(s * p, 0.0)) + 1e-12


@given(theta=zenith, body=index, absorbance=st.floats(0.0, 50.0))
@RUN
def test_a_coat_without_effect_is_not_there(theta: float, body: float, absorbance: float) -> None:
    """Of the body's index and clear, or of air; of the body's index, absorption is all it does."""
    c, b = incidence(theta)
    bare = Stack(jnp.asarray(body))
    for index_ in (body, 1.0):
        same = thick([1.0, index_, body], [0.0])
        for law in (reflect, transmit):
            expected = one_by_one(law(bare, c, b))
            np.testing.assert_allclose(one_by_one(law(same, c, b)), expected, atol=3e-14)
        np.testing.assert_allclose(escape(same), escape(bare), rtol=1e-8)
    colored = thick([1.0, body, body], [absorbance])
    kept = np.exp(-absorbance / twin.cosine(body, float(b)).real)
    for law, left in ((transmit, kept), (reflect, 1.0)):
        expected = left * one_by_one(law(bare, c, b))
        np.testing.assert_allclose(one_by_one(law(colored, c, b)), expected, atol=3e-14)


# --- light that comes from the body ---------------------------------------------------------------


def turned_back(indexes: list, absorbances: list, sin_squared: float) -> float:
    """Share of light from the body that returns, mean of s and p; cosines may be complex."""
    shares = []
    for polarization in (0, 1):
        back = 1.0
        if sin_squared < 1.0:
            back = abs(twin.films(indexes[1], (), 1.0, sin_squared)[0][polarization]) ** 2
        for k in range(2, len(indexes)):
            upper, lower = indexes[k - 1], indexes[k]
            if sin_squared >= upper**2:
                back = 1.0
                continue
            kept = np.exp(-2.0 * absorbances[k - 2] / twin.cosine(upper, sin_squared).real)
            mirrored = abs(twin.films(lower, (), upper, sin_squared)[0][polarization]) ** 2
            back = mirrored + (1.0 - mirrored) ** 2 * kept * back / (1.0 - mirrored * kept * back)
        shares.append(back)
    return 0.5 * sum(shares)


def escape_by_brute_force(indexes: list, absorbances: list) -> float:
    """Adaptive quadrature over the squared sine, from one critical angle to the next."""
    body = indexes[-1]
    ends = sorted({0.0, *(min(n, body) ** 2 for n in indexes)})
    total = 0.0
    for low, high in itertools.pairwise(ends):

        def lost(x: float, low: float = low, width: float = high - low) -> float:
            # Square roots at both ends become smooth.
            b = low + width * x * x * (3.0 - 2.0 * x)
            return (1.0 - turned_back(indexes, absorbances, b)) * width * 6.0 * x * (1.0 - x)

        total += quad(lost, 0.0, 1.0, epsabs=1e-12, epsrel=1e-11, limit=200)[0]
    return total / body**2


@each("absorbance", [0.0, 1e-3, 0.3, 50.0])
@each(("coat", "body"), [(1.3, 1.5), (1.7, 1.5), (1.5, 1.5), (1.01, 1.5), (1.5, 1.01), (1.3, 2.4)])
def test_escape_through_a_coat_agrees_with_brute_force(coat, body, absorbance) -> None:
    """24 nodes over angles that reach the air and 24 over those that reach the coat.

    Hard are nearly clear coats, in which light is absorbed on a long slant only: over absorbances
    from 1e-6 to 1 the largest error is 4e-8 of the value, or 4e-6 under a coat like the body.
    """
    indexes, absorbances = [1.0, coat, body], [absorbance]
    truth = escape_by_brute_force(indexes, absorbances)
    bound = 4e-6 if coat == body else 4e-8
    np.testing.assert_allclose(escape(thick(indexes, absorbances)), truth, rtol=bound)


@pytest.mark.thorough
@each(
    ("indexes", "bound"),
    [
        ([1.0, 1.7, 1.3, 1.6], 1e-9),
        ([1.0, 1.7, 1.8, 1.6], 1e-9),
        ([1.0, 1.6, 1.4, 1.5], 1e-9),
        ([1.0, 1.3, 1.7, 1.6], 2e-3),
        ([1.0, 1.3, 1.4, 1.6], 3e-4),
    ],
)
def test_escape_through_two_coats_agrees_with_brute_force(indexes: list, bound: float) -> None:
    """Where an upper coat has the lower index, the critical angle between them is not a node."""
    truth = escape_by_brute_force(indexes, [0.2, 0.3])
    np.testing.assert_allclose(escape(thick(indexes, [0.2, 0.3])), truth, rtol=bound)


@pytest.mark.thorough
@given(body=index, coat=index)
@RUN
def test_as_much_diffuse_light_enters_as_leaves(body: float, coat: float) -> None:
    """n^2 (1 - Fi) = 1 - Fe for every clear stack."""
    for absorbance in (None, 0.0):
        stack = thick([1.0, coat, body], [absorbance])
        entering = stack.hemispherical_transmission()
        np.testing.assert_allclose(body**2 * escape(stack), entering, rtol=1e-8)


@pytest.mark.thorough
@each(("thickness", "bound"), [(230.0, 1e-12), (3000.0, 1e-9), (1e4, 2e-4)])
def test_fringes_over_the_hemisphere_have_enough_nodes(thickness: float, bound: float) -> None:
    """Films of several indices against 800 nodes; too few make a body return what it never got."""
    film, n = (jnp.asarray(x.ravel()) for x in np.meshgrid([1.38, 2.0, 2.4], [1.2, 1.5, 2.0]))
    wavenumber = jnp.full(9, 4.0 * np.pi * thickness / 550.0)
    found = jax.jit(lambda: Stack(n, (Layer(film, wavenumber=wavenumber),)).escape())()
    node, weight = np.polynomial.legendre.leggauss(800)
    cosine = jnp.asarray(np.tile((0.5 * (1.0 + node)) ** 2, (9, 1)))
    index, inside, phase = (array[:, None] for array in (n, film, wavenumber))
    stack = Stack(index, (Layer(inside, wavenumber=phase),))
    through = jax.jit(lambda: stack.transmission(cosine, (1.0 - cosine) * (1.0 + cosine)).mean)()
    truth = np.sum(through * cosine * (1.0 + node) * weight, axis=-1) / n**2
    np.testing.assert_allclose(found, truth, rtol=bound)
