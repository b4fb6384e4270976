"""From a start to the peak of one pixel's posterior, a step at a time.

Every function is of one pixel, so that a batch is a map over pixels and nothing else: what a
pixel gets does not depend on who climbs beside it.

A library factors a batch of 4 by 4 matrices one call at a time; written out, the arithmetic of a
thousand pixels runs side by side. `benchmarks/pixels.py` has the ratio.

A pixel has few coordinates and many readings. Each coordinate is pushed through the model by
itself, so that what it does not touch is absent from the program: the fraction, for example,
never differentiates the Fresnel equations. Measured against reverse mode in
`benchmarks/pixels.py`.
"""

import functools
import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpyro import distributions as dist
from numpyro.infer.util import compute_log_probs

from polar_bayes.inference.program import Program
from polar_bayes.observation.data import Observations

# --- Cholesky factors of very small matrices, written out -----------------------------------------


def cholesky(matrix: Float[Array | np.ndarray, "size size"]) -> Float[Array, "size size"]:
    """Lower factor of a symmetric matrix."""
    size = matrix.shape[0]
    rows: list[list[Array]] = []
    for i in range(size):
        row: list[Array] = []
        for j in range(i + 1):
            left = matrix[i, j] - sum(row[k] * (rows[j] if j < i else row)[k] for k in range(j))
            row.append(left / rows[j][j] if j < i else _root(left))
        rows.append(row)
    return _lower(rows)


def inverse(factor: Float[Array, "size size"]) -> Float[Array, "size size"]:
    """Inverse of a lower factor, lower again."""
    size = factor.shape[0]
    rows: list[list[Array]] = []
    for i in range(size):
        above = [
            -sum(factor[i, k] * rows[k][j] for k in range(j, i)) / factor[i, i] for j in range(i)
        ]
        rows.append([*above, 1.0 / factor[i, i]])
    return _lower(rows)


def _root(x: Array) -> Array:
    """Square root of what is above zero; NaN, not infinity one division later, of the rest."""
    return jnp.where(x > 0.0, jnp.sqrt(jnp.where(x > 0.0, x, 1.0)), jnp.nan)


def _lower(rows: list[list[Array]]) -> Array:
    zero = jnp.zeros_like(rows[0][0])
    return jnp.stack([jnp.stack([*row, *[zero] * (len(rows) - len(row))]) for row in rows])


# --- Slopes and curvatures of one pixel's posterior, by forward differentiation alone -------------


MOST_APART = 6
"""Most coordinates that are pushed through one by one. Programs grow with their square, and with
more of them it takes longer to compile than it saves."""

AnyArray = Array | np.ndarray

Coordinates = tuple[Float[Array, ""], ...]
"""The unconstrained vector as numbers, so that each can be differentiated by itself."""


class Slopes(NamedTuple):
    """The potential (minus the log posterior density) around a point."""

    value: Float[AnyArray, ""]
    gradient: Float[AnyArray, " size"]
    curvature: Float[AnyArray, "size size"]


def score(program: Program, z: Float[Array, " size"], data: Observations) -> Slopes:
    """Value, gradient and the curvature of scoring."""
    # $$ H = \sum_i J_i^T \, \frac{\partial^2 (-\log p_i)}{\partial\eta^2} \, J_i + H_{prior} $$
    # where $\eta_i(z)$ are the arguments of the distribution of reading i and $J_i$ their slopes.
    # What is left out is the curvature of $\eta$ itself, times residuals.
    # Source: Schraudolph (2002), Neural Computation 14(7), 1723-1738: the generalized Gauss-Newton
    # matrix; with normal noise it is that of Gauss and Newton, and Fisher's.
    coordinates = tuple(z)
    pixel = _Pixel(program, data)
    arguments, likelihoods = pixel.arguments(coordinates), pixel.likelihoods(coordinates)
    slopes = _slopes(lambda *c: pixel.arguments(c), coordinates)
    value, gradient, curvature = _expand(pixel.prior, coordinates)
    for at, (own, likelihood) in enumerate(zip(arguments, likelihoods, strict=True)):
        active = pixel.active(at, coordinates)
        value = value - jnp.sum(likelihood(own))
        first = jax.grad(lambda a, f=likelihood: jnp.sum(f(a)))
        downhill = first(own)
        bend = {a: jax.jvp(first, (own,), (_unit(own, a),))[1] for a in active}
        jacobian = [slopes[k][at] for k in range(program.size)]
        # The barrier keeps the compiler from finding all this anew for each of the sums below.
        downhill, bend, jacobian = jax.lax.optimization_barrier((downhill, bend, jacobian))
        gradient = gradient - jnp.stack(
            [sum(jnp.sum(j[a] * downhill[a]) for a in active) for j in jacobian]
        )
        for a in active:
            for b in active:
                curvature = curvature - _outer(
                    [j[a] * bend[a][b] for j in jacobian], [j[b] for j in jacobian]
                )
    return Slopes(value, gradient, curvature)


