r"""Conditional standardization of the coefficients of a linear term.

The weights w of a smooth discrepancy can imitate most of what the other parameters do to the
readings. Each set of those parameters therefore has weights of its own, known to the accuracy of
the readings, and the posterior is a thin curved sheet that chains follow in short steps. Given the
other coordinates, however, the weights have a posterior about normal, whose mean and precision one
Gauss-Newton step finds. Chains run in the coordinates c that it standardizes:

$$ w = w_0 + P^{-1} g + L^{-T} c, \qquad P = L L^T = J^T K J + \Lambda, \qquad
   g = J^T K r - \Lambda (w_0 - \mu) $$

with J the slopes of the readings' means by w, K one over their variances, r the residuals at $w_0$,
and $\mu$ and $\Lambda$ mean and precision of the normal prior. The point
$w_0$ follows the regression of w on the other coordinates at the posterior mode. The density is
exact whatever J, K and $w_0$ are: they only decide how efficient sampling is.

Source:
    Papaspiliopoulos, Roberts and Skold 2007, "A general framework for the parametrization of
    hierarchical models", Statist. Sci. 22(1), 59-73 (partial non-centering).
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, override

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_solve, solve_triangular
from jaxtyping import Array, Float
from numpyro import distributions as dist

from polar_bayes.inference.program import AbstractDensity, Program, in_blocks, raveled
from polar_bayes.inference.sum_reparam import SumReparam, find_sum
from polar_bayes.numerics.compile import JitOnce
from polar_bayes.observation.data import Observations


class ConditionalInputs(eqx.Module):
    """The mode, with the regression of the coefficients on the others there, and the capture."""

    data: Observations
    others: Float[Array, " other"]
    coefficients: Float[Array, " coefficient"]
    slope: Float[Array, "coefficient other"]


@dataclasses.dataclass(frozen=True, eq=False)
class ConditionalReparam(AbstractDensity[ConditionalInputs]):
    """The map between coordinates x, in which the coefficients are standardized, and a program's.

    Other coordinates are the same in both, but for two along a sum, where there are such; every
    coordinate keeps its position.
    """

    program: Program
    names: tuple[str, ...]
    coefficients: np.ndarray
    others: np.ndarray
    sums: SumReparam | None
    by_name: Callable[[Array], dict[str, Array]]

    @property
    @override
    def key(self) -> str:
        return self.program.key and f"{self.program.key} conditional"

    @override
    def potential(self, x: Float[Array, " size"], given: ConditionalInputs) -> Float[Array, ""]:
        x, w, log_volume = self._moved(x, given)
        # Not of one flat vector: the optics, which depend on other sites only, are then found to be
        # the same as in the Gauss-Newton step, and computed once.
        sites = self.program.unravel(x) | self.by_name(w)
        return self.program.potential_at(sites, given.data) - log_volume

    def forward(
        self, x: Float[Array, " size"], given: ConditionalInputs
    ) -> tuple[Float[Array, " size"], Float[Array, ""]]:
        """Return the coordinates of the program, and the log volume of the map."""
        x, w, log_volume = self._moved(x, given)
        return x.at[self.coefficients].set(w), log_volume

    def backward(self, z: np.ndarray, data: Observations) -> np.ndarray:
        """Return coordinates x of the program's vectors (row, size), standardized ones zero."""
        if self.sums is not None:
            z = in_blocks(self.sums_of_block, (z,), data)
        x = np.array(z)
        x[:, self.coefficients] = 0.0
        return x

    @functools.cached_property
    def sums_of_block(self) -> JitOnce:
        """Coordinates along a sum of many vectors of the program, compiled."""
        assert self.sums is not None
        return self.once("sums", jax.vmap(self.sums.backward, in_axes=(0, None)))

    @functools.cached_property
    def forward_of_block(self) -> JitOnce:
        """`forward` of many vectors, compiled."""
        return self.once(
            "forward_of_block",
            lambda x, given: jax.lax.map(lambda one: self.forward(one, given), x, batch_size=50),
        )

    def inputs(
        self, mode: np.ndarray, covariance: np.ndarray, data: Observations
    ) -> ConditionalInputs:
        """Return the inputs of the map around a mode, with the posterior covariance there."""
        among = covariance[np.ix_(self.others, self.others)]
        across = covariance[np.ix_(self.coefficients, self.others)]
        slope = np.linalg.solve(among, across.T).T
        others = mode[self.others]
        if self.sums is not None:
            # By central differences in coordinates that are about standard normal: the regression
            # decides only how efficient sampling is.
            apart = 0.01 * np.eye(len(mode))
            steps = np.vstack([0.0 * mode, apart, -apart])
            at, *moved = self.backward((mode + steps).astype(mode.dtype), data)[:, self.others]
            ahead, behind = np.split(np.stack(moved), 2)
            moves = (ahead - behind)[self.others].T / (2.0 * apart[0, 0])
            others, slope = at, np.linalg.solve(moves.T, slope.T).T
        dtype = data.brightness.dtype
        parts = others, mode[self.coefficients], slope
        return ConditionalInputs(data, *(jnp.asarray(part, dtype) for part in parts))

    def inputs_like(self, data: Observations) -> ConditionalInputs:
        """Return inputs of the shapes that `inputs` returns, to compile programs early."""
        dtype, count = data.brightness.dtype, len(self.coefficients)
        others = jnp.zeros(len(self.others), dtype)
        slope = jnp.zeros((count, len(self.others)), dtype)
        return ConditionalInputs(data, others, jnp.zeros(count, dtype), slope)

    def _moved(
        self, x: Float[Array, " size"], given: ConditionalInputs
    ) -> tuple[Float[Array, " size"], Float[Array, " coefficient"], Float[Array, ""]]:
        """Other coordinates of the program, the coefficients, and the log volume of the map."""
        noise, volume = x[self.coefficients], jnp.zeros((), x.dtype)
        start = given.coefficients + given.slope @ (x[self.others] - given.others)
        if self.sums is not None:
            x, volume = self.sums.forward(x, given.data)
        mean, lower = self._conditional(x, start, given)
        w = mean + solve_triangular(lower, noise, trans=1, lower=True)
        return x, w, volume - jnp.sum(jnp.log(jnp.diagonal(lower)))

    def _conditional(
        self,
        x: Float[Array, " size"],
        start: Float[Array, " coefficient"],
        given: ConditionalInputs,
    ) -> tuple[Float[Array, " coefficient"], Float[Array, "coefficient coefficient"]]:
        """Return conditional mean and Cholesky factor of the precision of the coefficients."""
        program = self.program
        sites = program.unravel(x)

        def predict(w: Array) -> tuple[list[Array], Any]:
            """Means of all readings; and these with variances, readings and the priors of w."""
            trace = program.trace_at(sites | self.by_name(w), given.data)
            noise = [moments(trace[name]["fn"], trace[name]["value"]) for name in program.observed]
            priors = [trace[name]["fn"] for name in self.names]
            means, variances, readings = zip(*noise, strict=True)
            return list(means), (means, variances, readings, priors)

        slopes, (means, variances, readings, priors) = jax.jacfwd(predict, has_aux=True)(start)
        center = jnp.concatenate([jnp.ravel(prior.mean) for prior in priors])
        stiffness = 1.0 / jnp.concatenate([jnp.ravel(prior.variance) for prior in priors])
        precision, pull = jnp.diag(stiffness), stiffness * (center - start)
        parts = zip(program.observed, slopes, means, variances, readings, strict=True)
        for name, slope, mean, variance, reading in parts:
            is_fitted = given.data.fitted(name)
            weight = jnp.where(is_fitted, 1.0 / variance, 0.0)
            residual = jnp.where(is_fitted, reading - mean, 0.0)
            precision = precision + jnp.einsum("...i,...,...j->ij", slope, weight, slope)
            pull = pull + jnp.einsum("...i,...->i", slope, weight * residual)
        lower = jnp.linalg.cholesky(precision)
        return start + cho_solve((lower, True), pull), lower


