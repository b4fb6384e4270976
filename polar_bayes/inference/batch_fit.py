"""A row of pixels: mode, width, how far they can be trusted, and what is done where they cannot.

A draw is weighed by the mean of both mixtures, whichever it came from. What one of them covers
badly the other may cover well, and a mixture that is too narrow is found out by the other's draws.

Source:
    Veach & Guibas (1995), SIGGRAPH, 419-428: the balance heuristic; Cornuet, Marin, Mira & Robert
    (2012), Scand. J. Stat. 39(4), 798-812: mixtures that are adapted meanwhile.
"""

import dataclasses
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polar_bayes.errors import FitError
from polar_bayes.inference.batch_nuts import PixelNuts
from polar_bayes.inference.batch_programs import BatchEngine, Settled
from polar_bayes.inference.batch_result import (
    Approximation,
    Describe,
    Outcome,
    Row,
    Status,
    Weighted,
    rows,
)
from polar_bayes.inference.batching import Stack, batches
from polar_bayes.inference.levenberg_marquardt import Peak
from polar_bayes.inference.proposals import (
    FEWEST_EFFECTIVE,
    TIMES,
    Mixture,
    Proposal,
    Proposed,
    heavy_points,
    learn,
    log_density,
)
from polar_bayes.inference.psis import (
    LARGEST_TRUSTED,
    Points,
    effective_draws,
    normal_points,
    smooth,
    turns,
)
from polar_bayes.inference.smc import LIFT, PixelTempering, place
from polar_bayes.repr_html import HTMLRepr

# --- Draws of two mixtures as those of one: no draw that cost an evaluation is thrown away --------


BATCH = 16
"""Pixels that are weighed at a time: their draws stay in a core's own cache."""


def pool(first: Proposed, second: Proposed) -> Weighted:
    """The draws of both, weighed by the posterior over the mean of both mixtures."""
    z, parameters, log_posterior = jax.tree.map(
        lambda *x: np.concatenate(x, axis=1), first[1:], second[1:]
    )
    parts = []
    with jax.enable_x64(False):
        for index in batches(len(z), BATCH):
            given = jax.tree.map(lambda x, i=index: x[i], (first.mixture, second.mixture, z))
            parts.append(np.asarray(_log_means(*given)))
    ratios = log_posterior - np.concatenate(parts)[: len(z)]
    return Weighted(z, parameters, *smooth(ratios))


@jax.jit
@jax.vmap
def _log_means(first: Mixture, second: Mixture, z: Array) -> Array:
    """Log of the mean density of two mixtures at each draw of one pixel."""
    return jnp.logaddexp(log_density(first, z), log_density(second, z))


# --- Crowds, then mixtures in rounds: tempered draws of a row, until they are worth enough --------


def tempered_draws(
    engine: BatchEngine,
    settings: PixelTempering,
    pixels: Stack,
    keys: np.ndarray,
    at: np.ndarray,
    row: Row,
) -> Iterator[tuple[np.ndarray, Weighted]]:
    """Weighted draws as answers come; what has none begins again from a new crowd."""
    row.status[at] = Status.NOT_CONVERGED
    for attempt in range(settings.crowds):
        lost = at
        for some, found, is_worth in _rounds(engine, settings, pixels, keys, at, row, attempt):
            row.temper(some, found, is_worth=is_worth)
            lost = np.setdiff1d(lost, some)
            yield some, found
        at = lost
        if not at.size:
            return


