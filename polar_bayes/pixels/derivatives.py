"""Slopes and curvatures of one pixel's posterior, by forward differentiation alone.

A pixel has few coordinates and many readings. Each coordinate is pushed through the model by
itself, so that what it does not touch is absent from the program: the fraction, for example,
never differentiates the Fresnel equations. Measured against reverse mode in
`tests/benchmarks/pixels.py`.
"""

import functools
import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpyro import distributions as dist
from numpyro.infer.util import compute_log_probs

from polar_bayes.inference.program import Program
from polar_bayes.observation.data import Observations

MOST_APART = 6
"""Most coordinates that are pushed through one by one. Programs grow with their square, and with
more of them it takes longer to compile than it saves."""

AnyArray = Array | np.ndarray

Coordinates = tuple[Float[Array, ""], ...]
"""The unconstrained vector as numbers, so that each can be differentiated by itself."""


class Slopes(NamedTuple):
    """The potential (minus the log posterior density) around a point.

    Args:
        value: The potential, up to a constant.
        gradient: Its first derivatives.
        curvature: Its second derivatives, or what scoring puts in their place.
    """

    value: Float[AnyArray, ""]
    gradient: Float[AnyArray, " size"]
    curvature: Float[AnyArray, "size size"]


def score(program: Program, z: Float[Array, " size"], data: Observations) -> Slopes:
    r"""Value, gradient and the curvature of scoring.

    $$ H = \sum_i J_i^T \, \frac{\partial^2 (-\log p_i)}{\partial\eta^2} \, J_i + H_{prior} $$

    where $\eta_i(z)$ are the arguments of the distribution of reading i and $J_i$ their slopes.
    What is left out is the curvature of $\eta$ itself, times residuals.

    Args:
        program: The model of one pixel.
        z: Unconstrained vector, (size,).
        data: The pixel's readings.

    Returns:
        The three, in the precision of `z`.

    Raises:
        Nothing.

    Source:
        Schraudolph (2002), Neural Computation 14(7), 1723-1738: the generalized Gauss-Newton
        matrix; with normal noise it is that of Gauss and Newton, and Fisher's.
    """
    coordinates = tuple(z)
    pixel = _Pixel(program, data)
    arguments, likelihoods = pixel.arguments(coordinates)
    slopes = _slopes(lambda *c: pixel.arguments(c)[0], coordinates)
    value, gradient, curvature = _expand(pixel.prior, coordinates)
    for at, (own, likelihood) in enumerate(zip(arguments, likelihoods, strict=True)):
        jacobian = [slopes[k][at] for k in range(program.size)]
        active = pixel.active(at, coordinates)
        value = value - jnp.sum(likelihood(own))
        first = jax.grad(lambda a, f=likelihood: jnp.sum(f(a)))
        downhill = first(own)
        gradient = gradient - jnp.stack(
            [sum(jnp.sum(j[a] * downhill[a]) for a in active) for j in jacobian]
        )
        for a in active:
            unit = [jnp.ones_like(x) if b == a else jnp.zeros_like(x) for b, x in enumerate(own)]
            bend = jax.jvp(first, (own,), (unit,))[1]
            for b in active:
                curvature = curvature - _outer(
                    [j[a] * bend[b] for j in jacobian], [j[b] for j in jacobian]
                )
    return Slopes(value, gradient, curvature)


def expand(program: Program, z: Float[Array, " size"], data: Observations) -> Slopes:
    """Value, gradient and exact second derivatives.

    Args:
        program: The model of one pixel.
        z: Unconstrained vector, (size,).
        data: The pixel's readings.

    Returns:
        The three, in the precision of `z`.

    Raises:
        Nothing.
    """
    return Slopes(*_expand(_Pixel(program, data).potential, tuple(z)))


