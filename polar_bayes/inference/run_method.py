"""Every method answers in one shape: those of `polar_bayes.inference` do so here."""

import dataclasses
import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from polar_bayes.errors import FitError
from polar_bayes.inference import laplace
from polar_bayes.inference.initialization import STARTS
from polar_bayes.inference.laplace import Laplace
from polar_bayes.inference.mcse import measure
from polar_bayes.inference.method import AbstractMethod, PosteriorDraws
from polar_bayes.inference.nuts import Nuts
from polar_bayes.inference.optimize import from_prior
from polar_bayes.inference.problem import Problem
from polar_bayes.inference.psis import smooth
from polar_bayes.inference.request import Method
from polar_bayes.inference.resampling import CHAINS, generator
from polar_bayes.inference.smc import PixelTempering
from polar_bayes.inference.weighted import Tempered

POINT_DRAWS = 1000
"""Of the normal distribution that the standard errors of a point fit stand for."""


@functools.singledispatch
def answer(method: Method, problem: Problem) -> PosteriorDraws:
    """What a method says of a capture."""
    raise FitError(
        f"a {type(method).__name__} is not a method",
        where="method",
        hint="give settings such as polar_bayes.methods.Nuts()",
    )


@answer.register
def _(method: AbstractMethod, problem: Problem) -> PosteriorDraws:
    return method.draw(problem)


@answer.register
def _(method: Nuts, problem: Problem) -> PosteriorDraws:
    drawn = problem.initialization.draw(problem.key_of_draws, method, problem.progress)
    bulk, tail, r_hat = measure(np.moveaxis(drawn.z, -1, 0))
    steps = drawn.stats["n_steps"]
    warmup = np.sum(drawn.stats["warmup_steps"][:, 0])
    climbing = float(problem.initialization.said.get("gradients", np.nan))
    return PosteriorDraws(
        kind="nuts",
        z=drawn.z,
        stats=drawn.stats,
        problems=[*drawn.problems, *_divergence(drawn.stats)],
        r_hat=float(np.max(r_hat)),
        effective_draws=float(min(np.min(bulk), np.min(tail))),
        gradients=climbing + float(warmup + np.sum(steps)),
        densities=0.0,
        said={"modes": problem.initialization.said, "goals_reached": drawn.goals_reached},
    )


@answer.register
def _(method: Laplace, problem: Problem) -> PosteriorDraws:
    drawn = problem.initialization.draw(problem.key_of_draws, method, problem.progress)
    count = drawn.z[..., 0].size
    k_hat = smooth(drawn.stats["log_weight"].reshape(1, -1)).pareto_k[0]
    return PosteriorDraws(
        kind="laplace",
        z=drawn.z,
        stats=drawn.stats,
        problems=drawn.problems,
        k_hat=float(k_hat),
        effective_draws=float(count),
        gradients=float(problem.initialization.said.get("gradients", np.nan)) + count,
        densities=0.0,
        said={"modes": problem.initialization.said},
    )


@answer.register
def _(method: laplace.Point, problem: Problem) -> PosteriorDraws:
    """Draws of the normal distribution that the standard errors stand for."""
    # What the readings do not determine has no standard error, and is drawn without any width.
    key_starts = jax.random.split(problem.key)[0]
    starts = from_prior(problem.program, key_starts, STARTS, problem.data)
    least_squares = problem.compiled_model.least_squares
    found = laplace.to_numpy(least_squares(jnp.asarray(starts[: method.starts]), problem.data))
    free = np.isinf(np.diagonal(found.covariance))
    covariance = np.where(free[:, None] | free, 0.0, found.covariance)
    random = generator(problem.key_of_draws)
    drawn = random.multivariate_normal(found.z, covariance, (CHAINS, POINT_DRAWS // CHAINS))
    return PosteriorDraws(
        kind="point",
        z=drawn,
        stats={},
        problems=[] if found.converged else ["least squares did not meet its tolerance"],
        effective_draws=float(POINT_DRAWS),
    )


def _divergence(stats: dict[str, np.ndarray]) -> list[str]:
    count = int(np.sum(stats["diverging"]))
    return [f"{count} of {stats['diverging'].size} draws diverged"] if count else []


# --- The same method with more draws, or fewer ----------------------------------------------------


@functools.singledispatch
def with_draws(method: Method, factor: float) -> Method | None:
    """The same settings with so many times the draws."""
    draws = getattr(method, "draws", None)
    if not isinstance(draws, int):
        return None
    changed: dict[str, Any] = {"draws": math.ceil(factor * draws)}
    return dataclasses.replace(method, **changed)


@with_draws.register
def _(method: Nuts, factor: float) -> Method:
    scaled = {name: math.ceil(factor * getattr(method, name)) for name in ("draws", "most_draws")}
    return dataclasses.replace(method, effective_draws=factor * method.effective_draws, **scaled)


@with_draws.register
def _(method: Tempered, factor: float) -> Method:
    settings = method.settings
    wanted = factor * settings.answer_draws
    if wanted < settings.crowd:
        raise FitError(
            f"{wanted:g} draws are fewer than the crowd of {settings.crowd}",
            where="Tempered",
            hint="give a smaller crowd, or more draws",
        )
    more = with_answer_draws(settings, wanted)
    worth = settings.effective_draws * more.answer_draws / settings.answer_draws
    return Tempered(dataclasses.replace(more, effective_draws=worth))


def with_answer_draws(settings: PixelTempering, count: float) -> PixelTempering:
    """The same settings with at least so many draws in an answer."""
    half = math.ceil(0.5 * max(count, settings.crowd))
    worth = min(settings.effective_draws, float(half))
    return dataclasses.replace(settings, draws=half, effective_draws=worth)


@functools.singledispatch
def draws_of(method: Method) -> int | None:
    """How many draws a method makes, at least."""
    draws = getattr(method, "draws", None)
    return draws if isinstance(draws, int) else None


@draws_of.register
def _(method: Tempered) -> int | None:
    return method.settings.answer_draws
