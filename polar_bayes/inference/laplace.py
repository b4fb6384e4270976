"""The Laplace approximation, and its correction by importance sampling.

Source:
    Tierney and Kadane (1986), J. Am. Stat. Assoc. 81, 82-86: the approximation; Vehtari, Simpson,
    Gelman, Yao & Gabry (2024), JMLR 25(72): Pareto-smoothed importance sampling.
"""

import dataclasses
import functools
from typing import override

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polar_bayes.errors import FitError
from polar_bayes.inference.initialization import STARTS
from polar_bayes.inference.method import AbstractMethod, PosteriorDraws
from polar_bayes.inference.optimize import SETTLED, Modes
from polar_bayes.inference.problem import Problem
from polar_bayes.inference.proposals import Mixture, draw_mixture, log_density
from polar_bayes.inference.psis import (
    MAX_PARETO_K,
    effective_draws,
    numpy_generator,
    smooth,
    systematic_resample,
)
from polar_bayes.progress import Progress

LEAST_WEIGHT = 1e-3
"""Share of the Laplace evidence; modes of less get no draws."""

SIDE_BY_SIDE = 1024
"""Draws whose proposal density is computed together: that of all at once would fill the memory."""


@dataclasses.dataclass(frozen=True)
class Laplace(AbstractMethod):
    """The Laplace approximation: a normal distribution at the heaviest mode.

    Args:
        draws: Draws from the fitted normal distribution, in `chains` groups for ArviZ.
        chains: Groups; the draws are independent, so they only serve diagnostics.

    Raises:
        FitError: Fewer than 50 draws or than 1 chain.
    """

    draws: int = 500
    chains: int = 4

    def __post_init__(self) -> None:
        if self.draws < 50 or self.chains < 1:
            raise FitError(
                f"draws is {self.draws} and chains is {self.chains}",
                where="Laplace",
                hint="give at least 50 draws and 1 chain",
            )

    @override
    def run(self, problem: Problem, key: Array, progress: Progress) -> PosteriorDraws:
        initialization = problem.initialize(progress)
        z, stats = initialization.laplace(key, self.chains, self.draws)
        problems = []
        if initialization.decrement > SETTLED:
            problems.append(
                f"the mode is not settled (Newton decrement {initialization.decrement:.2g} "
                "posterior standard deviations): use method='nuts'"
            )
        count = z[..., 0].size
        return PosteriorDraws(
            method="laplace",
            z=z,
            stats=stats,
            problems=problems,
            k_hat=float(smooth(stats["log_weight"].reshape(1, -1)).pareto_k[0]),
            effective_draws=float(count),
            gradients=float(initialization.metadata.get("gradients", np.nan)) + count,
            densities=0.0,
            metadata={"modes": initialization.metadata},
        )


@dataclasses.dataclass(frozen=True)
class Importance(AbstractMethod):
    """Laplace with importance correction.

    Draws come from a mixture of Student t distributions with 8 degrees of freedom, one at each
    mode that holds 0.1% of the Laplace evidence or more, as heavy as its evidence. Weighting them
    by the posterior corrects what the normal approximation gets wrong, as far as the mixture
    reaches; Pareto k-hat says how far.

    Args:
        draws: Of the mixture, at least 256.

    Raises:
        FitError: Fewer draws.
    """

    draws: int = 4096

    def __post_init__(self) -> None:
        if self.draws < 256:
            raise FitError(f"draws is {self.draws}", where="Importance", hint="give at least 256")

    @override
    def run(self, problem: Problem, key: Array, progress: Progress) -> PosteriorDraws:
        initialization = problem.initialize(progress)
        proposal = laplace_mixture(initialization.joint_modes("Importance"), problem.dtype)
        key_draw, key_resample = jax.random.split(key)
        z, log_proposal = (np.asarray(x) for x in _propose(proposal, self.draws, key_draw))
        log_ratios = problem.log_density(z) - log_proposal
        weights, k_hat = (x[0] for x in smooth(log_ratios[None]))
        if not np.isfinite(weights).all():
            raise FitError(
                "the posterior density is zero at every draw",
                where="Importance",
                hint="use method='nuts'",
            )
        effective = float(effective_draws(weights[None])[0])
        index = systematic_resample(weights, effective, numpy_generator(key_resample))
        problems = []
        if not k_hat <= MAX_PARETO_K:
            problems.append(
                f"Pareto k-hat of the weights is {k_hat:.2f} (at most {MAX_PARETO_K}): they do "
                "not reach all of the posterior, so use method='nuts'"
            )
        return PosteriorDraws(
            method="importance",
            z=z[index],
            stats={"lp": (log_ratios + log_proposal)[index]},
            problems=problems,
            weighted=(z, weights),
            k_hat=float(k_hat),
            effective_draws=effective,
            gradients=float(initialization.metadata["gradients"]),
            densities=float(self.draws),
            metadata={"modes": initialization.metadata},
        )


@functools.partial(jax.jit, static_argnums=1)
def _propose(proposal: Mixture, count: int, key: Array) -> tuple[Array, Array]:
    z = draw_mixture(proposal, count, key)
    densities = jax.lax.map(
        lambda z: log_density(proposal, z[None])[0], z, batch_size=min(SIDE_BY_SIDE, count)
    )
    return z, densities


def laplace_mixture(modes: Modes, dtype: np.dtype) -> Mixture:
    """A component for each heavy mode; always as many, so that one program draws from all."""
    # There are never more modes than starts; a mode has several components where there are fewer.
    heavy = np.flatnonzero(modes.weight >= LEAST_WEIGHT)
    which = np.resize(heavy, max(STARTS, heavy.size))
    times = np.bincount(which, minlength=len(modes.weight))[which]
    share = modes.weight[which] / times
    size = modes.z.shape[1]
    return Mixture(
        center=jnp.zeros(size, dtype),
        half=jnp.eye(size, dtype=dtype),
        log_share=jnp.asarray(np.log(share / share.sum()), dtype),
        mean=jnp.asarray(modes.z[which], dtype),
        scale=jnp.asarray(np.linalg.cholesky(modes.covariance[which]), dtype),
    )
