"""A model and its data as pure functions of one flat, unconstrained vector.

Methods use sites and shapes, never a parameter by name. The data are an argument of every function,
so that fits to captures of one layout share their compiled programs.
"""

import abc
import contextlib
import dataclasses
import functools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, override

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float
from numpyro import distributions as dist
from numpyro import handlers
from numpyro.infer.util import compute_log_probs
from numpyro.primitives import Messenger

from polar_bayes.errors import FitError
from polar_bayes.inference.model_parts import ModelParts
from polar_bayes.numerics.batches import AnyArray, map_batches
from polar_bayes.numerics.compile import JitOnce, compiled
from polar_bayes.observation.data import Observations
from polar_bayes.priors import PriorTable, check_support

Model = Callable[[Observations], None]

BLOCK = 500
"""Number of draws that one call describes or constrains; the last block is padded."""

THREADS = 2
"""Number of threads that run such calls."""

Values = Mapping[str, AnyArray]


Site = dict[str, Any]
Sites = dict[str, Site]


class Draw(NamedTuple):
    """Values of one posterior draw by site name, or of a stack of draws as NumPy arrays."""

    parameters: Values
    coordinates: Values
    center: Values
    log_likelihood: Values
    log_prior: Values
    predictive: Values
    log_density: Array | np.ndarray


class AbstractDensity[Given](abc.ABC):
    """A log density of flat vectors, with what is compiled of it for all captures of a layout."""

    @property
    def key(self) -> str:
        """A text that tells it from every other density, in any process; empty where none does."""
        return ""

    def once(self, name: str, function: Callable) -> JitOnce:
        """A function of this density, compiled; no other function of it has that name."""
        return JitOnce(function, self.key and f"{self.key} {name}")

    @abc.abstractmethod
    def potential(self, z: Float[Array, " size"], given: Given) -> Float[Array, ""]:
        """Minus the log density of a vector, up to a constant."""

    @functools.cached_property
    def potential_jit(self) -> Callable[[Array, Given], Array]:
        """The potential; the model is traced once, however many programs compute it."""
        return jax.jit(self.potential, inline=True)

    @functools.cached_property
    def value_and_gradient(self) -> JitOnce:
        """The potential with its gradient, compiled."""
        return self.once("value_and_gradient", jax.value_and_grad(self.potential_jit))