def _rounds(
    engine: BatchEngine,
    settings: PixelTempering,
    pixels: Stack,
    keys: np.ndarray,
    at: np.ndarray,
    row: Row,
    attempt: int,
) -> Iterator[tuple[np.ndarray, Weighted, np.ndarray]]:
    """A crowd from the prior of each; mixtures fitted to it until their draws are worth enough."""
    crowd = engine.temper(pixels.subset(at), settings, keys[at], attempt)
    row.outcome.steps[at] += crowd.stages
    left = np.flatnonzero((crowd.temperature >= 1.0) & np.isfinite(crowd.u).all(axis=(1, 2)))
    count = 2 * settings.draws
    again = np.arange(count) % settings.crowd  # the crowd once, or some of it more often
    u = np.asarray(crowd.u)[left][:, again]
    weights = np.asarray(crowd.weights)[left][:, again] / np.bincount(again)[again]
    before = None
    for number in range(settings.rounds):
        if not left.size:
            return
        some, round_key = pixels.subset(at[left]), attempt * settings.rounds + number
        scores = rows(crowd.scores, left)
        drawn = engine.propose(some, settings, scores, u, weights, keys[at[left]], round_key)
        found = pool(drawn if before is None else before, drawn)
        possible = np.isfinite(found.weights).all(axis=-1)
        settled = np.zeros(left.size, bool)
        if before is not None:  # one mixture alone, too narrow, would look well
            settled = found.worth >= settings.effective_draws
            settled &= found.pareto_k <= LARGEST_TRUSTED
        is_last = number == settings.rounds - 1
        answer = np.flatnonzero(settled | (is_last & possible))
        if answer.size:
            told = rows(found, answer)
            told = told._replace(z=place(rows(scores, answer), told.z))
            yield at[left[answer]], told, settled[answer]
        on = ~settled & possible
        left, before = left[on], rows(drawn, on)
        u, weights = found.z[on], found.weights[on]


# --- A row of pixels: mode, width, how far they can be trusted, and what is done where they cannot


FEWEST_VIEWS = 2
RESTARTS = (1, 3, 7)
"""Ranks of the candidates from which doubtful pixels start again."""

PIECE = 4096
"""Pixels that are fitted at a time: their draws take a hundred megabytes."""

HARD = 1024
"""The same of pixels that have several times as many."""

CANDIDATES = 32
"""Prior draws among which a start is found unless settings say otherwise."""

SAME_MODE = 1e-3
"""Difference of two potentials that is no difference."""


@dataclasses.dataclass(frozen=True)
class PixelLaplace(HTMLRepr):
    """The normal approximation of every pixel, checked and corrected.

    Args:
        draws: Of the approximation in each pixel, from which means and quantiles are taken; a
            power of two, >= 64.
        weighted: True weighs them by the posterior, which corrects the approximation and says how
            far it can be trusted (Pareto k); False takes them as they are, and says nothing.
        candidates: Prior draws among which each pixel finds its start, >= 8.
        rounds: In which the proposal of a pixel with Pareto k above 0.7 is fitted to its own
            weighted draws, until k is below; >= 0. Without weights nothing is in doubt.
        sampler: What pixels whose k is still above are handed to, `PixelNuts` or `PixelTempering`;
            None marks them only.

    Raises:
        FitError: A setting is outside its range.
    """

    draws: int = 256
    weighted: bool = True
    candidates: int = CANDIDATES
    rounds: int = 3
    sampler: PixelNuts | PixelTempering | None = dataclasses.field(default_factory=PixelNuts)

    def __post_init__(self) -> None:
        if self.draws < 64 or self.draws & (self.draws - 1):
            raise FitError(
                f"draws is {self.draws}", where="PixelLaplace", hint="give 64, 128, 256 or so"
            )
        if self.candidates < 8:
            raise FitError(
                f"candidates is {self.candidates}", where="PixelLaplace", hint="give 8 or more"
            )
        if self.rounds < 0:
            raise FitError(f"rounds is {self.rounds}", where="PixelLaplace", hint="give 0 or more")


PixelMethod = PixelLaplace | PixelNuts | PixelTempering
"""What may be done in every pixel."""


def candidates_of(settings: object) -> int:
    """Prior draws among which a start is found by settings of any kind."""
    return settings.candidates if isinstance(settings, PixelLaplace) else CANDIDATES


def fit_stack(
    engine: BatchEngine,
    settings: PixelMethod,
    pixels: Stack,
    numbers: np.ndarray,
    seed: int,
    describe: Describe,
) -> Outcome:
    """Fit every pixel of a row."""
    row = Row(len(pixels), describe)
    row.status[pixels.views < FEWEST_VIEWS] = Status.TOO_FEW_VIEWS
    row.status[pixels.views == 0] = Status.MASKED
    enough = np.flatnonzero(pixels.views >= FEWEST_VIEWS)
    size, keys = engine.program.size, _keys(seed, numbers)
    if isinstance(settings, PixelNuts):
        _sample_all(engine, settings, pixels, keys, enough, row)
        return row.outcome
    if isinstance(settings, PixelTempering):
        _temper_all(engine, settings, pixels, keys, enough, row)
        return row.outcome
    points = normal_points(settings.draws, size, seed)
    further = heavy_points(TIMES * settings.draws, size, seed)
    work = _Work(engine, settings, points, further, keys, turns(keys, size))
    for begin in range(0, enough.size, PIECE):
        work.fit(pixels, enough[begin : begin + PIECE], row)
    return row.outcome


