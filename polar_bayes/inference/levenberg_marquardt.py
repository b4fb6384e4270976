"""Levenberg-Marquardt on the expected information: posterior modes of many pixels at once.

A damped step minimizes the potential (minus the log posterior density) with the curvature of
Fisher scoring in single precision first, and with exact second derivatives in double precision
at the end. Functions are of one pixel and mapped over a batch, so a pixel's result does not depend
on the other pixels of its batch.

Two choices are for speed where a pixel has few coordinates. Cholesky factors of small matrices are
written out, because a library factors a batch of them one call at a time. Jacobians are taken along
one coordinate at a time, so that parts of the model that do not depend on a coordinate are absent
from its program. `benchmarks/pixels.py` has the measurements.

Source:
    Marquardt (1963), J. SIAM 11(2), 431-441; Schraudolph (2002), Neural Computation 14(7),
    1723-1738: the generalized Gauss-Newton matrix.
"""

import functools
import itertools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int
from numpyro import distributions as dist
from numpyro.infer.util import compute_log_probs

from polar_bayes.inference.batching import (
    AnyArray,
    ObservationBatch,
    batched,
    batched_lanes,
    map_batches,
    put_rows,
    take_rows,
)
from polar_bayes.inference.compile import JitOnce
from polar_bayes.inference.compiled_model import BATCH, CompiledModel
from polar_bayes.inference.program import Program
from polar_bayes.observation.data import Observations

# --- Cholesky factors of small matrices -----------------------------------------------------------


MAX_UNROLLED = 6
"""Largest size of a matrix whose factor is written out, and most coordinates along which Jacobians
are taken one by one. Beyond it compilation takes longer than the program saves."""


def cholesky(matrix: Float[Array | np.ndarray, "size size"]) -> Float[Array, "size size"]:
    """Lower factor of a symmetric matrix; NaN where it is not positive definite."""
    size = matrix.shape[0]
    if size > MAX_UNROLLED:
        return jnp.linalg.cholesky(matrix)
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
    if size > MAX_UNROLLED:
        unit = jnp.eye(size, dtype=factor.dtype)
        return jax.scipy.linalg.solve_triangular(factor, unit, lower=True)
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


# --- Derivatives of one pixel's log posterior density ---------------------------------------------


Coordinates = tuple[Float[Array, ""], ...]
"""The unconstrained vector as numbers, so that each can be differentiated by itself."""


class Derivatives(NamedTuple):
    """The potential (minus the log posterior density) around a point."""

    value: Float[AnyArray, ""]
    gradient: Float[AnyArray, " size"]
    curvature: Float[AnyArray, "size size"]


def scoring_derivatives(
    program: Program, z: Float[Array, " size"], data: Observations
) -> Derivatives:
    """Value, gradient and the curvature of Fisher scoring."""
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
    """Value, gradient and exact second derivatives."""
    return derivatives(lambda z: program.potential(z, data), z)


class _Pixel:
    """The likelihood of a program and its data in terms of coordinates, one number each."""

    # `arguments` is traced once, however often it is differentiated: tracing a model with NumPyro
    # is slow.

    def __init__(self, program: Program, data: Observations) -> None:
        self._program = program
        self._data = data
        self._layout = jax.eval_shape(program.unravel, jnp.zeros(program.size))
        self.arguments = jax.jit(self._arguments, inline=True)

    def likelihoods(self, coordinates: Coordinates) -> list[Callable]:
        """For each observed site, the log density as a function of `arguments`."""
        return [
            functools.partial(self._likelihood, *jax.tree.flatten(distribution), value)
            for distribution, value in self._observed(coordinates)
        ]

    def active(self, at: int, coordinates: Coordinates) -> list[int]:
        """Which arguments of the distribution of an observed site depend on any coordinate."""

        def argument(which: int, *coordinates: Array) -> Array:
            return self.arguments(coordinates)[at][which]

        count = len(self.arguments(coordinates)[at])
        return [a for a in range(count) if _depends(functools.partial(argument, a), coordinates)]

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
        latent = {
            name: dist.biject_to(self._program.supports[name])(value)
            for name, value in self._sites(coordinates).items()
        }
        _, trace = compute_log_probs(self._program.model, (self._data,), {}, latent)
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