def moments(distribution: dist.Distribution, reading: Array) -> tuple[Array, Array, Array]:
    """Return mean, variance and value of a reading on the scale of its base distribution."""
    while isinstance(distribution, dist.MaskedDistribution | dist.TransformedDistribution):
        if isinstance(distribution, dist.TransformedDistribution):
            for transform in reversed(distribution.transforms):
                reading = transform.inv(reading)
        distribution = distribution.base_dist
    return distribution.mean, distribution.variance, reading


def find_coefficients(program: Program, data: Observations) -> ConditionalReparam | None:
    """Return the map that standardizes vectors with a normal prior; None without any."""
    positions = program.positions
    names = tuple(
        name
        for name in positions
        if program.families[name] == "Normal"
        and program.events[name]
        and not program.dims[name]
        and name not in program.auxiliary
    )
    found = [positions[name].ravel() for name in names]
    count = sum(len(each) for each in found)
    most = 16  # the precision of the coefficients is factored for every gradient
    if not 0 < count <= most or count == program.size:
        return None
    coefficients = np.concatenate(found)
    others = np.setdiff1d(np.arange(program.size), coefficients)
    shapes = {name: jax.ShapeDtypeStruct(program.events[name], jnp.float32) for name in names}
    by_name = raveled(shapes)[1]
    reparam = ConditionalReparam(program, names, coefficients, others, find_sum(program), by_name)
    try:
        given = reparam.inputs_like(data)
        jax.eval_shape(reparam.potential, jnp.zeros(program.size), given)
    except NotImplementedError:  # a link's distribution without mean or variance
        return None
    return reparam