@dataclasses.dataclass(frozen=True, eq=False)
class Program(AbstractDensity[Observations]):
    """A model conditioned on data of one layout; `prior` is the model without its readings."""

    model: Model
    prior: Model
    dims: Mapping[str, tuple[str, ...]]
    plates: Mapping[str, int]
    events: Mapping[str, tuple[int, ...]]
    supports: Mapping[str, dist.constraints.Constraint]
    families: Mapping[str, str]
    auxiliary: tuple[str, ...]
    summed: tuple[str, ...]
    derived: tuple[str, ...]
    observed: tuple[str, ...]
    size: int
    unravel: Callable[[Float[Array, " size"]], dict[str, Array]]
    key: str = ""

    @override
    def potential(self, z: Float[Array, " size"], data: Observations) -> Float[Array, ""]:
        return self.potential_at(self.unravel(z), data)

    def potential_at(self, sites: dict[str, Array], data: Observations) -> Float[Array, ""]:
        """Minus the log posterior density of the unconstrained latent sites by name."""
        return -_total(self._log_terms(self.model, sites, data)[0], data)

    def prior_potential(self, z: Float[Array, " size"], data: Observations) -> Float[Array, ""]:
        """Return the potential without the likelihood."""
        return -_total(self._log_terms(self.prior, self.unravel(z), data)[0], data)

    def constrain(self, z: Float[Array, " size"]) -> dict[str, Array]:
        """Return the latent sites in their supports."""
        return self._constrain(self.unravel(z))

    def unconstrain(self, values: Mapping[str, Array]) -> Float[Array, " size"]:
        """Return the vector of latent sites in their supports: the inverse of `constrain`."""
        supports = self.supports.items()
        return ravel_pytree({n: dist.biject_to(s).inv(values[n]) for n, s in supports})[0]

    @functools.cached_property
    def positions(self) -> dict[str, np.ndarray]:
        """Indices of the unconstrained coordinates, by site."""
        sites = jax.eval_shape(self.unravel, self._vector)
        return places({name: like.shape for name, like in sites.items()})

    @property
    def _vector(self) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((self.size,), jnp.float32)

    def _constrain(self, sites: dict[str, Array]) -> dict[str, Array]:
        return {name: dist.biject_to(self.supports[name])(x) for name, x in sites.items()}

    def log_terms(
        self, z: Float[Array, " size"], data: Observations
    ) -> tuple[dict[str, Array], Sites]:
        """Return the log density by site, with log volumes, and the trace of the model.

        The coordinate of what is held has a standard normal density, and its prior none.
        """
        return self._log_terms(self.model, self.unravel(z), data)

    def _log_terms(
        self, model: Model, sites: dict[str, Array], data: Observations
    ) -> tuple[dict[str, Array], Sites]:
        free_values = self._constrain(sites)
        values = _with_held(free_values, data)
        log_probs, trace = compute_log_probs(model, (data,), {}, values, sum_log_prob=False)
        terms = {name: jnp.sum(own) for name, own in log_probs.items() if name not in sites}
        for name, x in sites.items():
            bijection = dist.biject_to(self.supports[name])
            own = [log_probs[name], bijection.log_abs_det_jacobian(x, free_values[name])]
            if name in data.held:
                free = jnp.isnan(data.held[name])
                own = [jnp.where(_all_of(free, term), term, 0.0) for term in own]
                own.append(jnp.where(_all_of(free, x), 0.0, -0.5 * x**2))
            terms[name] = sum(map(jnp.sum, own), jnp.zeros((), x.dtype))
        return terms, trace

    def free(self, data: Observations) -> Observations:
        """Return data with NaN for all parameters that may be held; `hold` shares its programs."""
        dtype = data.brightness.dtype
        held = {n: np.full(x.shape, np.nan, dtype) for n, x in self.latent_shapes.items()}
        return dataclasses.replace(data, held=jax.device_put(held))

    @functools.cached_property
    def latent_shapes(self) -> dict[str, jax.ShapeDtypeStruct]:
        """Shapes of the latent sites in their supports."""
        return jax.eval_shape(self.constrain, self._vector)

    def trace(self, z: Float[Array, " size"], data: Observations) -> dict[str, dict]:
        """Return the sites of the model at an unconstrained vector."""
        return self.trace_at(self.unravel(z), data)

    def trace_at(self, sites: dict[str, Array], data: Observations) -> dict[str, dict]:
        """Return the sites of the model at unconstrained latent sites by name."""
        return self._trace(self.model, sites, data)

    def _trace(self, model: Model, sites: dict[str, Array], data: Observations) -> dict[str, dict]:
        values = _with_held(self._constrain(sites), data)
        return _trace(handlers.substitute(model, data=values), jax.random.key(0), data)

    def parameters(self, z: Float[Array, " size"], data: Observations) -> dict[str, Array]:
        """Return latent sites that are not auxiliary, and what derives from them."""
        return self._parameters(self._trace(self.prior, self.unravel(z), data))

    def parameters_and_potential(
        self, z: Float[Array, " size"], data: Observations
    ) -> tuple[dict[str, Array], Float[Array, ""]]:
        """Return parameters and potential from a single trace of the model."""
        terms, trace = self.log_terms(z, data)
        return self._parameters(trace), -_total(terms, data)

    def _parameters(self, trace: dict) -> dict[str, Array]:
        names = (*(name for name in self.supports if name not in self.auxiliary), *self.derived)
        return {name: trace[name]["value"] for name in names}

    def from_prior(self, key: Array, data: Observations) -> Float[Array, " size"]:
        """Draw an unconstrained vector from the prior."""
        trace = _trace(self.prior, key, data)
        return self.unconstrain({name: trace[name]["value"] for name in self.supports})

    def describe(
        self,
        key: Array,
        z: Float[Array, " size"],
        data: Observations,
        predicts: Array | bool = True,
    ) -> Draw:
        """Return parameters, densities and readings of a draw; zeros if readings are not wanted."""
        seeded = handlers.seed(self.model, key)
        terms, trace = self._log_terms(seeded, self.unravel(z), data)
        keys = dict(zip(self.observed, jax.random.split(key, len(self.observed)), strict=True))
        readings = {name: trace[name] for name in self.observed}
        return Draw(
            parameters=self._parameters(trace),
            coordinates={name: trace[name]["value"] for name in self.auxiliary},
            center={
                name: jnp.broadcast_to(noise_free(trace, name), site["value"].shape)
                for name, site in readings.items()
            },
            log_likelihood={n: site["fn"].log_prob(site["value"]) for n, site in readings.items()},
            # Auxiliary sites have no prior of their own: their population is the prior.
            log_prior={
                n: jnp.sum(trace[n]["fn"].log_prob(trace[n]["value"]))
                for n in self.supports
                if n not in self.auxiliary
            },
            predictive={
                name: jax.lax.cond(
                    predicts,
                    lambda key, site=site: site["fn"].sample(key),
                    lambda _, site=site: jnp.zeros_like(site["value"]),
                    keys[name],
                )
                for name, site in readings.items()
            },
            log_density=_total(terms, data),
        )

    def residuals(self, z: Float[Array, " size"], data: Observations) -> dict[str, Array]:
        """Return readings minus noise-free readings of every observed site; 0 if not fitted."""
        trace = self.trace(z, data)
        return {
            name: jnp.where(data.fitted(name), trace[name]["value"] - noise_free(trace, name), 0.0)
            for name in self.observed
        }

    @functools.cached_property
    def drawn_from_prior(self) -> JitOnce:
        """Compiled `from_prior` for the first `count` of many keys."""
        # The others are zero, so that one program serves any count.

        def draw(keys: Array, count: int, data: Observations) -> Array:
            wrapped = jax.random.wrap_key_data(keys)
            zeros = jnp.zeros((len(keys), self.size), data.brightness.dtype)
            return jax.lax.fori_loop(
                0, count, lambda i, z: z.at[i].set(self.from_prior(wrapped[i], data)), zeros
            )

        return self.once("drawn_from_prior", draw)

    @functools.cached_property
    def described(self) -> JitOnce:
        """Compiled `describe` of many draws; keys are given as their data, (draw, ...)."""

        def describe(keys: Array, predicts: Array, z: Array, data: Observations) -> Draw:
            rows = jax.random.wrap_key_data(keys), predicts, z
            return jax.lax.map(lambda row: self.describe(row[0], row[2], data, row[1]), rows)

        return self.once("described", describe)

    def begin_described(self, data: Observations) -> None:
        """Begin to compile the description of a block of draws."""
        self.described.begin(
            _keys_like(BLOCK),
            jax.ShapeDtypeStruct((BLOCK,), bool),
            jax.ShapeDtypeStruct((BLOCK, self.size), data.brightness.dtype),
            data,
        )

    def log_density(self, z: np.ndarray, data: Observations) -> np.ndarray:
        """Return log posterior densities of vectors (draw, size); minus infinity for NaN."""
        like = _keys_like(len(z))
        rows = np.zeros(like.shape, like.dtype), np.zeros(len(z), bool), z
        found = in_blocks(self.described, rows, data)
        return np.where(np.isnan(found.log_density), -np.inf, found.log_density)

    @functools.cached_property
    def evaluated(self) -> JitOnce:
        """Compiled potentials and parameters of vectors, (row, size)."""

        def evaluate(z: Array, data: Observations) -> tuple[Array, dict[str, Array]]:
            return jax.lax.map(lambda z: self.parameters_and_potential(z, data)[::-1], z)

        return self.once("evaluated", evaluate)

    @functools.cached_property
    def parameters_of_chains(self) -> JitOnce:
        """Compiled `parameters` of chains of draws, (chain, draw, size)."""
        over_draws = jax.vmap(self.parameters, in_axes=(0, None))
        return self.once("parameters_of_chains", jax.vmap(over_draws, in_axes=(0, None)))

    @functools.cached_property
    def slopes(self) -> Callable[[Array, Observations], dict[str, Array]]:
        """Jacobian of `parameters`, compiled."""
        return self.once("slopes", jax.jacfwd(self.parameters))


