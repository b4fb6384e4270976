"""The compiled programs of a map, and how pixels pass through them.

A batch has a fixed number of pixels, so that every batch of every image runs the same programs.
Pixels that have settled leave between passes; who shares a batch with whom changes nothing.
"""

import dataclasses
import functools
import threading
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from arviz_stats.base import array_stats
from jaxtyping import Array
from numpyro.diagnostics import effective_sample_size

from polar_bayes.inference.batch_nuts import PixelNuts, around_mode, chains
from polar_bayes.inference.batching import Stack, batched, batches
from polar_bayes.inference.compile import TRACING_LOCK, cache_key
from polar_bayes.inference.levenberg_marquardt import (
    AnyArray,
    LMState,
    Peak,
    crown,
    expand,
    score,
    stand,
    step,
)
from polar_bayes.inference.optimize import from_prior
from polar_bayes.inference.program import Program, Values, compile_program
from polar_bayes.inference.proposals import Proposal, Proposed, draw_mixture, fit_mixture
from polar_bayes.inference.psis import Points
from polar_bayes.inference.request import Request
from polar_bayes.inference.smc import NormalScores, PixelTempering, ScoredProgram, Tempered, temper
from polar_bayes.observation.data import Observations

BATCH = 128
"""Pixels that one call of a program takes."""

FEW = 4
"""The same where each pixel has chains of its own."""

LOOKED = 64
"""Draws of one pixel that are looked at side by side: more are shared among cores, which then wait
for each other."""

DRAWN = 8
"""Pixels of a batch that stand side by side where each has hundreds of draws."""

ROUGH, EXACT = (5, 4), (1, 1, 1, 2, 4, 8, 16)
"""Steps between two looks at who has arrived: by scoring in single precision, and with exact
curvature. The first exact one only looks, and for most pixels that is all."""

CROWD = np.uint32(2**32 - 1)
"""Number of the random key of the first crowd; those of rounds count up from 0."""

NEAR = 1e-4
"""The decrement, in posterior sds, at which scoring stops."""

THERE = {"double": 1e-4, "single": 1e-2}
"""The decrement at which a pixel has converged; single precision cannot tell it better."""