def derivatives(function: Callable, z: Float[Array, " size"]) -> Derivatives:
    """Value, gradient and Hessian of a function of the unconstrained vector."""

    def first(z: Array) -> tuple[Array, tuple[Array, Array]]:
        value, gradient = jax.value_and_grad(function)(z)
        return gradient, (value, gradient)

    curvature, (value, gradient) = jax.jacfwd(first, has_aux=True)(z)
    return Derivatives(value, gradient, curvature)


def _jacobian(function: Callable, coordinates: Coordinates) -> tuple[Any, Any]:
    """A tree of arrays, and its derivatives along every coordinate, (size, ...)."""
    size = len(coordinates)
    if size > MAX_UNROLLED:
        units = tuple(jnp.eye(size, dtype=coordinates[0].dtype))
        push = jax.vmap(lambda unit: jax.jvp(function, coordinates, unit), out_axes=(None, 0))
        return push(units)

    def along(k: int) -> tuple[Any, Any]:
        """The derivative along one coordinate, the others being constants."""
        below, x, above = coordinates[:k], coordinates[k], coordinates[k + 1 :]
        return jax.jvp(lambda x: function(*below, x, *above), (x,), (jnp.ones_like(x),))

    values, rows = zip(*map(along, range(size)), strict=True)
    return values[0], jax.tree.map(lambda *row: jnp.stack(row), *rows)


def _depends(function: Callable, coordinates: Coordinates) -> bool:
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


# --- Damped steps of one pixel --------------------------------------------------------------------


MAX_STEP = 3.0  # in an unconstrained coordinate: the model changes too much beyond
FIRST_DAMPING = 1e-2
LEAST_DAMPING = 1e-8
DAMPING_UP, DAMPING_DOWN = 10.0, 0.1
ROUNDING = 8.0  # of the potential, in units of its last digit, that count as no change

DerivativesOf = Callable[[Program, Array, Observations], Derivatives]


class LMState(NamedTuple):
    """State of the minimization of one pixel."""

    z: Float[AnyArray, " size"]
    derivatives: Derivatives
    damping: Float[AnyArray, ""]
    decrement: Float[AnyArray, ""]
    steps: Int[AnyArray, ""]
    settled: Bool[AnyArray, ""]
    free: Float[AnyArray, " size"]
    """One for each coordinate, zero for those that stay where they are."""


class NormalApproximation(NamedTuple):
    """A mode, and the normal distribution there; its covariance is `root.T @ root`."""

    z: Float[AnyArray, " size"]
    value: Float[AnyArray, ""]
    root: Float[AnyArray, "size size"]
    decrement: Float[AnyArray, ""]
    condition: Float[AnyArray, ""]

    @property
    def log_evidence(self) -> np.ndarray:
        """Of many pixels: that of the normal approximation, up to a constant, (pixel,)."""
        with np.errstate(invalid="ignore"):  # of pixels without a mode
            return np.log(np.diagonal(self.root, axis1=1, axis2=2)).sum(axis=1) - self.value

    def distance(self, z: Float[AnyArray, "pixel size"]) -> np.ndarray:
        """Of many pixels: from the mode to a vector, in posterior sds, (pixel,); NaN if unknown."""
        root, known = np.swapaxes(self.root, 1, 2), np.isfinite(self.root).all(axis=(1, 2))
        known &= (np.diagonal(root, axis1=1, axis2=2) > 0.0).all(axis=1)
        away = np.full(known.size, np.nan)
        moved = np.linalg.solve(root[known], (z - self.z)[known, :, None])
        away[known] = np.linalg.norm(moved[..., 0], axis=1)
        return away


