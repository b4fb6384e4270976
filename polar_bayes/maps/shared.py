r"""Parameters that all pixels of an image share, such as a polarizer's gain or the noise.

Their posterior given many pixels is

$$ p(\varphi \mid y) \propto p(\varphi) \prod_i \int p(\theta_i)\, p(y_i \mid \theta_i, \varphi)\,
d\theta_i $$

with $\theta_i$ the parameters of pixel i alone. Slope and curvature of each log integral are
expectations over the posterior of that pixel, and come from its weighted draws:

$$ s_i = E[\partial_\varphi \ell_i], \qquad
J_i = -E[\partial_\varphi^2 \ell_i] - Var[\partial_\varphi \ell_i], \qquad
\ell_i = \log p(y_i, \theta_i \mid \varphi). $$

Newton's method on their sums gives mode and covariance. Under normal approximations
$J_i$ is the Schur complement of the block of $\theta_i$ in an arrowhead matrix.

Source:
    Louis (1982), J. R. Stat. Soc. B 44(2), 226-233, eqs. 3.1 and 3.2 (slope and curvature); Minka
    (2001), UAI 17, 362-369 (expectation propagation, by which the search begins); White (1982),
    Econometrica 50(1), 1-25 (the information matrix test of whether pixels agree, and the
    covariance that holds where they do not).
"""

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.special
from jaxtyping import Array
from numpyro import distributions as dist
from numpyro.distributions import transforms

from polar_bayes.errors import FitError
from polar_bayes.inference.batching import LANES, Status, batched
from polar_bayes.inference.compiled_model import CompiledModel
from polar_bayes.inference.problem_batch import Outcome, ProblemBatch
from polar_bayes.inference.program import Program, Values
from polar_bayes.maps.propagation import Carried, Propagation
from polar_bayes.methods.corrected_laplace import CorrectedLaplace
from polar_bayes.numerics.batches import AnyArray, map_elements
from polar_bayes.numerics.compile import JitOnce
from polar_bayes.numerics.levenberg_marquardt import derivatives
from polar_bayes.numerics.psis import systematic_resample
from polar_bayes.observation.data import Observations

PIXELS = 512
"""Number of pixels from which shared parameters are estimated. Errors of weighted means add up over
pixels, so more pixels would need more draws of each."""

DRAWS = 256
"""Resampled draws of each pixel at which derivatives are computed. With 64, Monte Carlo errors are
a large part of the information of 256 pixels with weakly informative readings."""

LONGEST_STEP, SHRINKAGE, GROWTH, MOST_STEPS = 4.0, 30.0, 2.0, 20
"""Settings of Newton's method: longest step in sds of the pixels' priors, largest factors by which
these priors narrow and widen in one step, and number of steps."""

SETTLED, WIDE, NARROW = 0.25, 50.0, 2.0
"""Largest last step in posterior sds; ratio of prior to posterior variance above which derivatives
at one place are insufficient, and ratio below which the search may end."""


@dataclasses.dataclass(frozen=True)
class SharedParameter:
    """The posterior of a parameter that all pixels share, normal in its coordinate.

    Args:
        name: Of the parameter.
        mean: Of the unconstrained coordinate.
        sd: The same.
        pixels: From which it was estimated.
        disagreement: Information matrix test, a standard normal number where all pixels have one
            value of the parameter, and large where they have several.
        by_setup: By how much the mean moves with one standard deviation of each input quantity.
    """

    name: str
    mean: float
    sd: float
    pixels: int = 0
    disagreement: float = 0.0
    by_setup: Mapping[str, float] = dataclasses.field(default_factory=dict)

    def quantiles(
        self, prior: dist.Distribution, levels: Sequence[float], setup: Sequence[Carried] = ()
    ) -> np.ndarray:
        """Return quantiles of the parameter in a set-up with these input quantities."""
        moves = [(self.by_setup.get(each.name, 0.0), each.mean / each.sd) for each in setup]
        mean = self.mean + sum(move * score for move, score in moves)
        sd = math.hypot(self.sd, *(move for move, _ in moves))
        scores = mean + sd * scipy.special.ndtri(np.asarray(levels))
        return np.asarray(_values(dist.biject_to(prior.support), scores), float)

    def scores(self, prior: dist.Distribution, draws: Values) -> np.ndarray:
        """Return standard scores of draws, in the shape of the draws, given the set-up's errors."""
        # Some pixels have as many draws as they need, and JAX compiles for each length: those of
        # 2**14 are computed together.
        transform, values = dist.biject_to(prior.support), np.float32(draws[self.name])
        with jax.enable_x64(True):
            inverse = functools.partial(_coordinates_of, transform)
            x = map_elements(inverse, values.astype(float), 2**14)
            if not np.isfinite(x).all():
                # Rounded to the end of its support, such as a gain of 1: its neighbor is inside.
                inside = np.nextafter(values, np.float32(_values(transform, np.zeros(()))))
                x = np.where(np.isfinite(x), x, map_elements(inverse, inside.astype(float), 2**14))
        moved = sum(move * draws[name] for name, move in self.by_setup.items())
        return (x - self.mean - moved) / self.sd


