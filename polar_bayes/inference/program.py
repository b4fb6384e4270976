"""A model and its data as pure functions of one flat, unconstrained vector.

Every method knows sites and shapes only, never a parameter by name: point fits, Laplace and
NUTS all stand on this file. Data enter as an argument, so that a fit whose data change and whose
shapes do not compiles nothing.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float
from numpyro import distributions as dist
from numpyro import handlers
from numpyro.infer.util import potential_energy

from polar_bayes.observation.data import Observations

Model = Callable[[Observations], None]


Values = dict[str, Array] | dict[str, np.ndarray]


class Draw(NamedTuple):
    """All that one posterior draw says, by site name; or a stack of draws, as NumPy arrays."""

    latent: Values
    center: Values
    log_likelihood: Values
    log_prior: Values
    predictive: Values


@dataclasses.dataclass(frozen=True)
class Program:
    """A model conditioned on data of one layout.

    Args:
        model: A NumPyro model of the data alone; scene, priors and links are already in it.
        dims: For each sampled site, the axes that its plates gave it.
        events: For each sampled site, the shape of its own event.
        supports: For each latent site, where its values live.
        observed: The sites that the data fix.
        size: Length of the flat vector.
    """

    model: Model
    dims: Mapping[str, tuple[str, ...]]
    events: Mapping[str, tuple[int, ...]]
    supports: Mapping[str, dist.constraints.Constraint]
    observed: tuple[str, ...]
    size: int
    unravel: Callable[[Float[Array, " size"]], dict[str, Array]]

    def potential(self, z: Float[Array, " size"], data: Observations) -> Float[Array, ""]:
        """Minus the log posterior density of the unconstrained vector, up to a constant."""
        return potential_energy(self.model, (data,), {}, self.unravel(z))

    def constrain(self, z: Float[Array, " size"]) -> dict[str, Array]:
        """The latent sites in their physical range."""
        return {
            name: dist.biject_to(self.supports[name])(value)
            for name, value in self.unravel(z).items()
        }

    def from_prior(self, key: Array, data: Observations) -> Float[Array, " size"]:
        """An unconstrained vector drawn from the prior."""
        trace = handlers.trace(handlers.seed(self.model, key)).get_trace(data)
        return ravel_pytree(
            {
                name: dist.biject_to(support).inv(trace[name]["value"])
                for name, support in self.supports.items()
            }
        )[0]

    def describe(self, key: Array, z: Float[Array, " size"], data: Observations) -> Draw:
        """Everything that is stored of one draw: parameters, densities, predicted readings."""
        latent = self.constrain(z)
        fixed = handlers.substitute(self.model, data=latent)
        trace = handlers.trace(handlers.seed(fixed, key)).get_trace(data)
        return _read(trace, latent, self.observed, key)

    def prior_draw(self, key: Array, data: Observations) -> Draw:
        """The same for one draw from the prior."""
        trace = handlers.trace(handlers.seed(self.model, key)).get_trace(data)
        latent = {name: trace[name]["value"] for name in self.supports}
        return _read(trace, latent, self.observed, key)

    def residuals(self, z: Float[Array, " size"], data: Observations) -> dict[str, Array]:
        """Reading minus noise-free reading of every observed site; 0 where not valid."""
        fixed = handlers.substitute(self.model, data=self.constrain(z))
        trace = handlers.trace(handlers.seed(fixed, jax.random.key(0))).get_trace(data)
        return {
            name: jnp.where(data.valid, trace[name]["value"] - noise_free(trace, name), 0.0)
            for name in self.observed
        }


def compile_program(model: Model, data: Observations) -> Program:
    """Walk the model once, without computing anything, and note its sites.

    Args:
        model: A NumPyro model of the data alone.
        data: Any capture of the layout to be fitted.

    Returns:
        The program of that layout.
    """
    sites: dict[str, dict] = {}

    def walk(data: Observations) -> None:
        trace = handlers.trace(handlers.seed(model, jax.random.key(0))).get_trace(data)
        sites.update({name: site for name, site in trace.items() if site["type"] == "sample"})

    jax.eval_shape(walk, data)
    latent = {name: site for name, site in sites.items() if not site["is_observed"]}
    supports = {name: site["fn"].support for name, site in latent.items()}
    prototype = {
        name: jnp.zeros(jax.eval_shape(dist.biject_to(supports[name]).inv, site["value"]).shape)
        for name, site in latent.items()
    }
    flat, unravel = ravel_pytree(prototype)
    return Program(
        model=model,
        dims={name: _plate_names(site) for name, site in sites.items()},
        events={name: tuple(site["fn"].event_shape) for name, site in sites.items()},
        supports=supports,
        observed=tuple(name for name, site in sites.items() if site["is_observed"]),
        size=flat.size,
        unravel=unravel,
    )


def _read(trace: dict, latent: dict[str, Array], observed: tuple[str, ...], key: Array) -> Draw:
    keys = dict(zip(observed, jax.random.split(key, len(observed)), strict=True))
    return Draw(
        latent=latent,
        center={
            n: jnp.broadcast_to(noise_free(trace, n), trace[n]["value"].shape) for n in observed
        },
        log_likelihood={n: trace[n]["fn"].log_prob(trace[n]["value"]) for n in observed},
        log_prior={n: jnp.sum(trace[n]["fn"].log_prob(latent[n])) for n in latent},
        predictive={name: trace[name]["fn"].sample(keys[name]) for name in observed},
    )


def noise_free(trace: dict, name: str) -> Array:
    """The noise-free reading: the site that says so, or the mean of the likelihood."""
    said = trace.get(f"{name}_mean")
    return said["value"] if said is not None else trace[name]["fn"].mean


def _plate_names(site: dict) -> tuple[str, ...]:
    plates = sorted(site["cond_indep_stack"], key=lambda frame: frame.dim)
    return tuple(frame.name for frame in plates)