def expand(program: Program, z: Float[Array, " size"], data: Observations) -> Slopes:
    """Value, gradient and exact second derivatives."""
    return Slopes(*_expand(_Pixel(program, data).potential, tuple(z)))


class _Pixel:
    """A program and its data as functions of coordinates, one number each."""

    # Each is traced once, however often it is differentiated: the model is walked by NumPyro, and
    # that is slow.

    def __init__(self, program: Program, data: Observations) -> None:
        self._program = program
        self._data = data
        self._layout = jax.eval_shape(program.unravel, jnp.zeros(program.size))
        self.potential = jax.jit(self._potential, inline=True)
        self.prior = jax.jit(self._prior, inline=True)
        self.arguments = jax.jit(self._arguments, inline=True)

    def likelihoods(self, coordinates: Coordinates) -> list[Callable]:
        """For each observed site, the log density as a function of `arguments`."""
        return [
            functools.partial(self._likelihood, *jax.tree.flatten(distribution), value)
            for distribution, value in self._observed(coordinates)
        ]

    def active(self, at: int, coordinates: Coordinates) -> list[int]:
        """Which arguments of an observed site any coordinate moves at all."""

        def argument(which: int, *coordinates: Array) -> Array:
            return self.arguments(coordinates)[at][which]

        count = len(self.arguments(coordinates)[at])
        return [a for a in range(count) if _moves(functools.partial(argument, a), coordinates)]

    def _potential(self, *coordinates: Array) -> Array:
        return self._program.potential_at(self._sites(coordinates), self._data)

    def _prior(self, *coordinates: Array) -> Array:
        """The part of the potential that no reading has a share in."""
        unconstrained = self._sites(coordinates)
        log_probs, _ = self._told(unconstrained)
        stretch = jnp.zeros(())
        for name, value in unconstrained.items():
            bijection = dist.biject_to(self._program.supports[name])
            stretch = stretch + jnp.sum(bijection.log_abs_det_jacobian(value, bijection(value)))
        prior = sum(x for name, x in log_probs.items() if name not in self._program.observed)
        return -prior - stretch

    def _arguments(self, coordinates: Coordinates) -> list[list[Array]]:
        """For each observed site, the arguments of its distribution, a value for each reading."""
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
        _, trace = self._told(self._sites(coordinates))
        return [(trace[name]["fn"], trace[name]["value"]) for name in self._program.observed]

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


def _is_number(x: Array) -> bool:
    return jnp.issubdtype(jnp.result_type(x), jnp.floating)


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


def _unit(arguments: list[Array], which: int) -> list[Array]:
    """A step of one argument alone."""
    return [jnp.full_like(x, float(at == which)) for at, x in enumerate(arguments)]


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


# --- From a start to the peak of one pixel's posterior, a step at a time --------------------------


LONGEST = 3.0  # of a step, in an unconstrained coordinate: further the model is another one
FIRST_DAMPING = 1e-2
LEAST_DAMPING = 1e-8
FIRMER, LOOSER = 10.0, 0.1
ROUNDING = 8.0  # of the potential, in units of its last digit, that count as no change