def _total(terms: Mapping[str, Array], data: Observations) -> Array:
    return sum(terms.values(), jnp.zeros((), data.brightness.dtype))


def _with_held(values: dict[str, Array], data: Observations) -> dict[str, Array]:
    """Replace held latent sites by their values."""
    held = {n: jnp.where(jnp.isnan(x), values[n], x) for n, x in data.held.items()}
    return values | held


def _all_of(mask: Array, like: Array) -> Array:
    """Reduce a mask of a site to the shape of its log density, without event axes."""
    if mask.shape == like.shape:
        return mask
    return jnp.all(mask, axis=tuple(range(like.ndim, mask.ndim)))


def in_blocks(function: JitOnce, rows: tuple[np.ndarray, ...], given: Any) -> Any:
    """Call a function that is compiled for a block of rows on any number of rows."""
    double, device = rows[-1].dtype == np.float64, jax.config.jax_default_device

    def of_block(index: np.ndarray) -> Any:
        with jax.enable_x64(double), jax.default_device(device):  # no thread inherits them
            return function(*(x[index] for x in rows), given)

    def over[T](run: Callable[[np.ndarray], T], blocks: Iterator[np.ndarray]) -> Iterator[T]:
        yield run(next(blocks))  # compiled before the threads start
        with ThreadPoolExecutor(THREADS) as pool:
            yield from pool.map(run, blocks)

    return map_batches(of_block, len(rows[0]), BLOCK, over)