class _Pixel:
    """A program and its data as functions of coordinates, one number each."""

    def __init__(self, program: Program, data: Observations) -> None:
        self._program = program
        self._data = data
        self._layout = jax.eval_shape(program.unravel, jnp.zeros(program.size))

    def potential(self, *coordinates: Array) -> Array:
        return self._program.potential_at(self._sites(coordinates), self._data)

    def prior(self, *coordinates: Array) -> Array:
        """The part of the potential that no reading has a share in."""
        unconstrained = self._sites(coordinates)
        log_probs, _ = self._told(unconstrained)
        stretch = jnp.zeros(())
        for name, value in unconstrained.items():
            bijection = dist.biject_to(self._program.supports[name])
            stretch = stretch + jnp.sum(bijection.log_abs_det_jacobian(value, bijection(value)))
        prior = sum(x for name, x in log_probs.items() if name not in self._program.observed)
        return -prior - stretch

    def arguments(self, coordinates: Coordinates) -> tuple[list[list[Array]], list[Callable]]:
        """For each observed site, the arguments of its distribution, and its log density of them.

        Every argument has one value for each reading.
        """
        _, trace = self._told(self._sites(coordinates))
        arguments, likelihoods = [], []
        for name in self._program.observed:
            distribution, value = trace[name]["fn"], trace[name]["value"]
            leaves, tree = jax.tree.flatten(distribution)
            moving = [jnp.issubdtype(jnp.result_type(x), jnp.floating) for x in leaves]
            shape = jnp.shape(value)

            def likelihood(
                own: list[Array], leaves=leaves, tree=tree, moving=moving, value=value
            ) -> Array:
                given = iter(own)
                whole = [next(given) if m else x for x, m in zip(leaves, moving, strict=True)]
                return jax.tree.unflatten(tree, whole).log_prob(value)

            arguments.append(
                [jnp.broadcast_to(x, shape) for x, m in zip(leaves, moving, strict=True) if m]
            )
            likelihoods.append(likelihood)
        return arguments, likelihoods

    def active(self, at: int, coordinates: Coordinates) -> list[int]:
        """Which arguments of an observed site any coordinate moves at all."""

        def argument(which: int, *coordinates: Array) -> Array:
            return self.arguments(coordinates)[0][at][which]

        count = len(self.arguments(coordinates)[0][at])
        return [a for a in range(count) if _moves(functools.partial(argument, a), coordinates)]

    def _sites(self, coordinates: Coordinates) -> dict[str, Array]:
        found, start = {}, 0
        for name, like in self._layout.items():
            count = math.prod(like.shape)
            own = coordinates[start : start + count]
            found[name] = jnp.stack(own).reshape(like.shape) if like.shape else own[0]
            start += count
        return found

    def _told(self, unconstrained: Mapping[str, Array]) -> tuple[dict[str, Array], dict]:
        latent = {
            name: dist.biject_to(self._program.supports[name])(value)
            for name, value in unconstrained.items()
        }
        return compute_log_probs(self._program.model, (self._data,), {}, latent)


def _along(function: Callable, k: int) -> Callable:
    """The slope of a function of coordinates along one of them."""

    def slope(*coordinates: Array) -> Array:
        def of_one(x: Array) -> Array:
            return function(*coordinates[:k], x, *coordinates[k + 1 :])

        return jax.jvp(of_one, (coordinates[k],), (jnp.ones_like(coordinates[k]),))[1]

    return slope


def _slopes(function: Callable, coordinates: Coordinates) -> list:
    """The slopes of a tree of arrays along every coordinate."""
    size = len(coordinates)
    if size <= MOST_APART:
        return [_along(function, k)(*coordinates) for k in range(size)]
    whole = jax.jacfwd(lambda z: function(*z))(jnp.stack(coordinates))
    return [jax.tree.map(lambda x, k=k: x[..., k], whole) for k in range(size)]


def _expand(function: Callable, coordinates: Coordinates) -> tuple[Array, Array, Array]:
    size = len(coordinates)
    if size > MOST_APART:
        z = jnp.stack(coordinates)
        value, gradient = jax.value_and_grad(lambda z: function(*z))(z)
        return value, gradient, jax.hessian(lambda z: function(*z))(z)
    first = [_along(function, k) for k in range(size)]
    rows: list[list[Array]] = [[] for _ in range(size)]
    for i in range(size):
        rows[i] = [rows[j][i] for j in range(i)]
        rows[i] += [_along(first[i], j)(*coordinates) for j in range(i, size)]
    gradient = jnp.stack([slope(*coordinates) for slope in first])
    return function(*coordinates), gradient, jnp.stack([jnp.stack(row) for row in rows])


def _outer(left: list[Array], right: list[Array]) -> Array:
    return jnp.stack([jnp.stack([jnp.sum(x * y) for y in right]) for x in left])


def _moves(function: Callable, coordinates: Coordinates) -> bool:
    """True where the result depends on the coordinates, as the program is written."""
    moved: list[bool] = []

    @jax.custom_jvp
    def probe(x: Array) -> Array:
        return x

    def note(primals: tuple, tangents: tuple) -> tuple:
        still = isinstance(tangents[0], jax.custom_derivatives.SymbolicZero)
        moved.append(not still)
        return primals[0], jnp.zeros_like(primals[0]) if still else tangents[0]

    probe.defjvp(note, symbolic_zeros=True)
    ones = tuple(jnp.ones_like(c) for c in coordinates)
    jax.eval_shape(lambda c: jax.jvp(lambda *c: probe(function(*c)), c, ones), tuple(coordinates))
    return any(moved)