def _sample_all(
    engine: BatchEngine,
    settings: PixelNuts,
    pixels: Stack,
    keys: np.ndarray,
    at: np.ndarray,
    row: Row,
) -> None:
    """Chains in every pixel: around its mode, where it has one, or from tempered draws."""
    if settings.start is not None:
        for begin in range(0, at.size, HARD):
            some = at[begin : begin + HARD]
            _sample_tempered(engine, settings, settings.start, pixels, keys, some, row)
        return
    settled = _climb(engine, pixels.subset(at))
    row.settle(at, settled)
    arrived = np.flatnonzero(settled.converged)
    for begin in range(0, arrived.size, HARD):
        some = arrived[begin : begin + HARD]
        peak, here = rows(settled.peak, some), at[some]
        chains = engine.sample(pixels.subset(here), peak.z, peak.widths, settings, keys[here])
        row.sample(here, *chains, settings.largest_r_hat)


def _sample_tempered(
    engine: BatchEngine,
    settings: PixelNuts,
    start: PixelTempering,
    pixels: Stack,
    keys: np.ndarray,
    at: np.ndarray,
    row: Row,
) -> None:
    """Chains that begin at tempered draws: in each mode as many as it weighs."""
    begins: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for some, found in tempered_draws(engine, start, pixels, keys, at, row):
        for number, z, weights in zip(some, found.z, found.weights, strict=True):
            chosen = np.random.default_rng(keys[number]).choice(
                len(z), settings.chains, p=weights / weights.sum()
            )
            covariance = np.cov(z.T, aweights=weights) + LIFT * np.diag(np.var(z, axis=0))
            begins[number] = z[chosen], np.linalg.cholesky(covariance).T
    here = np.array(sorted(begins), int)
    if not here.size:
        return
    z, half = (np.stack(parts) for parts in zip(*(begins[one] for one in here), strict=True))
    chains = engine.sample(pixels.subset(here), z, half, settings, keys[here])
    row.sample(here, *chains, settings.largest_r_hat)


def _temper_all(
    engine: BatchEngine,
    settings: PixelTempering,
    pixels: Stack,
    keys: np.ndarray,
    at: np.ndarray,
    row: Row,
) -> None:
    """Weighted draws of every pixel."""
    for begin in range(0, at.size, HARD):
        for _ in tempered_draws(engine, settings, pixels, keys, at[begin : begin + HARD], row):
            pass  # the row has been told


def _climb(engine: BatchEngine, pixels: Stack) -> Settled:
    """The modes of pixels; those that did not converge start again."""
    settled = jax.tree.map(np.array, engine.climb(pixels))
    for rank in RESTARTS:
        lost = np.flatnonzero(~settled.converged)
        if not lost.size:
            break
        again = engine.climb(pixels.subset(lost), rank)
        better = again.converged
        for whole, part in zip(jax.tree.leaves(settled), jax.tree.leaves(again), strict=True):
            whole[lost[better]] = part[better]
    return settled