class Settled(NamedTuple):
    """Where a row of pixels arrived."""

    peak: Peak
    steps: np.ndarray
    converged: np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class BatchEngine:
    """The model of one pixel, ready to be climbed by many."""

    program: Program
    rough: Program
    candidates: np.ndarray
    precision: str
    programs: dict[Any, Callable] = dataclasses.field(default_factory=dict)

    def ready(self) -> "BatchEngine":
        """The engine with its programs made, though not yet traced."""
        _ = self._start, self._rough_steps, self._exact_steps, self._all_crowned
        return self

    def climb(self, pixels: Stack, rank: int = 0) -> Settled:
        """From a candidate to the mode of every pixel."""
        near = pixels.in_precision(np.float32)
        with jax.enable_x64(False):
            z = self._map(functools.partial(self._start, np.int32(rank)), near)
            rough = self._pass(self._rough_steps, near, stand(z))
        with jax.enable_x64(self.precision == "double"):
            exact = pixels.in_precision(self.dtype)
            z = np.asarray(np.where(_whole(rough.z), rough.z, z), self.dtype)
            look, *further = self._exact_steps
            climbers = jax.tree.map(np.array, self._map(look, exact, stand(z)))
            peak = jax.tree.map(np.array, self._crown(climbers))
            for several in further:
                left = np.flatnonzero(~(peak.decrement < THERE[self.precision]))
                if not left.size:
                    break
                state = jax.tree.map(lambda x, at=left: x[at], climbers)
                moved = self._map(several, exact.subset(left), state)
                parts = jax.tree.leaves((moved, self._crown(moved)))
                for whole, part in zip(jax.tree.leaves((climbers, peak)), parts, strict=True):
                    whole[left] = part
            steps = rough.steps + climbers.steps
        definite = np.isfinite(peak.widths).all(axis=(1, 2))
        return Settled(peak, steps, (peak.decrement < THERE[self.precision]) & definite)

    def draw(
        self, pixels: Stack, proposal: Proposal, points: Points, *, weighted: bool
    ) -> tuple[Values, np.ndarray]:
        """Draws of every pixel's proposal, and how the posterior weighs them."""
        near = pixels.in_precision(np.float32)
        with jax.enable_x64(False):
            center, half = (np.float32(x) for x in proposal)
            given = [np.float32(x) for x in points]
            with TRACING_LOCK:  # no two threads make the same program
                draws = self._kept(self._draws, weighted)
            return self._map(functools.partial(draws, *given), near, center, half)

    def sample(
        self, pixels: Stack, z: AnyArray, half: AnyArray, settings: PixelNuts, keys: np.ndarray
    ) -> tuple[Values, np.ndarray, np.ndarray]:
        """Chains in every pixel."""
        with jax.enable_x64(self.precision == "double"):
            with TRACING_LOCK:
                several = self._kept(self._chains, settings)
            states = np.asarray(z, self.dtype), np.asarray(half, self.dtype), keys
            kept, draws = self._map(several, pixels.in_precision(self.dtype), *states, batch=FEW)
        r_hat = [max(array_stats.rhat(x) for x in np.moveaxis(one, -1, 0)) for one in kept]
        effective = effective_sample_size(np.moveaxis(np.asarray(kept, float), 0, 2))
        return draws, np.array(r_hat), np.min(effective, axis=-1)

    def temper(
        self, pixels: Stack, settings: PixelTempering, keys: np.ndarray, attempt: int
    ) -> Tempered:
        """A crowd for every pixel that began as draws from its prior."""
        with jax.enable_x64(False):
            with TRACING_LOCK:
                crowded = functools.partial(
                    self._kept(self._tempered, settings), CROWD - np.uint32(attempt)
                )
            return self._map(crowded, pixels.in_precision(np.float32), keys, batch=FEW)

    def propose(
        self,
        pixels: Stack,
        settings: PixelTempering,
        scores: NormalScores,
        u: np.ndarray,
        weights: np.ndarray,
        keys: np.ndarray,
        number: int,
    ) -> Proposed:
        """Draws of mixtures that are fitted to weighted draws."""
        with jax.enable_x64(False):
            with TRACING_LOCK:
                proposed = self._kept(self._proposed, settings)
            proposed = functools.partial(proposed, np.uint32(number))
            states = scores, np.float32(u), np.float32(weights), keys
            return self._map(proposed, pixels.in_precision(np.float32), *states, batch=FEW)

    @property
    def dtype(self) -> Any:
        """Floating type of the answer."""
        return np.float64 if self.precision == "double" else np.float32

    def _pass(self, steps: list[Callable], pixels: Stack, climbers: LMState) -> LMState:
        """Passes of steps; those who have settled leave."""
        climbers = jax.tree.map(np.array, climbers)
        for several in steps:
            moving = np.flatnonzero(~climbers.settled)
            if not moving.size:
                break
            state = jax.tree.map(lambda x, m=moving: x[m], climbers)
            found = self._map(several, pixels.subset(moving), state)
            for whole, part in zip(jax.tree.leaves(climbers), jax.tree.leaves(found), strict=True):
                whole[moving] = part
        return climbers

    def _map(self, compiled: Callable, pixels: Stack, *states: Any, batch: int = BATCH) -> Any:
        """Run a program on all pixels, a batch at a time; the last batch is filled up."""
        shared = jax.tree.map(jnp.asarray, pixels.shared)
        parts: list = []
        for index in batches(len(pixels), batch):
            state = jax.tree.map(lambda x, i=index: x[i], states)
            wanted = np.int32(min(batch, len(pixels) - len(parts) * batch))
            found = compiled(wanted, pixels.take(index), shared, *state)
            parts.append(jax.tree.map(np.asarray, found))
        return jax.tree.map(lambda *x: np.concatenate(x)[: len(pixels)], *parts)

    # --- the programs, each compiled at its first use ------------------------------------------

    @functools.cached_property
    def _start(self) -> Callable:
        candidates = self.candidates.astype(np.float32)

        def start(rank: Array, data: Observations) -> Array:
            values = jax.vmap(lambda z: self.rough.potential(z, data))(candidates)
            order = jnp.argsort(jnp.where(jnp.isnan(values), jnp.inf, values))
            return jnp.asarray(candidates)[order[rank]]

        return batched(start, given=1)

    @functools.cached_property
    def _rough_steps(self) -> list[Callable]:
        return _stepping(self.rough, score, NEAR, ROUGH)

    @functools.cached_property
    def _exact_steps(self) -> list[Callable]:
        return _stepping(self.program, expand, 0.1 * THERE[self.precision], EXACT)

    @functools.cached_property
    def _all_crowned(self) -> Callable:
        return jax.jit(jax.vmap(crown))

    def _crown(self, climbers: LMState) -> Peak:
        """The last step of all, in batches that are filled up."""
        parts = []
        for index in batches(len(climbers.z), BATCH):
            z, slopes = jax.tree.map(lambda x, i=index: x[i], (climbers.z, climbers.slopes))
            parts.append(jax.tree.map(np.asarray, self._all_crowned(z, slopes)))
        return jax.tree.map(lambda *x: np.concatenate(x)[: len(climbers.z)], *parts)

    def _kept(self, make: Callable[[Any], Callable], settings: Any) -> Callable:
        """A program for these settings, made if there is none; the caller holds `TRACING_LOCK`."""
        key = make.__name__, settings
        if key not in self.programs:
            self.programs[key] = make(settings)
        return self.programs[key]

    def _draws(self, weighted: bool) -> Callable:
        def draws(
            points: Array, log_density: Array, data: Observations, center: Array, half: Array
        ) -> tuple[Values, Array]:
            places = center + points @ half
            parameters = jax.vmap(lambda z: self.rough.parameters(z, data))(places)
            if not weighted:
                return parameters, jnp.zeros(len(points))
            values = jax.vmap(lambda z: self.rough.potential(z, data))(places)
            return parameters, -values - log_density

        return batched(draws, given=2, side_by_side=DRAWN)

    def _chains(self, settings: PixelNuts) -> Callable:
        def pixel(data: Observations, z: Array, half: Array, key: Array) -> tuple[Array, Values]:
            if settings.start is None:
                z = around_mode(self.program, settings, data, z, half, key)
            kept = chains(self.program, settings, data, z, half, key)
            flat = kept.reshape(-1, self.program.size)
            return kept, jax.vmap(lambda z: self.program.parameters(z, data))(flat)

        return batched(pixel, side_by_side=1)

    def _tempered(self, settings: PixelTempering) -> Callable:
        def pixel(number: Array, data: Observations, key: Array) -> Tempered:
            return temper(self.rough, settings, data, jax.random.fold_in(key, number))

        return batched(pixel, given=1, side_by_side=1)

    def _proposed(self, settings: PixelTempering) -> Callable:
        def pixel(
            number: Array,
            data: Observations,
            scores: NormalScores,
            u: Array,
            weights: Array,
            key: Array,
        ) -> Proposed:
            key_fit, key_draw = jax.random.split(jax.random.fold_in(key, number))
            mixture = fit_mixture(u, weights, settings.components, key_fit)
            drawn = draw_mixture(mixture, settings.draws, key_draw)
            scored = ScoredProgram(self.rough, scores)

            def look(u: Array) -> tuple[Values, Array]:
                return scored.parameters(u, data), scored.potential(u, data)

            parameters, values = jax.lax.map(look, drawn, batch_size=LOOKED)
            log_posterior = jnp.where(jnp.isnan(values), -jnp.inf, -values)
            return Proposed(mixture, drawn, parameters, log_posterior)

        return batched(pixel, given=1, side_by_side=1)