def init(z: Float[np.ndarray, "pixel size"]) -> LMState:
    """States at the starts; the first step only evaluates the derivatives there."""
    count, size = z.shape
    unknown = np.full(count, np.inf, z.dtype)
    identity = np.broadcast_to(np.eye(size, dtype=z.dtype), (count, size, size))
    return LMState(
        z=z,
        derivatives=Derivatives(unknown, np.zeros_like(z), identity),
        damping=np.full(count, FIRST_DAMPING, z.dtype),
        decrement=unknown,
        steps=np.zeros(count, np.int32),
        settled=np.zeros(count, bool),
        free=np.ones_like(z),
    )


def step(
    program: Program, derivatives_of: DerivativesOf, goal: float, state: LMState, data: Observations
) -> LMState:
    """One damped step, taken only where it decreases the potential."""
    value, gradient, curvature = state.derivatives
    free = state.free
    gradient = free * gradient
    curvature = free[:, None] * curvature * free + jnp.diag(1.0 - free)
    scale = jnp.maximum(jnp.abs(jnp.diagonal(curvature)), jnp.finfo(value.dtype).tiny)
    root = inverse(cholesky(curvature + state.damping * jnp.diag(scale)))
    whitened = root @ gradient
    decrement = jnp.sqrt(whitened @ whitened)
    move = -(root.T @ whitened)
    move = move * jnp.minimum(1.0, MAX_STEP / jnp.maximum(jnp.max(jnp.abs(move)), MAX_STEP))
    is_possible = jnp.all(jnp.isfinite(move))
    z = state.z + jnp.where(is_possible, move, 0.0)
    proposed = derivatives_of(program, jnp.asarray(z), data)
    slack = ROUNDING * jnp.finfo(value.dtype).eps * (1.0 + jnp.abs(value))
    is_finite = jnp.isfinite(proposed.value) & jnp.all(jnp.isfinite(proposed.gradient))
    is_first = ~jnp.isfinite(value)
    accepted = is_possible & is_finite & ((proposed.value <= value + slack) | is_first)
    less = jnp.where(
        is_first, state.damping, jnp.maximum(DAMPING_DOWN * state.damping, LEAST_DAMPING)
    )
    more = DAMPING_UP * jnp.maximum(state.damping, LEAST_DAMPING)
    moved = LMState(
        z=jnp.where(accepted, z, state.z),
        derivatives=jax.tree.map(
            lambda new, old: jnp.where(accepted, new, old), proposed, state.derivatives
        ),
        damping=jnp.where(accepted, less, more),
        decrement=jnp.where(is_possible & ~is_first, decrement, jnp.inf),
        steps=state.steps + ~is_first,
        settled=accepted & ~is_first & (decrement < goal) & (state.damping <= FIRST_DAMPING),
        free=free,
    )
    return jax.tree.map(lambda new, old: jnp.where(state.settled, old, new), moved, state)


@jax.jit
@jax.vmap
def finalize(z: Float[Array, " size"], there: Derivatives) -> NormalApproximation:
    """The last step, with exact curvature, and the normal approximation at its end."""
    value, gradient, curvature = there
    root = inverse(cholesky(curvature))
    whitened = root @ gradient
    covariance = root.T @ root
    condition = jnp.max(jnp.sum(jnp.abs(curvature), 0)) * jnp.max(jnp.sum(jnp.abs(covariance), 0))
    decrement = jnp.sqrt(whitened @ whitened)
    mode = z - root.T @ whitened
    return NormalApproximation(mode, value - 0.5 * decrement**2, root, decrement, condition)


# --- Modes of a batch of pixels -------------------------------------------------------------------


PRIOR_DRAWS = 32
"""Draws from the prior among which a starting point is chosen unless settings say otherwise."""

RESTARTS = tuple(range(1, 8))
"""Ranks of the prior draws from which pixels without a good mode start again."""

RANKS, SAME_MODE = 16, 0.1
"""Prior draws that are kept, from all of which a search for all modes starts; posterior sds within
which two ends are the same mode."""

