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

from polar_bayes.inference.batching import ObservationBatch, batched, batched_lanes
from polar_bayes.inference.compiled_model import BATCH, CompiledModel
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
from polar_bayes.observation.data import Observations

PRIOR_DRAWS = 32
"""Default number of prior draws among which a starting point is chosen."""

RESTARTS = tuple(range(1, 8))
"""Ranks of the prior draws from which pixels without an acceptable mode start again."""

RANKS, SAME_MODE = 16, 0.1
"""Number of prior draws from which a search for all modes starts; largest distance, in posterior
sds, between two ends of searches that count as one mode."""

SINGLE_PASSES, EXACT_PASSES = (5, 4, 8, 16, 32), (1, 1, 1, 2, 4, 8, 16)
"""Steps of each pass; converged pixels leave between passes. The first exact pass only evaluates
the derivatives, which is enough for most pixels. Most steps use the expected information, which is
positive definite everywhere, unlike the exact Hessian; narrow lobes take up to 60 steps."""

CONDITIONAL_PASSES = (4, 4, 8, 16, 32)
"""Steps of each pass to a conditional mode; curved ridges take dozens of steps."""

SINGLE_GOAL = 1e-4
"""Newton decrement, in posterior sds, at which steps in single precision stop."""

GOALS = {"double": 1e-4, "single": 1e-2}
"""Newton decrement at which a pixel has converged; single precision resolves no smaller one."""


class ModeSearch(NamedTuple):
    """Result of a mode search in a batch of pixels."""

    mode: NormalApproximation
    steps: np.ndarray
    converged: np.ndarray


def find_starts(
    engine: CompiledModel, pixels: ObservationBatch, candidates: int = PRIOR_DRAWS
) -> Float[np.ndarray, "pixel rank size"]:
    """Return prior draws from which each pixel starts, the one of highest density first."""
    # The largest program compiles while the others are traced and run.
    unknown = init(np.zeros((1, engine.program.size), engine.dtype))
    engine.begin(_stepping, False, pixels, unknown, given=(np.int32(1),))
    return engine.run(_starts, candidates, pixels, single=True)


def find_modes(engine: CompiledModel, pixels: ObservationBatch) -> ModeSearch:
    """Find the mode of every pixel from the best of its starts."""
    return find_modes_from(engine, pixels, find_starts(engine, pixels)[:, 0])


def find_modes_from(
    engine: CompiledModel,
    pixels: ObservationBatch,
    start: Float[np.ndarray, "pixel size"],
    known: ModeSearch | None = None,
) -> ModeSearch:
    """Find the mode of every pixel from its own start; a search that ends at `known` returns it."""
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
    """Refine modes in exact precision from where searches in single precision ended."""
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
    """Find distinct modes, heaviest first, and the pixel to which each mode belongs."""
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
    """Find modes given one coordinate, near a vector of each pixel, with potential and Hessian."""
    free = 1.0 - np.eye(z.shape[1], dtype=engine.dtype)[fixed]
    state = jax.tree.map(np.array, init(z.astype(engine.dtype))._replace(free=free))
    for count in CONDITIONAL_PASSES:
        left = np.flatnonzero(~state.settled)
        if left.size:
            put_rows(state, left, _advance(engine, pixels, state, left, count, single=False))
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
    """Make the program of damped steps of a batch, whose number is an argument."""
    goal = SINGLE_GOAL if single else 0.1 * GOALS[engine.precision]
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
