"""A model and its data as pure functions of one flat, unconstrained vector.

Every method knows sites and shapes only, never a parameter by name: point fits, Laplace and
NUTS all stand on this file. Data enter as an argument, so that a fit whose data change and whose
shapes do not compiles nothing.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float
from numpyro import distributions as dist
from numpyro import handlers
from numpyro.infer.util import potential_energy
from numpyro.primitives import Messenger

from polar_bayes.errors import FitError
from polar_bayes.inference.compile import JitByShape, JitOnce
from polar_bayes.observation.data import Observations
from polar_bayes.observation.links import AbstractLink
from polar_bayes.physics.scene import Scene
from polar_bayes.priors import PriorTable, check_support

Model = Callable[[Observations], None]


Values = dict[str, Array] | dict[str, np.ndarray]


class Draw(NamedTuple):
    """All that one posterior draw says, by site name; or a stack of draws, as NumPy arrays."""

    parameters: Values
    coordinates: Values
    center: Values
    log_likelihood: Values
    log_prior: Values
    predictive: Values


@dataclasses.dataclass(frozen=True, eq=False)
class Program:
    """A model conditioned on data of one layout."""

    model: Model
    dims: Mapping[str, tuple[str, ...]]
    plates: Mapping[str, int]
    events: Mapping[str, tuple[int, ...]]
    supports: Mapping[str, dist.constraints.Constraint]
    auxiliary: tuple[str, ...]
    derived: tuple[str, ...]
    observed: tuple[str, ...]
    fixed: tuple[str, ...]
    families: Mapping[str, str]
    size: int
    unravel: Callable[[Float[Array, " size"]], dict[str, Array]]

    def potential(self, z: Float[Array, " size"], data: Observations) -> Float[Array, ""]:
        """Minus the log posterior density of the unconstrained vector, up to a constant."""
        return self.potential_at(self.unravel(z), data)

    def potential_at(self, sites: dict[str, Array], data: Observations) -> Float[Array, ""]:
        """The same of the latent sites by name, each unconstrained."""
        return potential_energy(self.model, (data,), {}, sites)

    def prior_potential(self, z: Float[Array, " size"], data: Observations) -> Float[Array, ""]:
        """The part of the potential in which no reading has a share."""
        alone = handlers.block(self.model, hide=list(self.observed))
        return potential_energy(alone, (data,), {}, self.unravel(z))

    def constrain(self, z: Float[Array, " size"]) -> dict[str, Array]:
        """The latent sites in their supports."""
        return {
            name: dist.biject_to(self.supports[name])(value)
            for name, value in self.unravel(z).items()
        }

    def parameters(self, z: Float[Array, " size"], data: Observations) -> dict[str, Array]:
        """What the model is about: latent sites that are parameters, and what derives from them."""
        latent = self.constrain(z)
        fixed = handlers.substitute(self.model, data=latent)
        trace = handlers.trace(handlers.seed(fixed, jax.random.key(0))).get_trace(data)
        return self._parameters(trace)

    def _parameters(self, trace: dict) -> dict[str, Array]:
        names = (*(name for name in self.supports if name not in self.auxiliary), *self.derived)
        return {name: trace[name]["value"] for name in names}

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
        fixed = handlers.substitute(self.model, data=self.constrain(z))
        return self._read(handlers.trace(handlers.seed(fixed, key)).get_trace(data), key)

    def prior_draw(self, key: Array, data: Observations) -> Draw:
        """The same for one draw from the prior."""
        return self._read(handlers.trace(handlers.seed(self.model, key)).get_trace(data), key)

    def _read(self, trace: dict, key: Array) -> Draw:
        keys = dict(zip(self.observed, jax.random.split(key, len(self.observed)), strict=True))
        shapes = {name: trace[name]["value"].shape for name in self.observed}
        return Draw(
            parameters=self._parameters(trace),
            coordinates={name: trace[name]["value"] for name in self.auxiliary},
            center={n: jnp.broadcast_to(noise_free(trace, n), shapes[n]) for n in self.observed},
            log_likelihood={n: trace[n]["fn"].log_prob(trace[n]["value"]) for n in self.observed},
            # A population's members are not priors of anything: their spread says it all.
            log_prior={
                n: jnp.sum(trace[n]["fn"].log_prob(trace[n]["value"]))
                for n in self.supports
                if n not in self.auxiliary
            },
            predictive={name: trace[name]["fn"].sample(keys[name]) for name in self.observed},
        )

    def residuals(self, z: Float[Array, " size"], data: Observations) -> dict[str, Array]:
        """Reading minus noise-free reading of every observed site; 0 where not valid."""
        fixed = handlers.substitute(self.model, data=self.constrain(z))
        trace = handlers.trace(handlers.seed(fixed, jax.random.key(0))).get_trace(data)
        return {
            name: jnp.where(data.valid, trace[name]["value"] - noise_free(trace, name), 0.0)
            for name in self.observed
        }

    @functools.cached_property
    def potential_jit(self) -> Callable[[Array, Observations], Array]:
        """The potential; the model is told once, however many programs compute it."""
        return jax.jit(self.potential, inline=True)

    @functools.cached_property
    def value_and_gradient(self) -> JitOnce:
        """The potential with its gradient, compiled."""
        return JitOnce(jax.value_and_grad(self.potential_jit))

    @functools.cached_property
    def drawn_from_prior(self) -> Callable[[np.ndarray, int, Observations], Array]:
        """Vectors drawn from the prior, one for each of the first keys, compiled."""
        # The others are zero: how many are wanted is no part of what is compiled.

        def draw(keys: Array, count: int, data: Observations) -> Array:
            wrapped = jax.random.wrap_key_data(keys)
            nothing = jnp.zeros((len(keys), self.size), data.brightness.dtype)
            return jax.lax.fori_loop(
                0, count, lambda i, z: z.at[i].set(self.from_prior(wrapped[i], data)), nothing
            )

        return JitByShape(draw)

    @functools.cached_property
    def described(self) -> JitByShape:
        """Many draws described, compiled; keys as the numbers that they hold, (draw, ...)."""

        def describe(keys: Array, z: Array, data: Observations) -> Draw:
            wrapped = jax.random.wrap_key_data(keys)
            return jax.lax.map(lambda kz: self.describe(kz[0], kz[1], data), (wrapped, z))

        return JitByShape(describe)

    @functools.cached_property
    def parameters_of_chains(self) -> Callable[[Array, Observations], dict[str, Array]]:
        """The parameters of chains of draws, (chain, draw, size), compiled."""
        over_draws = jax.vmap(self.parameters, in_axes=(0, None))
        return JitByShape(jax.vmap(over_draws, in_axes=(0, None)))

    @functools.cached_property
    def slopes(self) -> Callable[[Array], dict[str, Array]]:
        """Derivatives of the latent sites in the vector, compiled."""
        return JitOnce(jax.jacfwd(self.constrain))


def compile_program(model: Model, data: Observations) -> Program:
    """Walk the model once, without computing anything, and note its sites."""
    sites: dict[str, dict] = {}

    def walk(data: Observations) -> None:
        trace = handlers.trace(handlers.seed(model, jax.random.key(0))).get_trace(data)
        sites.update(trace)

    jax.eval_shape(walk, data)
    sampled = {name: site for name, site in sites.items() if site["type"] == "sample"}
    latent = {name: site for name, site in sampled.items() if not site["is_observed"]}
    observed = tuple(n for n, site in sampled.items() if site["is_observed"] and n in data.readings)
    said = {f"{name}_mean" for name in observed}
    derived = {
        name: site
        for name, site in sites.items()
        if site["type"] == "deterministic" and name not in said
    }
    supports = {name: site["fn"].support for name, site in latent.items()}
    prototype = {
        name: jnp.zeros(jax.eval_shape(dist.biject_to(supports[name]).inv, site["value"]).shape)
        for name, site in latent.items()
    }
    flat, unravel = ravel_pytree(prototype)
    return Program(
        model=model,
        dims={name: _plate_names(site) for name, site in (sampled | derived).items()},
        plates={
            frame.name: frame.size
            for site in (sampled | derived).values()
            for frame in site["cond_indep_stack"]
        },
        events={name: tuple(site["fn"].event_shape) for name, site in sampled.items()}
        | {name: _own_shape(site) for name, site in derived.items()},
        supports=supports,
        auxiliary=tuple(name for name, site in latent.items() if is_auxiliary(site)),
        derived=tuple(derived),
        observed=observed,
        fixed=tuple(
            n for n, site in sampled.items() if site["is_observed"] and n not in data.readings
        ),
        families={name: family_of(site["fn"]) for name, site in latent.items()},
        size=flat.size,
        unravel=unravel,
    )


def is_auxiliary(site: Mapping[str, Any]) -> bool:
    """True for a latent site that says `infer={"auxiliary": True}`: a coordinate, no parameter."""
    return bool(site["infer"].get("auxiliary", False))


def noise_free(trace: dict, name: str) -> Array:
    """The noise-free reading: the site that says so, or the mean of the likelihood."""
    said = trace.get(f"{name}_mean")
    return said["value"] if said is not None else trace[name]["fn"].mean


def _own_shape(site: dict) -> tuple[int, ...]:
    """The axes of a deterministic site that no plate gave it."""
    repeated = math.prod(frame.size for frame in site["cond_indep_stack"])
    shape = tuple(site["value"].shape)
    if math.prod(shape) == repeated:
        return ()
    outer = max((-frame.dim for frame in site["cond_indep_stack"]), default=0)
    return shape[outer:]


def family_of(distribution: dist.Distribution) -> str:
    """The name of a distribution's class, without what plates have wrapped around it."""
    while isinstance(distribution, dist.Independent | dist.ExpandedDistribution):
        distribution = distribution.base_dist
    return type(distribution).__name__


