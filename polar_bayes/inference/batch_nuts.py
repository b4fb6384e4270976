"""No-U-turn sampling (Hoffman & Gelman 2014) in each of many pixels: short chains, known metric.

Source:
    Hoffman & Gelman (2014), JMLR 15, 1593-1623.
"""

import dataclasses
from typing import Any, override

import jax
import jax.numpy as jnp
import numpy as np
from arviz_stats.base import array_stats
from jaxtyping import Array, Float
from numpyro import infer
from numpyro.diagnostics import effective_sample_size

from polar_bayes.inference.batch_engine import SMALL_BATCH, BatchEngine
from polar_bayes.inference.batch_method import AbstractPixelMethod, BatchFit
from polar_bayes.inference.batching import (
    AnyArray,
    MethodUsed,
    ObservationBatch,
    Status,
    batched,
    take_rows,
)
from polar_bayes.inference.compile import JitOnce
from polar_bayes.inference.levenberg_marquardt import NormalApproximation, find_modes_again
from polar_bayes.inference.program import Program, Values
from polar_bayes.inference.proposals import LIFT
from polar_bayes.inference.smc import PixelSMC, smc_draws
from polar_bayes.observation.data import Observations

MAX_TREE_DEPTH = 8


@dataclasses.dataclass(frozen=True)
class PixelNuts(AbstractPixelMethod):
    """NUTS in each of many pixels, with a metric that is known before.

    Args:
        chains: Of each pixel, >= 2.
        warmup: Draws that adapt the step size, >= 10.
        draws: Kept draws of each chain, >= 50.
        target_acceptance: Between 0.5 and 1.
        largest_r_hat: Above it a pixel counts as not converged; between 1 and 100.
        start: None: chains start from the normal approximation at the mode and take its metric;
            they explore one mode and no other. Or settings of tempered draws from which chains
            start, in all modes, and which give the metric; where chains do not mix, the pixel keeps
            the tempered draws.

    Raises:
        FitError: A setting is outside its range.
    """

    chains: int = 2
    warmup: int = 150
    draws: int = 400
    target_acceptance: float = 0.9
    largest_r_hat: float = 1.05
    start: PixelSMC | None = None

    def __post_init__(self) -> None:
        self._check_least(chains=2, warmup=10, draws=50)
        for name, low, high in (("target_acceptance", 0.5, 1.0), ("largest_r_hat", 1.0, 100.0)):
            if not low < getattr(self, name) < high:
                what = f"{name} is {getattr(self, name)}"
                self._refuse(what, f"give a number between {low:g} and {high:g}")

    @override
    def thinning(self, count: int) -> int:
        return max(1, self.chains * self.draws // count)

    @override
    def fit(
        self, batch: BatchFit, at: np.ndarray, modes: NormalApproximation | None = None
    ) -> None:
        if self.start is not None:
            at, z, root = self._smc_starts(self.start, batch, at)
        else:
            if modes is None:
                search = find_modes_again(batch.engine, batch.pixels.subset(at))
                batch.record_modes(at, search)
                at, modes = at[search.converged], take_rows(search.mode, search.converged)
            z, root = np.asarray(modes.z), np.asarray(modes.root)
        if not at.size:
            return
        some = batch.pixels.subset(at), z, root, batch.keys[at]
        draws, r_hat, effective = sample_chains(batch.engine, self, *some)
        mixed = r_hat <= self.largest_r_hat
        batch.outcome.status[at[~mixed]] = Status.NOT_TRUSTED
        count = self.chains * self.draws
        weights = np.full((int(mixed.sum()), count), 1.0 / count)
        found = take_rows(draws, mixed), weights, effective[mixed], MethodUsed.NUTS
        batch.record(at[mixed], *found)

    def _smc_starts(
        self, start: PixelSMC, batch: BatchFit, at: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pixels with tempered draws, a draw for each chain by weight, and their metric."""
        starts: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        for some, sample in smc_draws(batch, start, at):
            for number, z, weights in zip(some, sample.z, sample.weights, strict=True):
                chosen = np.random.default_rng(batch.keys[number]).choice(
                    len(z), self.chains, p=weights / weights.sum()
                )
                covariance = np.cov(z.T, aweights=weights) + LIFT * np.diag(np.var(z, axis=0))
                starts[int(number)] = z[chosen], np.linalg.cholesky(covariance).T
        found = sorted(starts)
        z, root = (np.array([starts[number][part] for number in found]) for part in (0, 1))
        return np.array(found, int), z, root


def sample_chains(
    engine: BatchEngine,
    settings: PixelNuts,
    pixels: ObservationBatch,
    z: AnyArray,
    root: AnyArray,
    keys: np.ndarray,
) -> tuple[Values, np.ndarray, np.ndarray]:
    """Draws of the chains of every pixel, their largest R-hat and least effective sample size."""
    states = np.asarray(z, engine.dtype), np.asarray(root, engine.dtype), keys
    kept, draws = engine.run(_chains, settings, pixels, *states, batch=SMALL_BATCH)
    r_hat = [max(array_stats.rhat(x) for x in np.moveaxis(one, -1, 0)) for one in kept]
    effective = effective_sample_size(np.moveaxis(np.asarray(kept, float), 0, 2))
    return draws, np.array(r_hat), np.min(effective, axis=-1)


def _chains(engine: BatchEngine, settings: PixelNuts) -> JitOnce:
    """The program of the chains of one pixel."""

    def pixel(data: Observations, z: Array, root: Array, key: Array) -> tuple[Array, Values]:
        if settings.start is None:
            z = around_mode(engine.program, settings, data, z, root, key)
        kept = chains(engine.program, settings, data, z, root, key)
        flat = kept.reshape(-1, engine.program.size)
        return kept, jax.vmap(lambda z: engine.program.parameters(z, data))(flat)

    return batched(pixel, lanes=1)


def chains(
    program: Program,
    settings: PixelNuts,
    data: Observations,
    starts: Float[Array, "chain size"],
    root: Float[Array, "size size"],
    key: Array,
) -> Float[Array, "chain draw size"]:
    """Chains in one pixel."""
    init, advance = infer.hmc.hmc(
        potential_fn_gen=lambda data: lambda z: program.potential(z, data), algo="NUTS"
    )

    def chain(given: tuple[Array, Array]) -> Array:
        first, key = given
        value, gradient = jax.value_and_grad(program.potential)(first, data)
        state = init(
            infer.util.ParamInfo(first, value, gradient),
            settings.warmup,
            step_size=0.5,
            inverse_mass_matrix=root.T @ root,
            dense_mass=True,
            adapt_mass_matrix=False,
            target_accept_prob=settings.target_acceptance,
            trajectory_length=None,
            max_tree_depth=MAX_TREE_DEPTH,
            model_args=(data,),
            rng_key=jax.random.split(key)[1],
        )

        def move(state: Any, _: None) -> tuple[Any, Array]:
            state = advance(state, model_args=(data,))
            return state, state.z

        return jax.lax.scan(move, state, None, length=settings.warmup + settings.draws)[1]

    keys = jax.random.split(key, settings.chains)
    return jax.lax.map(chain, (starts, keys))[:, settings.warmup :]


def around_mode(
    program: Program,
    settings: PixelNuts,
    data: Observations,
    mode: Float[Array, " size"],
    root: Float[Array, "size size"],
    key: Array,
) -> Float[Array, "chain size"]:
    """Draws of the normal approximation, the starts of chains."""

    def draw(key: Array) -> Array:
        noise = jax.random.normal(jax.random.split(key)[0], mode.shape, mode.dtype)
        found = mode + noise @ root
        return jnp.where(jnp.isfinite(program.potential(found, data)), found, mode)

    return jax.vmap(draw)(jax.random.split(key, settings.chains))