# Compiled as a whole: by themselves, their operations are dozens of programs for each shape.


@jax.jit
def _values(transform: transforms.Transform, x: Array) -> Array:
    """Return values at unconstrained coordinates."""
    return transform(x)


@jax.jit
def _coordinates_of(transform: transforms.Transform, values: Array) -> Array:
    """Return unconstrained coordinates of values."""
    return transform.inv(values)


@functools.partial(jax.jit, static_argnums=0)
def _drawn(prior: dist.Distribution) -> Array:
    """Return unconstrained coordinates of draws from a prior."""
    return dist.biject_to(prior.support).inv(prior.sample(jax.random.key(0), (4000,)))


@functools.partial(jax.jit, static_argnums=0)
def _log_density_derivatives(prior: dist.Distribution, x: Array) -> tuple[Array, Array]:
    """Return first and second derivatives of the log prior density of a coordinate."""
    transform = dist.biject_to(prior.support)

    def log_density(x: Array) -> Array:
        value = transform(x)
        return prior.log_prob(value) + transform.log_abs_det_jacobian(x, value)

    slope = jax.grad(log_density)
    return slope(x), jax.grad(slope)(x)


def as_priors(shared: Sequence[SharedParameter]) -> dict[str, tuple[Any, Any]]:
    """Return the entries of `Observations.shared`."""
    return {each.name: (np.asarray(each.mean), np.asarray(each.sd)) for each in shared}


def of_priors(
    names: Sequence[str], priors: Mapping[str, dist.Distribution]
) -> list[SharedParameter]:
    """Approximate the priors by normal distributions, with which the search begins."""
    drawn = {name: np.asarray(_drawn(priors[name]), float) for name in names}
    return [SharedParameter(name, float(x.mean()), float(x.std())) for name, x in drawn.items()]


def estimate_shared(
    batch: ProblemBatch,
    method: CorrectedLaplace,
    priors: Mapping[str, dist.Distribution],
    shared: Sequence[SharedParameter],
) -> list[SharedParameter]:
    """Estimate the posterior of shared parameters from pixels with reliable draws.

    Modes are followed from step to step. The last step searches every pixel from all starts.

    Raises:
        FitError: Too few pixels have an answer, or the search does not settle.
    """
    names = tuple(each.name for each in shared)
    where = f"shared parameters {', '.join(names)}"
    mean, sd = (np.array([getattr(each, part) for each in shared]) for part in ("mean", "sd"))
    once, everywhere = (
        dataclasses.replace(method, sampler=None, starts=starts)
        for starts in (1, CorrectedLaplace.most_starts)
    )
    # Compiled while the first modes are searched for.
    z = np.zeros((1, DRAWS, batch.engine.program.size), batch.engine.dtype)
    batch.begin(_slopes, names, z)
    modes, is_last = None, False
    for _ in range(MOST_STEPS):
        now = [
            dataclasses.replace(each, mean=m, sd=s)
            for each, m, s in zip(shared, mean.tolist(), sd.tolist(), strict=True)
        ]
        searching, are_followed = everywhere if is_last else once, modes is not None
        found, modes = _expectations(batch, searching, now, modes)
        count, least = len(found.slope), 32
        if count < least and are_followed:
            modes = None
            continue
        if count < least:
            what = f"only {count} pixels have an answer (at least {least})"
            raise FitError(what, where=where, hint="let each pixel have its own: shared=()")
        slope, curvature = _prior_derivatives(names, priors, mean)
        total, whole = slope + found.slope.sum(axis=0), curvature + found.information.sum(axis=0)
        ratio = np.max(sd**2 * _precision(whole))
        if not ratio < WIDE:
            # Under a wide prior the posterior of a pixel, divided by that prior, says more than
            # derivatives do (expectation propagation).
            inverse = np.linalg.pinv(found.covariance, hermitian=True)
            inverse *= 1.0 - (sd.size + 1) / (DRAWS - 1)
            total = slope + np.einsum("pij,pj->i", inverse, found.mean - mean)
            whole = curvature + np.sum(inverse - np.diag(sd**-2.0), axis=0)
        if not np.isfinite(_precision(whole)).all():
            # Monte Carlo errors hide what some directions say; others may be known well.
            known, directions = np.linalg.eigh(sd[:, None] * whole * sd)
            root = directions / sd[:, None] * np.sqrt(np.maximum(known, count**0.5))
            whole = root @ root.T
        step, reached = np.linalg.solve(whole, total), _precision(whole) ** -0.5
        is_settled = bool(ratio < NARROW and np.all(np.abs(step) < SETTLED * reached))
        if is_settled and is_last:
            return [
                dataclasses.replace(each, mean=m, sd=s, pixels=count, disagreement=d)
                for each, m, s, d in zip(
                    now,
                    (mean + step).tolist(),
                    _sandwich_sd(found.slope, curvature, whole).tolist(),
                    _information_test(found).tolist(),
                    strict=True,
                )
            ]
        is_last, modes = is_settled, None if is_settled else modes
        step = step / max(1.0, np.max(np.abs(step) / sd) / LONGEST_STEP)
        mean, reached = mean + step, np.maximum(reached, 0.5 * np.abs(step))
        sd = np.clip(reached, sd / SHRINKAGE, GROWTH * sd)
    hint = "let each pixel have its own: shared=(), or share fewer"
    raise FitError(f"their search has not settled in {MOST_STEPS} steps", where=where, hint=hint)


