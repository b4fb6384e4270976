r"""Uncertainty of the set-up in every pixel, by the law of propagation of uncertainty.

All pixels of an image have one set-up. An error $e$ of it, such as that of a lamp's direction,
moves the posterior of a pixel by

$$ \frac{dz}{de} = -H^{-1} \frac{\partial^2 U}{\partial z\, \partial e}, \qquad
H = \frac{\partial^2 U}{\partial z^2} $$

with $U(z, e)$ the potential, at the mode of a perfect set-up. Every draw of the pixel moves by
$dz/de$ times draws of $e$ from its prior: a pixel does not tell its own set-up.

Source:
    JCGM 100:2008 (GUM), 5.1.2 (law of propagation of uncertainty); Giordano, Broderick and Jordan
    (2018), J. Mach. Learn. Res. 19(51), 1-49, section 2 (linear response of a posterior); Plummer
    (2015), Stat. Comput. 25, 37-43 (cut models, in which readings do not inform a nuisance).
"""

import dataclasses
from collections.abc import Mapping, Sequence
from types import MappingProxyType

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpyro import distributions as dist

from polar_bayes.errors import FitError
from polar_bayes.inference.batch_modes import find_modes_from
from polar_bayes.inference.batching import Status, batched
from polar_bayes.inference.compiled_model import CompiledModel
from polar_bayes.inference.problem_batch import BatchDraws, ProblemBatch
from polar_bayes.inference.program import Values
from polar_bayes.numerics.batches import AnyArray
from polar_bayes.numerics.compile import JitOnce
from polar_bayes.numerics.mixtures import normal_points
from polar_bayes.observation.data import Observations

DRAWS = 256
"""Draws of each pixel that one call moves."""


@dataclasses.dataclass(frozen=True)
class Carried:
    """An input quantity that moves all pixels alike: mean and standard deviation of its prior."""

    name: str
    mean: float
    sd: float


def carried(priors: Mapping[str, dist.Distribution]) -> tuple[Carried, ...]:
    """Return moments of the priors of input quantities.

    Raises:
        FitError: A prior is no scalar with a mean and a standard deviation above 0.
    """
    found = []
    for name, prior in priors.items():
        try:
            mean, sd = np.asarray(prior.mean), np.sqrt(np.asarray(prior.variance))
        except NotImplementedError:  # of a transformed distribution, say
            mean = sd = np.array(np.nan)
        if mean.shape or not (np.isfinite(mean) and 0.0 < sd < np.inf):
            what = "a map needs its mean and a standard deviation above 0"
            hint = "give a distribution such as Normal(0, 0.5), or known= a standard uncertainty"
            raise FitError(what, where=f"priors: {name}", hint=hint)
        found.append(Carried(name, float(mean), float(sd)))
    return tuple(found)