Curvature = Callable[[Program, Array, Observations], Slopes]


class LMState(NamedTuple):
    """Where one pixel is."""

    z: Float[AnyArray, " size"]
    slopes: Slopes
    damping: Float[AnyArray, ""]
    decrement: Float[AnyArray, ""]
    steps: Int[AnyArray, ""]
    settled: Bool[AnyArray, ""]


class Peak(NamedTuple):
    """A mode, and the normal distribution that fits there."""

    z: Float[AnyArray, " size"]
    value: Float[AnyArray, ""]
    widths: Float[AnyArray, "size size"]
    decrement: Float[AnyArray, ""]
    condition: Float[AnyArray, ""]


def stand(z: Float[np.ndarray, "pixel size"]) -> LMState:
    """Climbers at their starts; their first step looks around and stays where it is."""
    count, size = z.shape
    far, unit = (
        np.full(count, np.inf, z.dtype),
        np.broadcast_to(np.eye(size, dtype=z.dtype), (count, size, size)),
    )
    return LMState(
        z=z,
        slopes=Slopes(far, np.zeros_like(z), unit),
        damping=np.full(count, FIRST_DAMPING, z.dtype),
        decrement=far,
        steps=np.zeros(count, np.int32),
        settled=np.zeros(count, bool),
    )


def step(
    program: Program, curvature: Curvature, goal: float, climber: LMState, data: Observations
) -> LMState:
    """One damped step, taken only where it leads down."""
    # Source: Marquardt (1963), J. SIAM 11(2), 431-441.
    value, gradient, bend = climber.slopes
    scale = jnp.maximum(jnp.abs(jnp.diagonal(bend)), jnp.finfo(value.dtype).tiny)
    half = inverse(cholesky(bend + climber.damping * jnp.diag(scale)))
    whitened = half @ gradient
    decrement = jnp.sqrt(whitened @ whitened)
    move = -(half.T @ whitened)
    move = move * jnp.minimum(1.0, LONGEST / jnp.maximum(jnp.max(jnp.abs(move)), LONGEST))
    possible = jnp.all(jnp.isfinite(move))
    z = climber.z + jnp.where(possible, move, 0.0)
    tried = curvature(program, jnp.asarray(z), data)
    slack = ROUNDING * jnp.finfo(value.dtype).eps * (1.0 + jnp.abs(value))
    whole = jnp.isfinite(tried.value) & jnp.all(jnp.isfinite(tried.gradient))
    is_first = ~jnp.isfinite(value)
    better = possible & whole & ((tried.value <= value + slack) | is_first)
    looser = jnp.where(
        is_first, climber.damping, jnp.maximum(LOOSER * climber.damping, LEAST_DAMPING)
    )
    firmer = FIRMER * jnp.maximum(climber.damping, LEAST_DAMPING)
    moved = LMState(
        z=jnp.where(better, z, climber.z),
        slopes=jax.tree.map(lambda new, old: jnp.where(better, new, old), tried, climber.slopes),
        damping=jnp.where(better, looser, firmer),
        decrement=jnp.where(possible & ~is_first, decrement, jnp.inf),
        steps=climber.steps + ~is_first,
        settled=better & ~is_first & (decrement < goal) & (climber.damping <= FIRST_DAMPING),
    )
    return jax.tree.map(lambda new, old: jnp.where(climber.settled, old, new), moved, climber)


def crown(z: Float[Array, " size"], slopes: Slopes) -> Peak:
    """The last step, with exact curvature, and what it leaves."""
    value, gradient, bend = slopes
    half = inverse(cholesky(bend))
    whitened = half @ gradient
    covariance = half.T @ half
    condition = jnp.max(jnp.sum(jnp.abs(bend), 0)) * jnp.max(jnp.sum(jnp.abs(covariance), 0))
    decrement = jnp.sqrt(whitened @ whitened)
    return Peak(z - half.T @ whitened, value - 0.5 * decrement**2, half, decrement, condition)