def moved_by_setup(
    batch: ProblemBatch,
    method: CorrectedLaplace,
    priors: Mapping[str, dist.Distribution],
    shared: Sequence[SharedParameter],
    propagation: Propagation,
) -> list[SharedParameter]:
    """Return shared parameters with what errors of the set-up do to them.

    Each pixel's part is the Schur complement of the block of its own parameters, at its mode.
    """
    names = tuple(each.name for each in shared)
    once, size = dataclasses.replace(method, sampler=None, starts=1), batch.engine.program.size
    z, root = np.full((len(batch), size), np.nan), np.full((len(batch), size, size), np.nan)
    for found in once.run_batch(batch):
        if found.mode is not None:
            z[found.at], root[found.at] = found.mode
    good = np.flatnonzero(np.isfinite(root).all(axis=(1, 2)))
    response = propagation.response(good, z[good], root[good])
    at = _positions(batch.engine.program, names)
    known = np.linalg.inv((np.swapaxes(root[good], 1, 2) @ root[good])[:, at[:, None], at])
    prior = np.diag([each.sd**-2.0 for each in shared])
    _, curvature = _prior_derivatives(names, priors, np.array([each.mean for each in shared]))
    whole = curvature + np.sum(known - prior, axis=0)
    moves = np.linalg.solve(whole, np.sum(known @ response[:, at], axis=0))
    return [
        dataclasses.replace(each, by_setup=dict(zip(propagation.names, row, strict=True)))
        for each, row in zip(shared, moves.tolist(), strict=True)
    ]


def _precision(information: np.ndarray) -> np.ndarray:
    """Return the inverse variance of each parameter; infinite where it is not positive."""
    if not np.linalg.eigvalsh(information)[0] > 0.0:
        return np.full(len(information), np.inf)
    return 1.0 / np.diag(np.linalg.inv(information))


class _Expectations(NamedTuple):
    """Score, its Monte Carlo error and information of each pixel; moments of its draws."""

    slope: np.ndarray
    error: np.ndarray
    information: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray


def _information_test(found: _Expectations) -> np.ndarray:
    """Return White's information matrix test of each parameter."""
    expected = np.diagonal(found.information, axis1=1, axis2=2) + found.error**2
    excess = found.slope**2 - expected
    return excess.sum(axis=0) / np.sqrt(np.sum((excess - excess.mean(axis=0)) ** 2, axis=0))