def raveled(like: dict[str, jax.ShapeDtypeStruct]) -> tuple[jax.ShapeDtypeStruct, Callable]:
    """The vector of sites of these shapes, and the function that takes it apart."""
    functions: list[Callable] = []

    def flat(sites: dict[str, Array]) -> Array:
        vector, unravel = ravel_pytree({name: x.astype(float) for name, x in sites.items()})
        functions.append(unravel)
        return vector

    return jax.eval_shape(flat, like), functions[0]


class _EndedError(BaseException):
    """Ends a model; a base exception, so that no handler in the model catches it."""


class _UpTo(Messenger):
    """Ends a model at the last of some sites, so that later sites are not computed."""

    def __init__(self, sites: Iterable[str]) -> None:
        super().__init__()
        self._left = set(sites)

    @override
    def postprocess_message(self, msg: Site) -> None:
        self._left.discard(msg.get("name", ""))
        if not self._left:
            raise _EndedError


def _run_up_to(data: Observations, model: Model, sites: frozenset[str]) -> None:
    """Run a model up to the last of some sites."""
    with contextlib.suppress(_EndedError), _UpTo(sites):
        model(data)


def compile_program(model: Model, data: Observations) -> Program:
    """Trace the model once with abstract arrays, and record its sites."""
    sites, sampled, latent = _abstract_sites(model, data)
    observed = tuple(n for n, site in sampled.items() if site["is_observed"] and n in data.readings)
    of_readings = {*observed, *(f"{reading}_mean" for reading in observed)}
    derived = {
        name: site
        for name, site in sites.items()
        if site["type"] == "deterministic" and name not in of_readings
    }
    supports = {name: site["fn"].support for name, site in latent.items()}
    prototype = {
        name: jax.eval_shape(dist.biject_to(supports[name]).inv, site["value"])
        for name, site in latent.items()
    }
    flat, unravel = raveled(prototype)
    plates = {name: site["cond_indep_stack"] for name, site in (sampled | derived).items()}
    return Program(
        model=model,
        prior=functools.partial(
            _run_up_to, model=model, sites=frozenset({*sampled, *derived} - of_readings)
        ),
        dims={
            name: tuple(frame.name for frame in sorted(frames, key=lambda frame: frame.dim))
            for name, frames in plates.items()
        },
        plates={frame.name: frame.size for frames in plates.values() for frame in frames},
        events={name: tuple(site["fn"].event_shape) for name, site in sampled.items()}
        | {name: _event_shape(site) for name, site in derived.items()},
        supports=supports,
        families={name: family_of(site["fn"]) for name, site in latent.items()},
        auxiliary=tuple(name for name, site in latent.items() if is_auxiliary(site)),
        summed=tuple(name for name, site in latent.items() if _is_summed(site)),
        derived=tuple(derived),
        observed=observed,
        size=flat.size,
        unravel=unravel,
    )


def places(shapes: Mapping[str, tuple[int, ...]]) -> dict[str, np.ndarray]:
    """Return indices of arrays of these shapes in the vector of `ravel_pytree`, by name."""
    found, begin = {}, 0
    for name in sorted(shapes):
        end = begin + math.prod(shapes[name])
        found[name], begin = np.arange(begin, end).reshape(shapes[name]), end
    return found


def is_auxiliary(site: Site) -> bool:
    """Return True for a latent site with `infer={"auxiliary": True}`: no parameter."""
    return bool(site["infer"].get("auxiliary", False))


def _is_summed(site: Site) -> bool:
    """Return True for a scalar with `infer={"summed": True}`: readings determine a sum."""
    return bool(site["infer"].get("summed", False)) and not np.shape(site["value"])


def noise_free(trace: dict, name: str) -> Array:
    """Return the noise-free reading: site `<name>_mean`, or the mean of the likelihood."""
    site = trace.get(f"{name}_mean")
    return site["value"] if site is not None else trace[name]["fn"].mean


def family_of(distribution: dist.Distribution) -> str:
    """Return the name of a distribution's class, without the wrappers of plates."""
    while isinstance(distribution, dist.Independent | dist.ExpandedDistribution):
        distribution = distribution.base_dist
    return type(distribution).__name__


def _trace(model: Callable, key: Array, data: Observations, **arguments: object) -> Sites:
    return handlers.trace(handlers.seed(model, key)).get_trace(data, **arguments)