SINGLE_PASSES, EXACT_PASSES = (5, 4, 8, 16, 32), (1, 1, 1, 2, 4, 8, 16)
"""Steps of each pass; pixels that have converged leave between passes. The first exact pass only
evaluates the derivatives, which is enough for most pixels. The expected information is positive
definite everywhere and exact curvature is not, so that the long way is gone with the former:
narrow lobes take up to 60 steps."""

CONDITIONAL_PASSES = (4, 4, 8, 16, 32)
"""Steps of the passes to a mode given one coordinate: bent ridges take dozens."""

SINGLE_GOAL = 1e-4
"""The Newton decrement, in posterior sds, at which steps in single precision stop."""

GOALS = {"double": 1e-4, "single": 1e-2}
"""The decrement at which a pixel has converged; single precision resolves it no better."""


class ModeSearch(NamedTuple):
    """Result of a mode search in a batch of pixels."""

    mode: NormalApproximation
    steps: np.ndarray
    converged: np.ndarray


def find_starts(
    engine: CompiledModel, pixels: ObservationBatch, candidates: int = PRIOR_DRAWS
) -> Float[np.ndarray, "pixel rank size"]:
    """Draws from the prior at which each pixel starts, the one of highest density first."""
    # The largest program compiles while the others are traced and run.
    unknown = init(np.zeros((1, engine.program.size), engine.dtype))
    engine.begin(_stepping, False, pixels, unknown, given=(np.int32(1),))
    return engine.run(_starts, candidates, pixels, single=True)


def find_modes(engine: CompiledModel, pixels: ObservationBatch) -> ModeSearch:
    """The mode of every pixel, from the best of its starts."""
    return find_modes_from(engine, pixels, find_starts(engine, pixels)[:, 0])


def find_modes_from(
    engine: CompiledModel,
    pixels: ObservationBatch,
    start: Float[np.ndarray, "pixel size"],
    known: ModeSearch | None = None,
) -> ModeSearch:
    """The mode of every pixel, from a vector of its own; a search that ends at `known` is that."""
    fast = jax.tree.map(np.array, init(start))
    for count in SINGLE_PASSES:
        left = np.flatnonzero(~fast.settled)
        if left.size:
            put_rows(fast, left, _advance(engine, pixels, fast, left, count, single=True))
    if known is None:
        return _refine(engine, pixels, start, fast)
    is_known = known.mode.distance(fast.z) < SAME_MODE
    new = np.flatnonzero(~is_known)
    found = jax.tree.map(np.array, known)
    if new.size:
        put_rows(found, new, _refine(engine, pixels.subset(new), start[new], take_rows(fast, new)))
    return found


def _refine(
    engine: CompiledModel, pixels: ObservationBatch, start: np.ndarray, fast: LMState
) -> ModeSearch:
    """The modes near where searches in single precision have ended."""
    is_finite = np.isfinite(fast.z).all(axis=-1, keepdims=True)
    state = init(np.where(is_finite, fast.z, start).astype(engine.dtype))
    first, *further = EXACT_PASSES
    everywhere = np.arange(len(pixels))
    state = _advance(engine, pixels, state, everywhere, first, single=False)
    state = jax.tree.map(np.array, state)
    found = jax.tree.map(np.array, _finalized(engine, state))
    goal = GOALS[engine.precision]
    for count in further:
        left = np.flatnonzero(~(found.decrement < goal))
        if not left.size:
            break
        moved = _advance(engine, pixels, state, left, count, single=False)
        put_rows((state, found), left, (moved, _finalized(engine, moved)))
    converged = (found.decrement < goal) & np.isfinite(found.root).all(axis=(1, 2))
    return ModeSearch(found, fast.steps + state.steps, converged)


def _advance(
    engine: CompiledModel,
    pixels: ObservationBatch,
    state: LMState,
    which: np.ndarray,
    count: int,
    *,
    single: bool,
) -> LMState:
    some = pixels.subset(which), take_rows(state, which)
    return engine.run(_stepping, single, *some, given=(np.int32(count),), single=single)