def _plate_names(site: dict) -> tuple[str, ...]:
    plates = sorted(site["cond_indep_stack"], key=lambda frame: frame.dim)
    return tuple(frame.name for frame in plates)


# --- What a model says about itself when it is told once, without computing anything --------------


class ModelInfo(NamedTuple):
    """What was found."""

    priors: tuple[str, ...]
    declared: dict[str, str]
    fixed: dict[str, Any]


def inspect_model(
    model: Callable,
    data: Observations,
    scene: Scene,
    priors: PriorTable,
    links: Mapping[str, AbstractLink],
) -> ModelInfo:
    """Tell the story once, with abstract arrays, and refuse what cannot be fitted."""
    sites: dict[str, dict] = {}

    def tell(data: Observations) -> None:
        seeded = handlers.seed(model, jax.random.key(0))
        sites.update(
            handlers.trace(seeded).get_trace(data, scene=scene, priors=priors, links=links)
        )

    jax.eval_shape(tell, data)
    sampled = {name: site for name, site in sites.items() if site["type"] == "sample"}
    latent = {name: site for name, site in sampled.items() if not site["is_observed"]}
    for name, site in latent.items():
        _check_site(name, site["fn"])
    _check_handlers(model, tuple(sampled))
    _check_readings(sampled, data)
    return ModelInfo(
        priors=priors.read,
        declared={
            name: family_of(site["fn"])
            for name, site in latent.items()
            if name not in priors.read and not is_auxiliary(site)
        },
        fixed={
            name: _value_of(site["value"])
            for name, site in sampled.items()
            if site["is_observed"] and name not in data.readings
        },
    )