class Propagation:
    """Errors of the set-up in the pixels of a batch.

    Args:
        batch: The pixels, as in a perfect set-up.
        with_setup: The model of a pixel whose set-up has errors.
        quantities: Its input quantities.
        prior_slopes: By which the slope of each shared parameter's prior changes with one standard
            deviation of each quantity, by name.
    """

    def __init__(
        self,
        batch: ProblemBatch,
        with_setup: CompiledModel,
        quantities: Sequence[Carried],
        prior_slopes: Mapping[str, Sequence[float]] = MappingProxyType({}),
    ) -> None:
        self._batch, self.names = batch, tuple(each.name for each in quantities)
        self._with_setup = dataclasses.replace(batch, engine=with_setup)
        self._sd = np.array([each.sd for each in quantities])
        self._mean = np.array([each.mean for each in quantities]) / self._sd
        # One of each pair of opposite points, since every draw moves by both; in random order, as a
        # draw and the error that moves it have nothing in common.
        points = normal_points(2 * DRAWS, len(self.names), batch.seed).z[::2]
        self._points = np.random.default_rng(batch.seed).permutation(points)
        own, wider = batch.engine.program.positions, with_setup.program.positions
        self._inside = np.zeros(batch.engine.program.size, int)
        for name, at in own.items():
            self._inside[at] = wider[name]
        self._prior_slope = np.zeros((batch.engine.program.size, len(self.names)))
        for name, slopes in prior_slopes.items():
            self._prior_slope[own[name]] = slopes

    def begin_compiling(self) -> None:
        """Compile what modes need, in parallel with what follows."""
        z = np.zeros((1, self._with_setup.engine.program.size), self._batch.engine.dtype)
        self._with_setup.begin(_cross_derivatives, self.names, z)

    def response(self, at: np.ndarray, z: AnyArray, root: AnyArray) -> np.ndarray:
        """Return the change of modes with one standard deviation, (pixel, size, quantity)."""
        whole = np.zeros((at.size, self._with_setup.engine.program.size), self._batch.engine.dtype)
        whole[:, self._inside] = z
        cross = self._with_setup.subset(at).run(_cross_derivatives, self.names, whole)
        slope = np.swapaxes(cross[:, :, self._inside], 1, 2) * self._sd + self._prior_slope
        covariance = np.swapaxes(root, 1, 2) @ root
        return -covariance @ slope

    def move(self, found: BatchDraws) -> BatchDraws:
        """Return draws moved by errors of the set-up, each by two that are opposite.

        They hold the standard scores of the errors, too, by name of the quantity. A pixel without a
        mode has no response, and is not trusted.
        """
        if not found.draws or not found.at.size:
            return found
        batch = self._batch.subset(found.at)
        mode = found.mode or self._search(batch, found)
        response = self.response(found.at, *mode)
        is_known = np.isfinite(response).all(axis=(1, 2))
        response[~is_known] = 0.0
        good = np.where(is_known, Status.GOOD, Status.NOT_TRUSTED)
        status = np.where(np.asarray(found.status) == Status.GOOD, good, found.status)
        z = found.z()
        if not z.size:
            what, hint = "its draws have no unconstrained vectors", "give its BatchDraws a z"
            raise FitError(what, where="method", hint=hint)
        parts = [
            self._moved(batch, z[:, begin : begin + DRAWS], sign, response)
            for sign in (1.0, -1.0)
            for begin in range(0, z.shape[1], DRAWS)
        ]
        draws = {name: np.concatenate([part[name] for part in parts], 1) for name in parts[0]}
        weights = np.tile(0.5 * found.weights, 2)
        return found._replace(status=status, draws=draws, weights=weights)

    def _moved(
        self, batch: ProblemBatch, z: AnyArray, sign: float, response: np.ndarray
    ) -> dict[str, np.ndarray]:
        """Return draws, moved by errors of one sign, and the errors' standard scores."""
        count, dtype = z.shape[1], batch.engine.dtype
        z = np.pad(z, ((0, 0), (0, DRAWS - count), (0, 0)), "edge").astype(dtype)
        errors = (self._mean + sign * self._points).astype(dtype)
        moved = batch.run(_moves, None, z, response.astype(dtype), given=(errors,))
        scores = np.broadcast_to(errors.T[:, None], (len(self.names), len(batch), DRAWS))
        every = moved | dict(zip(self.names, scores, strict=True))
        return {name: np.asarray(x, np.float32)[:, :count] for name, x in every.items()}

    def _search(self, batch: ProblemBatch, found: BatchDraws) -> tuple[AnyArray, AnyArray]:
        """Search for modes from the heaviest draws, where the method tells none."""
        heaviest = np.argmax(found.weights, axis=1)
        start = np.asarray(found.z(), batch.engine.dtype)[np.arange(len(batch)), heaviest]
        search = find_modes_from(batch, start)
        root = np.where(search.converged[:, None, None], search.mode.root, np.nan)
        return search.mode.z, root


def _cross_derivatives(engine: CompiledModel, names: tuple[str, ...]) -> JitOnce:
    """Make the program that differentiates the gradient by each quantity, (quantity, size)."""
    program = engine.program
    units = np.eye(program.size)[[int(program.positions[name]) for name in names]]

    def of_pixel(data: Observations, z: Array) -> Array:
        gradient = jax.grad(lambda z: program.potential(z, data))
        return jax.vmap(lambda unit: jax.jvp(gradient, (z,), (unit,))[1])(
            jnp.asarray(units, z.dtype)
        )

    return batched(of_pixel)


def _moves(engine: CompiledModel, _: None) -> JitOnce:
    """Make the program that moves the draws of one pixel by errors of the set-up."""

    def of_pixel(errors: Array, data: Observations, z: Array, response: Array) -> Values:
        moved = z + errors @ response.T
        return jax.vmap(lambda z: engine.program.parameters(z, data))(moved)

    return batched(of_pixel, given=1)