def find_all_modes(
    engine: CompiledModel, pixels: ObservationBatch
) -> tuple[Int[np.ndarray, " mode"], NormalApproximation]:
    """Distinct modes of each pixel, the heaviest first, and the pixel that each belongs to."""
    ends: list[NormalApproximation] = []
    is_new: list[np.ndarray] = []
    starts, first = find_starts(engine, pixels), None
    for rank in range(starts.shape[1]):
        search = find_modes_from(engine, pixels, starts[:, rank], first)
        first, (mode, _, converged) = first or search, search
        for other, kept in zip(ends, is_new, strict=True):
            converged = converged & ~(kept & (other.distance(mode.z) < SAME_MODE))
        ends.append(mode)
        is_new.append(converged)
    rank, owner = np.nonzero(is_new)
    modes = jax.tree.map(lambda *each: np.stack(each)[rank, owner], *ends)
    order = np.lexsort((-modes.log_evidence, owner))
    return owner[order], take_rows(modes, order)


def find_conditional_modes(
    engine: CompiledModel,
    pixels: ObservationBatch,
    z: Float[np.ndarray, "pixel size"],
    fixed: Int[np.ndarray, " pixel"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The mode near a vector of each pixel given one of its coordinates; potential and Hessian."""
    free = 1.0 - np.eye(z.shape[1], dtype=engine.dtype)[fixed]
    state = jax.tree.map(np.array, init(z.astype(engine.dtype))._replace(free=free))
    for count in CONDITIONAL_PASSES:
        left = np.flatnonzero(~state.settled)
        if left.size:
            put_rows(state, left, _advance(engine, pixels, state, left, count, single=False))
    value, _, curvature = state.derivatives
    return np.asarray(state.z), np.asarray(value), np.asarray(curvature)


def _starts(engine: CompiledModel, candidates: int) -> JitOnce:
    """A program that ranks draws from the prior, and keeps the first `RANKS`."""
    draws = engine.prior_draws(candidates).astype(np.float32)

    program = engine.single_program

    def start(data: Observations) -> Array:
        # Parameters whose priors come from other pixels start at those.
        known = {name: mean for name, (mean, _) in data.shared.items()}
        starts = jax.vmap(lambda z: ravel_pytree({**program.unravel(z), **known})[0])(draws)
        values = jax.vmap(lambda z: program.potential(z, data))(starts)
        order = jnp.argsort(jnp.where(jnp.isnan(values), jnp.inf, values))
        return starts[order[:RANKS]]

    return batched(start)


def _stepping(engine: CompiledModel, single: bool) -> JitOnce:
    """A program of any number of steps."""
    goal = SINGLE_GOAL if single else 0.1 * GOALS[engine.precision]
    program = engine.single_program if single else engine.program
    derivatives_of = scoring_derivatives if single else exact_derivatives

    # The loop is around the map: a loop in a map is traced three times.

    def one(data: Observations, state: LMState) -> LMState:
        return step(program, derivatives_of, goal, state, data)

    def several(over: Callable, count: Array, state: LMState) -> LMState:
        def goes_on(at: tuple[Array, LMState]) -> Array:
            return (at[0] < count) & ~jnp.all(at[1].settled)

        def advance(at: tuple[Array, LMState]) -> tuple[Array, LMState]:
            return at[0] + 1, over(one, at[1])

        return jax.lax.while_loop(goes_on, advance, (jnp.zeros_like(count), state))[1]

    return batched_lanes(several, given=1)


def _finalized(engine: CompiledModel, state: LMState) -> NormalApproximation:
    def of_batch(index: np.ndarray) -> NormalApproximation:
        return finalize(*take_rows((state.z, state.derivatives), index))

    with jax.enable_x64(engine.precision == "double"):
        return map_batches(of_batch, len(state.z), BATCH)