def _value_of(value: Any) -> Any:
    """What JSON can hold of a value that a model was given."""
    if isinstance(value, jax.core.Tracer):
        return "as the model computes it"
    return np.asarray(value).tolist()


def _check_handlers(model: Callable, sites: tuple[str, ...]) -> None:
    """Two handlers hold a value while one simulates, but not while one samples a posterior."""
    while isinstance(model, Messenger):
        held = [name for name in getattr(model, "data", None) or {} if name in sites]
        if isinstance(model, handlers.substitute | handlers.do) and held:
            raise FitError(
                f"{type(model).__name__} does not hold {held[0]} while the posterior is sampled",
                where="model",
                hint=f"use numpyro.handlers.condition(model, data={{{held[0]!r}: ...}})",
            )
        model = model.fn


def _check_site(name: str, distribution: dist.Distribution) -> None:
    where = f"model: sample({name!r})"
    if distribution.support.is_discrete:
        raise FitError(
            f"{family_of(distribution)} is discrete, and samplers follow gradients",
            where=where,
            hint="give a continuous distribution, or sum the discrete site out",
        )
    check_support(name, distribution, where)


def _check_readings(sampled: Mapping[str, dict], data: Observations) -> None:
    """A model that observes nothing, or draws a reading, has lost its data."""
    drawn = [n for n in data.readings if n in sampled and not sampled[n]["is_observed"]]
    if drawn:
        raise FitError(
            "it is drawn, not observed",
            where=f"model: sample({drawn[0]!r})",
            hint="give it obs=link.reading(data.readings[name]), as declare_readings does",
        )
    if not any(name in sampled for name in data.readings):
        raise FitError(
            "the model observes none of the readings",
            where="model",
            hint=f"end it with declare_readings(...), or observe {' or '.join(data.readings)}",
        )


# --- Parameters of many draws at once -------------------------------------------------------------


PIECE = 500


def parameters_of(program: Program, z: np.ndarray, data: Observations) -> dict[str, np.ndarray]:
    """What draws say of the parameters, and nothing of readings."""
    count = z.shape[1]
    pieces = []
    for begin in range(0, count, PIECE):
        index = np.minimum(np.arange(begin, begin + PIECE), count - 1)
        found = program.parameters_of_chains(jnp.asarray(z[:, index]), data)
        pieces.append({name: np.asarray(value) for name, value in found.items()})
    return {
        name: np.concatenate([piece[name] for piece in pieces], axis=1)[:, :count]
        for name in pieces[0]
    }
