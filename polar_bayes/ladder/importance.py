"""The normal approximations of all modes together, their draws weighed by the posterior."""

import dataclasses
import functools
from typing import override

import jax
import jax.numpy as jnp
import numpy as np

from polar_bayes.errors import FitError
from polar_bayes.inference.bench import Bench
from polar_bayes.inference.ground import STARTS, WholeGround
from polar_bayes.inference.method import AbstractMethod, Answer
from polar_bayes.inference.modes import Modes
from polar_bayes.ladder.weighing import choose, generator, log_densities
from polar_bayes.pixels.importance import LARGEST_TRUSTED, effective_draws, smooth
from polar_bayes.pixels.mixtures import Mixture, draw_mixture, log_density

LEAST_SHARE = 1e-3
"""Of the Laplace evidence: lighter modes get no draws."""

SIDE_BY_SIDE = 1024
"""Draws whose density is computed together: that of all modes at once would fill the memory."""


@dataclasses.dataclass(frozen=True)
class Importance(AbstractMethod):
    """Laplace with importance correction.

    Draws come from a mixture of Student t distributions with 8 degrees of freedom, one at each
    mode that holds 0.1% of the Laplace evidence or more, as heavy as its evidence. Weighing them
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
            raise FitError(f"draws is {self.draws}", where="Importance", mend="give at least 256")

    @override
    def draw(self, bench: Bench) -> Answer:
        ground = bench.ground
        if not isinstance(ground, WholeGround):
            raise FitError(
                "the weights of many patches together say nothing",
                where="Importance",
                mend="use method='nuts'",
            )
        proposal = _proposal(ground.modes, bench.dtype)
        key_draw, key_choice = jax.random.split(bench.key_of_draws)
        places, proposed = (np.asarray(x) for x in _drawn(proposal, self.draws, key_draw))
        ratios = log_densities(bench.program, places, bench.data) - proposed
        weights, k_hat = (x[0] for x in smooth(ratios[None]))
        worth = float(effective_draws(weights[None])[0])
        said = {"modes": ground.said}
        evaluations = {"gradients": float(ground.said["gradients"]), "densities": float(self.draws)}
        if not np.isfinite(weights).all():
            raise FitError(
                "the posterior density is zero at every draw",
                where="Importance",
                mend="use method='nuts'",
            )
        index = choose(weights, worth, generator(key_choice))
        problems = []
        if not k_hat <= LARGEST_TRUSTED:
            problems.append(
                f"Pareto k-hat of the weights is {k_hat:.2f} (at most {LARGEST_TRUSTED}): they do "
                "not reach all of the posterior, so use method='nuts'"
            )
        return Answer(
            kind="importance",
            z=places[index],
            stats={"lp": (ratios + proposed)[index]},
            problems=problems,
            weighted=(places, weights),
            k_hat=float(k_hat),
            effective_draws=worth,
            said=said,
            **evaluations,
        )


@functools.partial(jax.jit, static_argnums=1)
def _drawn(proposal: Mixture, count: int, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    places = draw_mixture(proposal, count, key)
    densities = jax.lax.map(
        lambda z: log_density(proposal, z[None])[0], places, batch_size=min(SIDE_BY_SIDE, count)
    )
    return places, densities


def _proposal(modes: Modes, dtype: np.dtype) -> Mixture:
    """A component for each heavy mode; always as many, so that one program draws from all."""
    # There are never more modes than climbs; a mode has several components where there are fewer.
    heavy = np.flatnonzero(modes.weight >= LEAST_SHARE)
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
