"""Derivatives of one capture's log posterior density: Fisher scoring, and exact ones.

Jacobians are taken along one coordinate at a time where there are few, so that parts of the model
that do not depend on a coordinate are absent from its program; `benchmarks/pixels.py` has the
measurements.

Source:
    Schraudolph (2002), Neural Computation 14(7), 1723-1738: the generalized Gauss-Newton matrix.
"""

import functools
import itertools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from numpyro import distributions as dist

from polar_bayes.inference.program import Program
from polar_bayes.numerics.levenberg_marquardt import MAX_UNROLLED, Derivatives, derivatives
from polar_bayes.observation.data import Observations

Coordinates = tuple[Float[Array, ""], ...]
"""The unconstrained vector as separate numbers, which are differentiated one by one."""


def scoring_derivatives(
    program: Program, z: Float[Array, " size"], data: Observations
) -> Derivatives:
    """Return value, gradient and the curvature of Fisher scoring."""
    # $$ H = \sum_i J_i^T \, \frac{\partial^2 (-\log p_i)}{\partial\eta^2} \, J_i + H_{prior} $$
    # where $\eta_i(z)$ are the arguments of the distribution of reading i and $J_i$ their Jacobian.
    # The curvature of $\eta$ itself, times residuals, is omitted. This is the generalized
    # Gauss-Newton matrix (Schraudolph 2002), the Fisher information under normal noise.
    coordinates = tuple(z)
    pixel = _Pixel(program, data)
    arguments, jacobians = _jacobian(lambda *c: pixel.arguments(c), coordinates)
    likelihoods = pixel.likelihoods(coordinates)
    value, gradient, curvature = derivatives(lambda z: program.prior_potential(z, data), z)
    for at, (own, likelihood) in enumerate(zip(arguments, likelihoods, strict=True)):
        active = pixel.active(at, coordinates)
        value = value - jnp.sum(likelihood(own))
        gradient_of = jax.grad(lambda a, f=likelihood: jnp.sum(f(a)))
        first = gradient_of(own)
        units = {a: [jnp.full_like(x, float(k == a)) for k, x in enumerate(own)] for a in active}
        second = {a: jax.jvp(gradient_of, (own,), (unit,))[1] for a, unit in units.items()}
        jacobian = {a: jacobians[at][a].reshape(program.size, -1) for a in active}
        # The barrier keeps the compiler from computing these again for each of the sums below.
        first, second, jacobian = jax.lax.optimization_barrier((first, second, jacobian))
        gradient = gradient - sum(jacobian[a] @ first[a].ravel() for a in active)
        for a, b in itertools.product(active, active):
            weighted = jacobian[a] * second[a][b].ravel()
            curvature = curvature - weighted @ jacobian[b].T
    return Derivatives(value, gradient, curvature)


def exact_derivatives(
    program: Program, z: Float[Array, " size"], data: Observations
) -> Derivatives:
    """Return value, gradient and Hessian."""
    return derivatives(lambda z: program.potential(z, data), z)


class _Pixel:
    """The likelihood of a program and its data as a function of separate coordinates."""

    # `arguments` is traced once, however often it is differentiated: tracing a model with NumPyro
    # is slow.

    def __init__(self, program: Program, data: Observations) -> None:
        self._program = program
        self._data = data
        self._layout = jax.eval_shape(program.unravel, jnp.zeros(program.size))
        self.arguments = jax.jit(self._arguments, inline=True)

    def likelihoods(self, coordinates: Coordinates) -> list[Callable]:
        """Return, for each observed site, its log density as a function of `arguments`."""
        return [
            functools.partial(self._likelihood, *jax.tree.flatten(distribution), value)
            for distribution, value in self._observed(coordinates)
        ]

    def active(self, at: int, coordinates: Coordinates) -> list[int]:
        """Return which arguments of an observed site's distribution depend on a coordinate."""

        def argument(which: int, *coordinates: Array) -> Array:
            return self.arguments(coordinates)[at][which]

        count = len(self.arguments(coordinates)[at])
        return [a for a in range(count) if _depends(functools.partial(argument, a), coordinates)]

    def _arguments(self, coordinates: Coordinates) -> list[list[Array]]:
        """Return, for each observed site, its distribution's arguments for every reading."""
        found = []
        for distribution, value in self._observed(coordinates):
            leaves = [x for x in jax.tree.leaves(distribution) if _is_number(x)]
            found.append([jnp.broadcast_to(x, jnp.shape(value)) for x in leaves])
        return found

    def _likelihood(
        self, leaves: list, tree: jax.tree_util.PyTreeDef, value: Array, own: list[Array]
    ) -> Array:
        given = iter(own)
        whole = [next(given) if _is_number(x) else x for x in leaves]
        return jax.tree.unflatten(tree, whole).log_prob(value)

    def _observed(self, coordinates: Coordinates) -> list[tuple[dist.Distribution, Array]]:
        trace = self._program.trace_at(self._sites(coordinates), self._data)
        return [(trace[name]["fn"], trace[name]["value"]) for name in self._program.observed]

    def _sites(self, coordinates: Coordinates) -> dict[str, Array]:
        found, start = {}, 0
        for name, like in self._layout.items():
            count = math.prod(like.shape)
            own = coordinates[start : start + count]
            found[name] = jnp.stack(own).reshape(like.shape) if like.shape else own[0]
            start += count
        return found


def _is_number(x: Array) -> bool:
    return jnp.issubdtype(jnp.result_type(x), jnp.floating)


def _jacobian[T](function: Callable[..., T], coordinates: Coordinates) -> tuple[T, T]:
    """Return a tree of arrays, and its derivatives along every coordinate, (size, ...)."""
    size = len(coordinates)
    if size > MAX_UNROLLED:
        units = tuple(jnp.eye(size, dtype=coordinates[0].dtype))
        push = jax.vmap(lambda unit: jax.jvp(function, coordinates, unit), out_axes=(None, 0))
        return push(units)

    def along(k: int) -> tuple[T, T]:
        """Return the derivative along one coordinate."""
        below, x, above = coordinates[:k], coordinates[k], coordinates[k + 1 :]
        return jax.jvp(lambda x: function(*below, x, *above), (x,), (jnp.ones_like(x),))

    values, rows = zip(*map(along, range(size)), strict=True)
    return values[0], jax.tree.map(lambda *row: jnp.stack(row), *rows)


def _depends(function: Callable, coordinates: Coordinates) -> bool:
    """Return True if the program of the result depends on the coordinates."""
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
