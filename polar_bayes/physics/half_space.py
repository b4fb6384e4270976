r"""Light that a turbid half space behind a smooth interface scatters: all orders, polarized.

Scattering is a mixture: a share p (the polarized fraction) follows Rayleigh's law, a share 1 - p
is isotropic and depolarizes. Such a mixture sees only four functions f of direction and light, in
two pairs (J_s and J_p are half the sum and half the difference of I and Q):

    pair 0, around the normal   J_s + J_p
                                -J_s + (2 - 3 mu^2) J_p
    pair 1, once around         sin(theta) [mu (I - Q), U]
            twice around        [sin^2(theta) I + (1 + mu^2) Q, 2 mu U]

Light scattered in all orders is a sum over these functions of both directions, joined by the 2 x 2
matrices H of Chandrasekhar. With N = 1/(mu_v + mu_l) and L = diag(1, p/2) and diag(p, p) it is

    w/(4 pi) f_v H_v L H_l^T f_l N,

exactly, where there is no interface. Light that an interface turns back inside enters again: at a
few cosines mu_i with weights W_i (in mu dmu) its reflection D_i joins what leaves to what enters,

    X_i = w/2 W_i H_i^T D_i H_i L,     N_vl  ->  N_vl + N_vi [(1 - X N)^-1]_ij X_j N_jl,

so that one small matrix is inverted per material and none per view. Nothing is fitted. Left out is
circular polarization, which the interface makes of U. For an index of 1 to 2 the few nodes and what
is left out cost at most .0013 in the degree of polarization and .15 % in intensity.

Source:
    Chandrasekhar 1960, Radiative transfer, sections 17, 69 and 70 (H functions, Rayleigh's law);
    de Rooij, Bosma and van Hooff 1989, Astronomy and Astrophysics 226, 347 (iterating H matrices).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polar_bayes.physics.boundary import medium
from polar_bayes.physics.geometry import cos_degrees, double_angle, sin_degrees
from polar_bayes.physics.part import at_least, squared_rule, unit_rule
from polar_bayes.physics.stack import Stack

# Scattered light changes with the square root of absorption, whose slope at zero is infinite: less
# absorption than this counts as this.
CLEAREST = 1e-4

# Directions closer to the interface than this cosine count as this one.
GRAZING = 1e-5

# Nodes of the H functions, and rounds of their iteration.
NODES, ROUNDS = 6, 6

# Nodes of the inner light that the interface turns back, beyond the critical angle and within it.
BEYOND, WITHIN = 3, 4


def _p_apart[T: (np.ndarray, Array)](cosine: T) -> T:
    """The second function of pair 0 for p light; for s light it is -1."""
    return 2.0 - 3.0 * cosine**2


_COSINES, _WEIGHTS = squared_rule(NODES)
_ZEROS, _APART = np.zeros(NODES), _p_apart(_COSINES)
# The part mu'/(mu + mu') of an integral over mu' at each mu.
_PARTS = _COSINES / (_COSINES[:, None] + _COSINES)
# The functions of each pair times each other, summed over I, Q and U and times the weights: shape
# (pair, 2, 2, node). Their integrals are diag(1, 1.4) and diag(.7, .7).
_SQUARES = _WEIGHTS * np.array(
    [
        [[_ZEROS + 1.0, (_APART - 1.0) / 2.0], [(_APART - 1.0) / 2.0, (_APART**2 + 1.0) / 2.0]],
        [
            [0.75 * (1.0 - _COSINES**2) * (1.0 + 2.0 * _COSINES**2), _ZEROS],
            [_ZEROS, 0.375 * (1.0 + _COSINES**2) ** 2],
        ],
    ]
)
_SIGNS = np.array([[1.0, -1.0], [-1.0, 1.0]])


class Ray(NamedTuple):
    """A direction inside the body; a negative sine is on the other side of the normal."""

    cosine: Array  # (..., view)
    sine: Array


class _Moments(NamedTuple):
    """Coefficients of H at any cosine: a constant, and a term for each node."""

    constant: Array  # (pair, 2, 2, ...)
    term: Array  # (pair, 2, 2, node, ...)


class _Interface(NamedTuple):
    """Reflectances of the interface from inside, and the retained share of U, (node, ...)."""

    cosine: Array
    weight: Array  # of integrals over mu dmu
    s: Array
    p: Array
    diagonal: Array


class _Turned(NamedTuple):
    """Light that the interface reflects back: X, and the sum over its returns (1 - X N)^-1."""

    cosine: Array  # (node, ...)
    reflection: Array  # (pair, 2, 2, node, ...)
    returns: Array  # (pair, 2, node, 2, node, ...)


def refract(sine: Array, cosine: Array, refractive_index: Array) -> Ray:
    """Direction inside the body of light that meets a smooth interface."""
    inside = medium(refractive_index, jnp.maximum(cosine, GRAZING) ** 2)
    return Ray(inside.normal / refractive_index, sine / refractive_index)


def scatter(
    light: Ray,
    view: Ray,
    azimuth: Array,
    entering: tuple[Array, Array, Array],
    absorption: Array,
    polarized_fraction: Array,
    refractive_index: Array | None,
) -> tuple[Array, Array, Array]:
    r"""Light of a beam that is scattered towards the viewer, before it leaves the body.

    $$ [I E_0 + Q E_1,\; I E_1 + Q E_0,\; U \sqrt{E_0^2 - E_1^2}] / n^2 $$
    """
    # The caller lets it out: with E0 and E1 half the sum and half the difference of the
    # transmittances for s and p, the Stokes vector outside is
    n = 1.0 if refractive_index is None else refractive_index
    a, p, n = _material(absorption, polarized_fraction, n)
    moments = _solve_h(a, p)
    cos_light, cos_view = (jnp.maximum(ray.cosine, GRAZING) for ray in (light, view))
    h_light, h_view = _h_at(moments, cos_light), _h_at(moments, cos_view)
    intensity, q, u = entering

    # Pair 1 is followed per unit of its functions, which are put in at the end.
    first, second = _seen(cos_light, intensity, q)
    one = jnp.ones_like(h_light[0, 0, 0] * second)
    functions = _stack((2, 2), first * one, second * one, one, one)
    arriving = jnp.sum(h_light * functions[:, :, None], axis=1)
    leaving = arriving / (cos_light + cos_view)
    if refractive_index is not None:
        turned = _turned_back(moments, a, p, n)
        below = arriving[:, None, :, None] / (turned.cosine + cos_light)
        source = jnp.sum(turned.reflection * below, axis=2)
        leaving = leaving + _after_returns(turned, source, cos_view)
    pair_0, pair_1 = jnp.sum(h_view * (_parts_of(p) * leaving)[:, None], axis=2)

    s_light, p_light = _unseen(cos_view, pair_0)
    cos_1, sin_1 = cos_degrees(azimuth), sin_degrees(azimuth)
    cos_2, sin_2 = double_angle(cos_1, sin_1)
    even, odd = cos_light * (intensity - q), u
    size = 1.5 * light.sine * view.sine * pair_1[0]
    even_1, odd_1 = size * (even * cos_1 - odd * sin_1), size * (even * sin_1 + odd * cos_1)
    even, odd = light.sine**2 * intensity + (1.0 + cos_light**2) * q, 2.0 * cos_light * u
    size = 0.375 * pair_1[1]
    even_2, odd_2 = size * (even * cos_2 + odd * sin_2), size * (odd * cos_2 - even * sin_2)
    scale = 1.0 / (4.0 * jnp.pi * (1.0 + a))
    return (
        scale * (s_light + p_light + cos_view * even_1 + view.sine**2 * even_2),
        scale * (s_light - p_light - cos_view * even_1 + (1.0 + cos_view**2) * even_2),
        scale * (odd_1 + 2.0 * cos_view * odd_2),
    )


def _material(*properties: Array | float) -> tuple[Array, Array, Array]:
    """Absorption above its floor, polarized fraction and index, in one shape and precision."""
    dtype = jnp.result_type(float, *properties)
    a, p, n = jnp.broadcast_arrays(*(jnp.asarray(x, dtype) for x in properties))
    return at_least(a, CLEAREST), p, n


def _column(nodes: np.ndarray, like: Array) -> Array:
    """Constants in the precision of the data, with axes for the data behind their own."""
    return jnp.asarray(nodes, like.dtype).reshape(nodes.shape + (1,) * like.ndim)


def _stack(shape: tuple[int, ...], *arrays: Array) -> Array:
    """Stack arrays of one shape on new leading axes."""
    return jnp.stack(arrays).reshape(*shape, *arrays[0].shape)


def _parts_of(p: Array) -> Array:
    """Weights L of each function of each pair in scattering, (pair, 2, ...)."""
    return _stack((2, 2), jnp.ones_like(p), 0.5 * p, p, p)


def _seen(cosine: Array, intensity: Array, q: Array) -> tuple[Array, Array]:
    """Components of light in the functions of pair 0."""
    return intensity, 0.5 * (_p_apart(cosine) * (intensity - q) - (intensity + q))


def _unseen(cosine: Array, pair: Array) -> tuple[Array, Array]:
    """Light, s and p, from its components in the functions of pair 0."""
    return 0.5 * (pair[0] - pair[1]), 0.5 * (pair[0] + _p_apart(cosine) * pair[1])


def _inverse(matrix: Array) -> Array:
    """Inverse of 2 x 2 matrices of shape (pair, 2, 2, ...)."""
    signs = _column(_SIGNS, matrix[0, 0, 0])
    determinant = matrix[:, :1, :1] * matrix[:, 1:, 1:] - matrix[:, :1, 1:] * matrix[:, 1:, :1]
    return jnp.flip(jnp.swapaxes(matrix, 1, 2), (1, 2)) * signs / determinant


def _solve_h(a: Array, p: Array) -> _Moments:
    """Chandrasekhar's H of both pairs, by a few rounds of iteration."""
    # $$ H^{-1}(\mu) = C + \int_0^1 \frac{\mu'}{\mu+\mu'} M(\mu') d\mu', \qquad M = \frac{w}{2} L
    # H^T \sum f f^T, \qquad C = 1 - \int_0^1 M(\mu') d\mu' $$
    # Where L is scaled to 1, C^T C = 1 - w int sum f f^T is known: diag(1 - w, 1 - .7 w p) for pair
    # 0 and twice 1 - .7 w p for pair 1. Only the rotation that C has besides comes from the last
    # round, and so a clear body needs no more rounds than a dark one.
    w = 1.0 / (1.0 + a)
    g, h = jnp.sqrt(a * w), jnp.sqrt(1.0 - 0.7 * w * p)
    length = _stack((2, 2), g, h, h, h)[:, None]
    factor = 0.5 * w * _parts_of(p)[:, :, None, None]
    squares, parts = _column(_SQUARES, a), jnp.asarray(_PARTS, a.dtype)

    def moments(matrix: Array) -> _Moments:
        term = factor * jnp.sum(matrix[:, :, :, None] * squares[:, :, None], axis=1)
        total = jnp.sum(term[:, :, 1], axis=2)
        tangent = total[:, 0] / (1.0 - total[:, 1])
        cos = 1.0 / jnp.sqrt(1.0 + 0.5 * p * tangent**2)
        sin = tangent * cos
        rotation = jnp.stack([cos, -sin, 0.5 * p * sin, cos], axis=1).reshape(2, 2, 2, *a.shape)
        return _Moments(length * rotation, term)

    def improve(matrix: Array, _: None) -> tuple[Array, None]:
        now = moments(matrix)
        integral = jnp.einsum("ij,gabj...->gabi...", parts, now.term, precision="highest")
        return matrix + mix * (_inverse(now.constant[:, :, :, None] + integral) - matrix), None

    # Without mixing, an error in the size of H changes sign each round and stays for a = 0.
    mix = 1.0 / (1.0 + 0.6 * (1.0 - g) / (1.0 + g))
    cosine = _column(_COSINES, a)
    simple = (1.0 + 2.0 * cosine) / (1.0 + 2.0 * cosine * g)
    one, none = jnp.ones_like(simple), jnp.zeros_like(simple)
    start = _stack((2, 2, 2), simple, none, none, one, one, none, none, one)
    matrix, _ = jax.lax.scan(improve, start, None, length=ROUNDS)
    return moments(matrix)


