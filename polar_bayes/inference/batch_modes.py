"""Posterior modes of many captures at once, by Levenberg-Marquardt steps from prior draws.

Steps are of Fisher scoring in single precision first, and of exact second derivatives in double
precision at the end. Functions are of one capture and mapped over a batch, so a pixel's result does
not depend on the other pixels of its batch.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from polar_bayes.inference.batching import batched, batched_lanes
from polar_bayes.inference.compiled_model import CompiledModel
from polar_bayes.inference.problem_batch import BATCH, ProblemBatch
from polar_bayes.inference.scoring import exact_derivatives, scoring_derivatives
from polar_bayes.numerics.batches import map_batches, put_rows, take_rows
from polar_bayes.numerics.compile import JitOnce
from polar_bayes.numerics.levenberg_marquardt import (
    LMState,
    NormalApproximation,
    finalize,
    init,
    step,
)
from polar_bayes.numerics.optimize import SAME_MODE
from polar_bayes.observation.data import Observations

CANDIDATES = 32
"""Default number of prior draws among which a starting point is chosen."""

RESTARTS = tuple(range(1, 8))
"""Ranks of the prior draws from which pixels without an acceptable mode start again."""

RANKS = 16
"""Number of prior draws from which a search for all modes starts."""

SINGLE_PASSES, EXACT_PASSES = (5, 4, 8, 16, 32), (1, 1, 1, 2, 4, 8, 16)
"""Steps of each pass; converged pixels leave between passes. The first exact pass only evaluates
the derivatives, which is enough for most pixels. Most steps use the expected information, which is
positive definite everywhere, unlike the exact Hessian; narrow lobes take up to 60 steps."""

GOALS = {"double": 1e-4, "single": 1e-2}
"""Newton decrement at which a pixel has converged; single precision resolves no smaller one."""


class ModeSearch(NamedTuple):
    """Result of a mode search in a batch of pixels."""

    mode: NormalApproximation
    steps: np.ndarray
    converged: np.ndarray


def find_starts(
    batch: ProblemBatch, candidates: int = CANDIDATES
) -> Float[np.ndarray, "pixel rank size"]:
    """Return prior draws from which each pixel starts, the one of highest density first."""
    # The largest program compiles while the others are traced and run.
    unknown = init(np.zeros((1, batch.engine.program.size), batch.engine.dtype))
    batch.begin(_stepping, False, unknown, given=(np.int32(1),))
    return batch.run(_starts, candidates, single=True)


def find_modes_from(
    batch: ProblemBatch, start: Float[np.ndarray, "pixel size"], known: ModeSearch | None = None
) -> ModeSearch:
    """Find the mode of every pixel from its own start; a search that ends at `known` returns it."""
    fast = jax.tree.map(np.array, init(start))
    for count in SINGLE_PASSES:
        left = np.flatnonzero(~fast.settled)
        if left.size:
            put_rows(fast, left, _advance(batch, fast, left, count, single=True))
    if known is None:
        return _refine(batch, start, fast)
    is_known = known.mode.distance(fast.z) < SAME_MODE
    new = np.flatnonzero(~is_known)
    found = jax.tree.map(np.array, known)
    if new.size:
        put_rows(found, new, _refine(batch.subset(new), start[new], take_rows(fast, new)))
    return found


def _refine(batch: ProblemBatch, start: np.ndarray, fast: LMState) -> ModeSearch:
    """The modes near where searches in single precision have ended."""
    engine, everywhere = batch.engine, np.arange(len(batch))
    is_finite = np.isfinite(fast.z).all(axis=-1, keepdims=True)
    state = init(np.where(is_finite, fast.z, start).astype(engine.dtype))
    first, *further = EXACT_PASSES
    state = jax.tree.map(np.array, _advance(batch, state, everywhere, first))
    found = jax.tree.map(np.array, _finalized(engine, state))
    goal = GOALS[engine.precision]
    for count in further:
        left = np.flatnonzero(~(found.decrement < goal))
        if not left.size:
            break
        moved = _advance(batch, state, left, count)
        put_rows((state, found), left, (moved, _finalized(engine, moved)))
    converged = (found.decrement < goal) & np.isfinite(found.root).all(axis=(1, 2))
    return ModeSearch(found, fast.steps + state.steps, converged)


def _advance(
    batch: ProblemBatch, state: LMState, which: np.ndarray, count: int, *, single: bool = False
) -> LMState:
    given, some = (np.int32(count),), take_rows(state, which)
    return batch.subset(which).run(_stepping, single, some, given=given, single=single)


def find_all_modes(
    batch: ProblemBatch,
) -> tuple[Int[np.ndarray, " mode"], NormalApproximation]:
    """Find distinct modes, heaviest first, and the pixel to which each mode belongs."""
    ends: list[NormalApproximation] = []
    is_new: list[np.ndarray] = []
    starts, first = find_starts(batch), None
    for rank in range(starts.shape[1]):
        search = find_modes_from(batch, starts[:, rank], first)
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
    batch: ProblemBatch, z: Float[np.ndarray, "pixel size"], fixed: Int[np.ndarray, " pixel"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The mode near a vector of each pixel given one of its coordinates; potential and Hessian."""
    dtype = batch.engine.dtype
    free = 1.0 - np.eye(z.shape[1], dtype=dtype)[fixed]
    state = jax.tree.map(np.array, init(z.astype(dtype))._replace(free=free))
    for count in (4, 4, 8, 16, 32):  # steps of each pass: bent ridges take dozens
        left = np.flatnonzero(~state.settled)
        if left.size:
            put_rows(state, left, _advance(batch, state, left, count))
    value, _, curvature = state.derivatives
    return np.asarray(state.z), np.asarray(value), np.asarray(curvature)


def _starts(engine: CompiledModel, candidates: int) -> JitOnce:
    """Make the program that ranks prior draws by density and returns the first `RANKS`."""
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
    # The decrement, in posterior sds, at which steps end.
    goal = 1e-4 if single else 0.1 * GOALS[engine.precision]
    program = engine.single_program if single else engine.program
    derivatives_of = scoring_derivatives if single else exact_derivatives

    # The loop is around the map: a loop in a map is traced three times.

    def one(data: Observations, state: LMState) -> LMState:
        return step(lambda z: derivatives_of(program, z, data), goal, state)

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