def _stepping(
    program: Program, curvature: Callable, goal: float, passes: tuple[int, ...]
) -> list[Callable]:
    """A program of one pass, for any number of steps."""

    def several(count: Array, data: Observations, climber: LMState) -> LMState:
        def goes_on(at: tuple[Array, LMState]) -> Array:
            return (at[0] < count) & ~at[1].settled

        def onward(at: tuple[Array, LMState]) -> tuple[Array, LMState]:
            return at[0] + 1, step(program, curvature, goal, at[1], data)

        return jax.lax.while_loop(goes_on, onward, (jnp.zeros_like(count), climber))[1]

    compiled = batched(several, given=1)
    return [functools.partial(compiled, np.int32(count)) for count in passes]


def _whole(z: AnyArray) -> AnyArray:
    return np.isfinite(np.asarray(z)).all(axis=-1, keepdims=True)


# --- From a checked request to the programs that fit many captures of one layout ------------------


ENGINE_LOCK = threading.RLock()
"""Held by whoever calls `make_engine`, so that no two threads make the same; always taken before
`TRACING_LOCK`, because an engine compiles and runs the program that draws its candidates."""


@dataclasses.dataclass(frozen=True, eq=False)
class EngineSpec:
    """What programs are made from. Recipes of one key make the same, and share them."""

    request: Request
    observe: Callable[[], Observations]
    candidates: int
    key: str

    def __eq__(self, other: object) -> bool:
        """The same programs."""
        return isinstance(other, EngineSpec) and self.key == other.key

    def __hash__(self) -> int:
        """Of the key."""
        return hash(self.key)


def key_of(request: Request, *further: Any) -> str:
    """A text that is the same for requests whose programs are the same."""
    layout = [
        (name, v.dims, v.shape, str(v.dtype)) for name, v in request.capture.variables.items()
    ]
    return cache_key(
        request.model,
        request.scene,
        request.priors,
        request.links,
        (request.seed, request.precision),
        layout,
        *further,
    )


@functools.lru_cache(maxsize=4)
def make_engine(recipe: EngineSpec) -> BatchEngine:
    """The programs of a recipe; they are traced at their first use."""
    request, data = recipe.request, recipe.observe()
    given = {"double": data, "single": data.in_single_precision()}

    def program(precision: str) -> Program:
        with jax.enable_x64(precision == "double"), TRACING_LOCK:
            model = dataclasses.replace(request, precision=precision).bind(request.scene)
            return compile_program(model, given[precision])

    exact, rough = program(request.precision), program("single")
    with jax.enable_x64(request.precision == "double"):
        key = jax.random.key(request.seed)
        starts = from_prior(exact, key, recipe.candidates, given[request.precision])
    return BatchEngine(exact, rough, starts, request.precision).ready()
