r"""Coordinates in which many pooled patches look like independent standard normal variables.

Given the common parameters, a patch is described twice: by its own readings, about normal around
its own best fit, and by its population. Both together are again about normal, with a mean and a
width that follow from the common parameters in closed form. Each patch is measured from there:

$$ z_m = \hat z_m - P_m^{-1} b_m + L_m^{-T} w_m, \qquad P_m = A_m + D_m(g) = L_m L_m^T, \qquad
   b_m = s_m + C_m (g - \hat g) + d_m(g) $$

with A, s and C curvature, slope and coupling of the readings at the best fit, and d and D those of
the population given the common parameters g. A population without spread then leaves w alone (the
non-centered form), a wide one moves z to where the readings put it (the centered form), and each
patch takes its place between the two, at every value of g. The density is exact whatever A, s and
C are; they only decide how easy it is to sample.

Source:
    Papaspiliopoulos, Roberts and Skold 2007, "A general framework for the parametrization of
    hierarchical models" (the partially non-centered form); Gorinova, Moore and Hoffman 2020.
"""

import dataclasses
import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from numpyro import distributions as dist
from numpyro import handlers

from polar_bayes.inference.groups import Groups
from polar_bayes.inference.program import Program
from polar_bayes.inference.tracing import TracedByShape, TracedOnce
from polar_bayes.observation.data import Observations


class Anchors(eqx.Module):
    """Where the map is anchored: numbers, so that moving them compiles nothing."""

    common: Float[Array, " common"]
    factor: Float[Array, "common common"]
    local: Float[Array, "group local"]
    slope: Float[Array, "group local"]
    curvature: Float[Array, "group local local"]
    coupling: Float[Array, "group local common"]


class Anchored(eqx.Module):
    """What the potential of a transported program is a function of, beside the coordinates."""

    anchors: Anchors
    data: Observations


@dataclasses.dataclass(frozen=True, eq=False)
class Transport:
    """The map for one program."""

    program: Program
    groups: Groups

    @property
    def size(self) -> int:
        """Length of the vector w: common coordinates first, then one group after the other."""
        return self.program.size

    def potential(self, w: Float[Array, " size"], given: Anchored) -> Float[Array, ""]:
        """Minus the log density of w, up to a constant."""
        z, log_volume = self.to_program(w, given)
        return self.program.potential(z, given.data) - log_volume

    def to_program(
        self, w: Float[Array, " size"], given: Anchored
    ) -> tuple[Float[Array, " size"], Float[Array, ""]]:
        """The program's coordinates, and the log volume of the map, up to a constant."""
        anchors = given.anchors
        split = self.groups.common.size
        common = anchors.common + anchors.factor @ w[:split]
        mean, lower = self._around(common, given)
        noise = w[split:].reshape(self.groups.local.shape)
        local = mean + _solve_transposed(lower, noise)
        log_volume = -jnp.sum(jnp.log(jnp.diagonal(lower, axis1=-2, axis2=-1)))
        return self._join(common, local), log_volume

    def from_program(self, z: Float[Array, " size"], given: Anchored) -> Float[Array, " size"]:
        """The coordinates w of a vector of the program."""
        common, local = z[self.groups.common], z[self.groups.local]
        mean, lower = self._around(common, given)
        noise = jnp.einsum("gji,gj->gi", lower, local - mean)
        first = jnp.linalg.solve(given.anchors.factor, common - given.anchors.common)
        return jnp.concatenate([first, noise.ravel()])

    def population(
        self,
        common: Float[Array, " common"],
        local: Float[Array, "group local"],
        data: Observations,
    ) -> tuple[Float[Array, "group local"], Float[Array, "group local"]]:
        """Slope and curvature of minus the log prior of the groups, given what is common."""
        # The priors of a group's coordinates are taken as independent given what is common, which
        # concerns the ease of sampling only.

        def slope(local: Array) -> Array:
            return jax.grad(lambda x: self._prior(self._join(common, x), data))(local)

        return jax.jvp(slope, (local,), (jnp.ones_like(local),))

    @functools.cached_property
    def told_once(self) -> Callable[[Array, Anchored], Array]:
        """The potential; the model is told once, however many programs compute it."""
        return jax.jit(self.potential, inline=True)

    @functools.cached_property
    def value_and_gradient(self) -> Callable[[Array, Anchored], tuple[Array, Array]]:
        """The potential with its gradient, compiled."""
        return TracedOnce(jax.value_and_grad(self.told_once))

    @functools.cached_property
    def there(self) -> Callable[[Array, Anchored], Array]:
        """`to_program` without the volume, compiled."""
        return TracedOnce(lambda w, given: self.to_program(w, given)[0])

    @functools.cached_property
    def back(self) -> Callable[[Array, Anchored], Array]:
        """`from_program`, compiled."""
        return TracedOnce(self.from_program)

    @functools.cached_property
    def chains_there(self) -> Callable[[Array, Anchored], Array]:
        """The same as `there` for chains of draws, (chain, draw, size), one after the other."""

        def place(w: Array, given: Anchored) -> Array:
            return jax.lax.map(
                lambda chain: jax.lax.map(lambda x: self.to_program(x, given)[0], chain), w
            )

        return TracedByShape(place)

    @functools.cached_property
    def of_population(self) -> Callable[[Array, Array, Observations], tuple[Array, Array]]:
        """`population`, compiled."""
        return TracedOnce(self.population)

    def _prior(self, z: Float[Array, " size"], data: Observations) -> Float[Array, ""]:
        """Minus the log prior density of all groups' coordinates."""
        free, latent = self.program.unravel(z), self.program.constrain(z)
        fixed = handlers.substitute(self.program.model, data=latent)
        trace = handlers.trace(handlers.seed(fixed, jax.random.key(0))).get_trace(data)
        total = jnp.zeros((), z.dtype)
        for name, value in latent.items():
            if self.groups.axis in self.program.dims[name]:
                move = dist.biject_to(self.program.supports[name])
                total = total - jnp.sum(trace[name]["fn"].log_prob(value))
                total = total - jnp.sum(move.log_abs_det_jacobian(free[name], value))
        return total

    def _around(
        self, common: Float[Array, " common"], given: Anchored
    ) -> tuple[Float[Array, "group local"], Float[Array, "group local local"]]:
        """Mean of every group and the Cholesky factor of its precision, given what is common."""
        anchors = given.anchors
        slope, curvature = self.population(common, anchors.local, given.data)
        precision = anchors.curvature + _diagonal(jnp.maximum(curvature, 0.0))
        pull = anchors.slope + anchors.coupling @ (common - anchors.common) + slope
        lower = jnp.linalg.cholesky(precision)
        step = jax.scipy.linalg.cho_solve((lower, True), pull[..., None])[..., 0]
        return anchors.local - step, lower

    def _join(self, common: Array, local: Array) -> Array:
        z = jnp.zeros(self.size, local.dtype)
        return z.at[self.groups.common].set(common).at[self.groups.local].set(local)


def _solve_transposed(lower: Array, right: Array) -> Array:
    """L^-T r for a stack of lower triangles."""
    solved = jax.scipy.linalg.solve_triangular(lower, right[..., None], trans=1, lower=True)
    return solved[..., 0]


def _diagonal(values: Float[Array, "group local"]) -> Float[Array, "group local local"]:
    return values[..., None] * jnp.eye(values.shape[-1], dtype=values.dtype)