@dataclasses.dataclass(frozen=True, eq=False)
class _Work:
    """What is done to every piece of a row, from the cheapest answer to the dearest."""

    engine: BatchEngine
    settings: PixelLaplace
    points: Points
    further: Points
    keys: np.ndarray
    turns: np.ndarray

    def fit(self, pixels: Stack, at: np.ndarray, row: Row) -> None:
        """Fit some pixels of a row, few enough for their draws to fit into memory."""
        usable = pixels.subset(at)
        found = self._search(usable, self.turns[at])
        row.approximate(at, found, weighted=self.settings.weighted)
        hard = np.flatnonzero(found.settled.converged & ~found.is_trusted)
        for begin in range(0, hard.size, HARD):
            some = hard[begin : begin + HARD]
            left = some[self._adapt(usable.subset(some), rows(found, some), at[some], row)]
            if self.settings.sampler is not None and left.size:
                peak = rows(found.settled.peak, left)
                self._hand_over(self.settings.sampler, pixels, peak, at[left], row)

    def _search(self, pixels: Stack, turns: np.ndarray) -> Approximation:
        """Fit from the best candidate; pixels in doubt start again, and keep the lower mode."""
        found = self._weigh(pixels, self.engine.climb(pixels), turns)
        for rank in RESTARTS:
            doubtful = np.flatnonzero(~found.is_trusted)
            if not doubtful.size:
                break
            some, old = pixels.subset(doubtful), rows(found.settled, doubtful)
            new = self.engine.climb(some, rank)
            lower = new.peak.value < old.peak.value - SAME_MODE
            better = np.flatnonzero(new.converged & (~old.converged | lower))
            if not better.size:
                continue
            at = doubtful[better]
            again = self._weigh(some.subset(better), rows(new, better), turns[at])
            for whole, part in zip(jax.tree.leaves(found), jax.tree.leaves(again), strict=True):
                whole[at] = part
        return found

    def _weigh(self, pixels: Stack, settled: Settled, turns: np.ndarray) -> Approximation:
        """Draws of the normal approximations, and their weights where they are asked for."""
        proposal, weighted = _normal_at(settled.peak).turned(turns), self.settings.weighted
        parameters, ratios = self.engine.draw(pixels, proposal, self.points, weighted=weighted)
        if weighted:
            weights, pareto_k = smooth(ratios)
        else:
            weights = np.full((len(pixels), self.settings.draws), 1.0 / self.settings.draws)
            pareto_k = np.zeros(len(pixels))
        return jax.tree.map(np.array, Approximation(settled, parameters, weights, pareto_k))

    def _adapt(self, pixels: Stack, normal: Approximation, at: np.ndarray, row: Row) -> np.ndarray:
        """Fit proposals to their own weighted draws; which pixels are left without an answer."""
        left, turns = np.arange(len(pixels)), self.turns[at]
        places, weights = (
            _normal_at(normal.settled.peak).turned(turns).places(self.points),
            normal.weights,
        )
        for _ in range(self.settings.rounds):
            if not left.size:
                break
            proposal, some = learn(places, weights).turned(turns[left]), pixels.subset(left)
            looks = [
                self.engine.draw(some, proposal, part, weighted=True)
                for part in self.further.split(TIMES)  # as large as `points`: one program
            ]
            parameters, ratios = jax.tree.map(lambda *x: np.concatenate(x, axis=1), *looks)
            weights, pareto_k = smooth(ratios)
            enough = pareto_k <= LARGEST_TRUSTED
            enough &= effective_draws(weights) >= FEWEST_EFFECTIVE
            row.adapt(at[left[enough]], rows(parameters, enough), weights[enough])
            left, weights = left[~enough], weights[~enough]
            places = proposal.places(self.further)[~enough]
        return left

    def _hand_over(
        self,
        sampler: PixelNuts | PixelTempering,
        pixels: Stack,
        peak: Peak,
        at: np.ndarray,
        row: Row,
    ) -> None:
        """Draws of pixels of the row that no proposal suits."""
        if isinstance(sampler, PixelTempering):
            _temper_all(self.engine, sampler, pixels, self.keys, at, row)
        elif sampler.start is not None:
            _sample_tempered(self.engine, sampler, sampler.start, pixels, self.keys, at, row)
        else:
            some = pixels.subset(at)
            chains = self.engine.sample(some, peak.z, peak.widths, sampler, self.keys[at])
            row.sample(at, *chains, sampler.largest_r_hat)


def _keys(seed: int, numbers: np.ndarray) -> np.ndarray:
    """Random keys that follow the pixels, whoever fits them."""
    base = jax.random.key(seed)
    keys = jax.vmap(lambda number: jax.random.fold_in(base, number))(numbers.astype(np.uint32))
    return np.asarray(jax.random.key_data(keys))


def _normal_at(peak: Peak) -> Proposal:
    """The normal approximation at a mode."""
    return Proposal(np.asarray(peak.z), np.asarray(peak.widths))