def _h_at(moments: _Moments, cosine: Array) -> Array:
    """H at a cosine: (pair, 2, 2, ...)."""
    nodes = _column(_COSINES, cosine)
    part = nodes / (cosine + nodes)
    integral = jnp.einsum("gabk...,k...->gab...", moments.term, part, precision="highest")
    return _inverse(moments.constant + integral)


def _at_nodes(moments: _Moments) -> _Moments:
    """Moments that broadcast with cosines of shape (node, ...)."""
    return _Moments(moments.constant[:, :, :, None], moments.term[:, :, :, :, None])


def critical_cosine_squared(n: Array) -> Array:
    """Squared cosine of the critical angle, with a finite slope of its root at n = 1."""
    # Something is added to n^2 - 1, so that the slope of the cosine is finite at n = 1.
    return ((n - 1.0) * (n + 1.0) + 1e-6) / n**2


def _interface(n: Array) -> _Interface:
    """Reflectances at nodes beyond the critical angle, and at nodes of light that can leave."""
    node, weight = (_column(x, n) for x in unit_rule(BEYOND))
    critical = critical_cosine_squared(n)
    cosine = jnp.sqrt(critical) * node
    # Squared tangent of half the phase between s and p in total reflection.
    tangent = (critical * node / (1.0 - cosine**2)) ** 2 * (1.0 - node**2)
    one, kept = jnp.ones_like(cosine), (1.0 - tangent) / (1.0 + tangent)
    beyond = _Interface(cosine, critical * node * weight, one, one, kept)
    node, weight = (_column(x, n) for x in squared_rule(WITHIN))
    power = Stack(n).reflection(node, (1.0 - node) * (1.0 + node))
    difference = power.contrast * power.sin_squared
    within = _Interface(
        refract(node, node, n).cosine,
        weight * node / n**2,
        power.mean + difference,
        power.mean - difference,
        -power.cross,
    )
    return _Interface(*(jnp.concatenate(both) for both in zip(beyond, within, strict=True)))


