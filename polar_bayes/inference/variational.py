"""Automatic differentiation variational inference, in coordinates of the Laplace approximation.

Source:
    Kucukelbir, Tran, Ranganath, Gelman & Blei (2017), JMLR 18(14), 1-45.
"""

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, override

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
from jaxtyping import Array
from numpyro import distributions as dist
from numpyro import handlers, infer, optim
from numpyro.infer import autoguide

from polar_bayes.errors import FitError
from polar_bayes.inference.compile import JitOnce
from polar_bayes.inference.method import AbstractMethod, PosteriorDraws
from polar_bayes.inference.problem import Problem
from polar_bayes.inference.program import Program
from polar_bayes.inference.psis import CHAINS, smooth
from polar_bayes.observation.data import Observations
from polar_bayes.progress import Progress

PARTICLES = 8
"""Draws of the guide from which each step estimates its gradient."""

LAST = 0.01
"""Last learning rate, in units of the first."""


@dataclasses.dataclass(frozen=True)
class AbstractGuide(AbstractMethod):
    """A family of distributions, of which the one nearest to the posterior is fitted.

    Args:
        steps: Of Adam, at least 100.
        learning_rate: Of the first step, in units of the Laplace approximation; it falls to a
            hundredth along a cosine. Above 0.
        draws: Of the guide, in 4 groups, at least 50 in each.

    Raises:
        FitError: A setting is outside its range.
    """

    steps: int = 2000
    learning_rate: float = 0.01
    draws: int = 500

    def __post_init__(self) -> None:
        if self.steps < 100 or self.draws < 50 or not self.learning_rate > 0.0:
            raise FitError(
                f"steps is {self.steps}, draws {self.draws}, learning_rate {self.learning_rate}",
                where=type(self).__name__,
                hint="give at least 100 steps, 50 draws, and a learning rate above 0",
            )

    @abc.abstractmethod
    def guide(self, model: Callable, start: Callable) -> autoguide.AutoContinuous:
        """NumPyro's guide of a model of one vector, which starts at the mode."""

    @override
    def run(self, problem: Problem, key: Array, progress: Progress) -> PosteriorDraws:
        initialization = problem.initialize(progress)
        modes = initialization.joint_modes(type(self).__name__)
        half = jnp.asarray(np.linalg.cholesky(modes.covariance[0]), problem.dtype)
        center = jnp.asarray(modes.z[0], problem.dtype)
        fitted = problem.compiled_model.programs.of(
            self, lambda: _compile_guide(problem.program, self)
        )
        z, log_ratio, loss = (np.asarray(x, float) for x in fitted(key, center, half, problem.data))
        return PosteriorDraws(
            method="variational",
            z=z,
            stats={"log_weight": log_ratio},
            problems=[] if np.isfinite(z).all() else ["the guide has left the posterior"],
            k_hat=float(smooth(log_ratio.reshape(1, -1)).pareto_k[0]),
            effective_draws=float(log_ratio.size),
            gradients=float(initialization.metadata["gradients"]) + float(self.steps * PARTICLES),
            densities=float(log_ratio.size),
            metadata={"modes": initialization.metadata, "loss": float(loss)},
        )


@dataclasses.dataclass(frozen=True)
class NormalGuide(AbstractGuide):
    """The multivariate normal distribution nearest to the posterior, by reverse divergence."""

    @override
    def guide(self, model: Callable, start: Callable) -> autoguide.AutoContinuous:
        return autoguide.AutoMultivariateNormal(model, init_loc_fn=start, init_scale=1.0)


@dataclasses.dataclass(frozen=True)
class FlowGuide(AbstractGuide):
    """A block neural autoregressive flow, which bends.

    Args:
        steps: Of Adam, at least 100.
        learning_rate: Of the first step; it falls to a hundredth along a cosine. Above 0.
        draws: Of the guide, in 4 groups, at least 50 in each.
        flows: Flows one after another, at least 1.

    Raises:
        FitError: A setting is outside its range.

    Source:
        De Cao, Titov & Aziz (2019), arXiv:1904.04676.
    """

    flows: int = 1

    @override
    def guide(self, model: Callable, start: Callable) -> autoguide.AutoContinuous:
        return autoguide.AutoBNAFNormal(model, init_loc_fn=start, num_flows=self.flows)


def _compile_guide(program: Program, settings: AbstractGuide) -> Callable[..., Any]:
    """From the mode to draws of the fitted guide, compiled; only the capture is an argument."""

    def run(key: Array, center: Array, half: Array, data: Observations) -> tuple:
        size, dtype = program.size, center.dtype

        def model() -> None:
            whole = dist.ImproperUniform(dist.constraints.real_vector, (), (size,))
            w = numpyro.sample("w", whole)
            with handlers.block():  # the sites of the model itself are no concern of the guide
                log_density = -program.potential_jit(center + half @ w, data)
            numpyro.factor("posterior", log_density)

        def rate(step: Array) -> Array:
            fall = 0.5 * (1.0 + jnp.cos(jnp.pi * step / settings.steps))
            return settings.learning_rate * (LAST + (1.0 - LAST) * fall)

        start = infer.init_to_value(values={"w": jnp.zeros(size, dtype)})
        guide = settings.guide(model, start)
        svi = infer.SVI(model, guide, optim.Adam(rate), infer.Trace_ELBO(PARTICLES))
        key_start, key_draw = jax.random.split(key)
        state = svi.init(key_start)

        def step(state: Any, _: None) -> tuple[Any, Array]:
            return svi.stable_update(state)

        state, losses = jax.lax.scan(step, state, None, length=settings.steps)
        posterior = handlers.substitute(guide._get_posterior, svi.get_params(state))()
        shape = (CHAINS, settings.draws)
        if isinstance(posterior, dist.TransformedDistribution):  # flows know no inverse
            w, between = posterior.sample_with_intermediates(key_draw, shape)
            log_guide = posterior.log_prob(w, between)
        else:
            w = posterior.sample(key_draw, shape)
            log_guide = posterior.log_prob(w)
        z = center + w @ half.T
        flat = z.reshape(-1, size)
        log_posterior = jax.lax.map(lambda z: -program.potential_jit(z, data), flat, batch_size=64)
        log_ratio = log_posterior.reshape(shape) - log_guide
        return z, jnp.where(jnp.isnan(log_ratio), -jnp.inf, log_ratio), losses[-1]

    return JitOnce(run)