def _sandwich_sd(slope: np.ndarray, prior: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """Return sandwich standard deviations, which allow for excess scatter of the scores."""
    # They do where expectations have Monte Carlo errors, and where pixels do not agree.
    spread = prior + len(slope) * np.atleast_2d(np.cov(slope.T, ddof=0))
    inverse = np.linalg.inv(whole)
    return np.sqrt(np.diag(inverse @ spread @ inverse))


def _prior_derivatives(
    names: Sequence[str], priors: Mapping[str, dist.Distribution], at: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the slope of the log prior density of coordinates, and minus its curvature."""
    with jax.enable_x64(True):
        found = [_log_density_derivatives(priors[n], x) for n, x in zip(names, at, strict=True)]
        first, second = np.array(found, float).T
    return first, -np.diag(second)


def _expectations(
    batch: ProblemBatch,
    method: CorrectedLaplace,
    shared: Sequence[SharedParameter],
    modes: np.ndarray | None,
) -> tuple[_Expectations, np.ndarray]:
    """Return each pixel's information about shared parameters at their present priors.

    The modes, (pixel, size), are where the search begins and where it has ended.
    """
    static = dataclasses.replace(batch.pixels.static, shared=as_priors(shared))
    pixels = dataclasses.replace(batch.pixels, static=static)
    batch, engine = dataclasses.replace(batch, pixels=pixels), batch.engine
    count, size = len(batch), engine.program.size
    every, outcome = np.zeros((count, DRAWS, size), engine.dtype), Outcome(count)
    ends = np.zeros((count, size), engine.dtype)
    for found in method.run_batch(batch, modes):
        outcome.put(found)
        if found.mode is not None:
            ends[found.at] = found.mode[0]
        if found.at.size and found.draws:
            rows, which = np.arange(found.at.size)[:, None], _resampled(found.weights)
            every[found.at] = found.z()[rows, which]
    good = np.flatnonzero(outcome.status == Status.GOOD)
    names = tuple(each.name for each in shared)
    if not good.size:
        return _Expectations(*(np.zeros((0, len(names))) for _ in range(5))), ends
    z = every[good]
    x = z[..., _positions(engine.program, names)].astype(float)
    mean = x.mean(axis=1)
    centered = x - mean[:, None]
    covariance = np.einsum("pdi,pdj->pij", centered, centered) / (DRAWS - 1)
    slope, error, information = batch.subset(good).run(_slopes, names, z)
    return _Expectations(slope, error, information, mean, covariance), ends


def _resampled(weights: np.ndarray) -> np.ndarray:
    """Return indices of draws resampled by weight, (pixel, draw)."""
    # In random order: every sixteenth of quasi-random points would not be spread like all of them.
    order = np.broadcast_to(np.arange(weights.shape[1]), weights.shape)
    order = np.random.default_rng(0).permuted(order, axis=1)
    rows = np.take_along_axis(weights, order, axis=1)
    chosen = np.stack([systematic_resample(row, DRAWS) for row in rows])
    return np.take_along_axis(order, chosen, axis=1)


def _positions(program: Program, names: Sequence[str]) -> np.ndarray:
    """Return positions of parameters in the unconstrained vector."""
    return np.array([int(program.positions[name]) for name in names])


def _slopes(engine: CompiledModel, names: tuple[str, ...]) -> JitOnce:
    """Make the program that returns score and information of one pixel."""
    program = engine.program
    where = _positions(program, names)

    def of_pixel(data: Observations, z: Array) -> tuple[AnyArray, AnyArray, AnyArray]:
        mean, sd = (jnp.stack([data.shared[name][part] for name in names]) for part in (0, 1))

        def of_draw(z: Array) -> tuple[AnyArray, AnyArray]:
            # By name, so that what does not depend on them is not differentiated.
            sites = program.unravel(z)

            def potential(x: Array) -> Array:
                # Without the prior of the shared parameters, which counts once for all pixels.
                own = 0.5 * jnp.sum(((x - mean) / sd) ** 2)
                moved = dict(zip(names, x, strict=True))
                return program.potential_at(sites | moved, data) - own

            found = derivatives(potential, z[where])
            return -found.gradient, found.curvature

        slope, curvature = jax.vmap(of_draw)(z)
        centered = slope - slope.mean(axis=0)
        spread = centered.T @ centered / (len(slope) - 1)
        error = 0.5 * (slope[::2].mean(axis=0) - slope[1::2].mean(axis=0))
        return slope.mean(axis=0), error, curvature.mean(axis=0) - spread

    return batched(of_pixel, lanes=LANES)