def _turned_back(moments: _Moments, a: Array, p: Array, n: Array) -> _Turned:
    """Reflection of light on its way out, and the sum over all returns."""
    mu, weight, s, p_light, diagonal = _interface(n)
    h, apart, none = _h_at(_at_nodes(moments), mu), _p_apart(mu), jnp.zeros_like(mu)
    cross = 0.5 * (apart * p_light - s)
    once = 0.75 * (1.0 - mu**2) * (diagonal - 2.0 * mu**2 * p_light)
    twice = 0.375 * (s + mu**4 * p_light - 2.0 * mu**2 * diagonal)
    around = (0.5 * (s + p_light), cross, cross, 0.5 * (s + apart**2 * p_light))
    mirror = 0.5 / (1.0 + a) * weight * _stack((2, 2, 2), *around, once, none, none, twice)
    mirrored = jnp.sum(mirror[:, :, :, None] * h[:, None], axis=2)
    reflection = jnp.sum(h[:, :, :, None] * mirrored[:, :, None], axis=1)
    reflection = reflection * _parts_of(p)[:, None, :, None]

    size = 2 * (BEYOND + WITHIN)
    coupling = jnp.swapaxes(reflection[:, :, :, :, None] / (mu[:, None] + mu), 2, 3)
    coupling = jnp.moveaxis(coupling.reshape(2, size, size, *a.shape), (1, 2), (-2, -1))
    returns = jnp.linalg.inv(jnp.eye(size, dtype=a.dtype) - coupling)
    returns = jnp.moveaxis(returns, (-2, -1), (1, 2))
    return _Turned(mu, reflection, returns.reshape(2, 2, size // 2, 2, size // 2, *a.shape))


def _after_returns(turned: _Turned, source: Array, cos_view: Array) -> Array:
    """Light towards the viewer after one or more reflections back inside, (pair, 2, ...)."""
    total = jnp.einsum("gaibj...,gbj...->gai...", turned.returns, source, precision="highest")
    return jnp.sum(total / (turned.cosine + cos_view), axis=2)