def _abstract_sites(
    model: Callable, data: Observations, **arguments: object
) -> tuple[Sites, Sites, Sites]:
    """Return all sites, the sampled ones, and the latent ones among these, abstractly."""
    sites: Sites = {}
    jax.eval_shape(
        lambda data: sites.update(_trace(model, jax.random.key(0), data, **arguments)), data
    )
    sampled = {name: site for name, site in sites.items() if site["type"] == "sample"}
    return sites, sampled, {n: site for n, site in sampled.items() if not site["is_observed"]}


def _event_shape(site: dict) -> tuple[int, ...]:
    """Return the axes of a deterministic site that no plate added."""
    repeated = math.prod(frame.size for frame in site["cond_indep_stack"])
    shape = tuple(site["value"].shape)
    if math.prod(shape) == repeated:
        return ()
    outer = max((-frame.dim for frame in site["cond_indep_stack"]), default=0)
    return shape[outer:]


# --- Checks of a model before it is fitted --------------------------------------------------------


class ModelInfo(NamedTuple):
    """Priors that a model reads, priors that it declares, and sites that it fixes."""

    priors: tuple[str, ...]
    declared: dict[str, str]
    fixed: dict[str, object]


def inspect_model(parts: ModelParts, data: Observations) -> ModelInfo:
    """Trace a model once with abstract arrays; a `FitError` where it cannot be fitted."""
    priors = PriorTable(parts.priors)
    given = {"scene": parts.scene, "priors": priors, "links": parts.links}
    _, sampled, latent = _abstract_sites(parts.model, data, **given)
    for name, site in latent.items():
        _check_site(name, site["fn"])
    _check_handlers(parts.model, tuple(sampled))
    _check_readings(sampled, data)
    return ModelInfo(
        priors=priors.read,
        declared={
            name: family_of(site["fn"])
            for name, site in latent.items()
            if name not in priors.read and not is_auxiliary(site)
        },
        fixed={
            name: "as the model computes it"
            if isinstance(site["value"], jax.core.Tracer)
            else np.asarray(site["value"]).tolist()
            for name, site in sampled.items()
            if site["is_observed"] and name not in data.readings
        },
    )


def _check_handlers(model: Callable, sites: tuple[str, ...]) -> None:
    """Refuse handlers that fix values in simulations but not in fits, or that name no site."""
    while isinstance(model, Messenger):
        named = tuple(getattr(model, "data", None) or {})
        unknown = [name for name in named if name not in sites]
        if isinstance(model, handlers.condition) and unknown:
            what, hint = f"it has no site {unknown[0]}", f"hold one of {', '.join(sites)}"
            raise FitError(what, where="model", hint=hint)
        held = [name for name in named if name in sites]
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
    """Refuse a model that observes no reading, or that draws one."""
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


KEYS = 1 << 15
"""Number of keys that are made at once; each depends on its index alone."""


def keys_of_draws(key: Array, draws: int) -> np.ndarray:
    """Return a key for each draw, as numbers."""
    return np.asarray(jax.random.key_data(jax.random.split(key, KEYS * -(-draws // KEYS))))[:draws]


def split_key(key: Array) -> tuple[Array, Array]:
    """Split a key in two by one compiled program."""
    return compiled(_split)(key)


def _split(key: Array) -> tuple[Array, Array]:
    one, other = jax.random.split(key)
    return one, other


def first_key() -> Array:
    """Return a key of zeros without compiling anything."""
    like = _keys_like(1)
    return jax.random.wrap_key_data(jax.device_put(np.zeros(like.shape[1:], like.dtype)))


def _keys_like(draws: int) -> jax.ShapeDtypeStruct:
    """Return the shape and type of `keys_of_draws`."""
    return jax.eval_shape(lambda: jax.random.key_data(jax.random.split(jax.random.key(0), draws)))


def begin_from_prior(program: Program, data: Observations) -> None:
    """Begin to compile what `from_prior` needs."""
    program.drawn_from_prior.begin(_keys_like(BLOCK), BLOCK, data)


PRIOR_DRAWS = 500
"""Draws from the prior that describe a model."""


def from_prior(program: Program, key: Array, draws: int, data: Observations) -> np.ndarray:
    """Draw unconstrained vectors from the prior; one compiled program serves any number."""
    keys = keys_of_draws(key, draws)

    def drawn(index: np.ndarray) -> np.ndarray:
        wanted = min(BLOCK, draws - index[0])
        return np.asarray(program.drawn_from_prior(keys[index], wanted, data))

    return map_batches(drawn, draws, BLOCK)
