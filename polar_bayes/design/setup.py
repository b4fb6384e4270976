"""Where identifiability is asked about: the heaviest mode of a capture's posterior."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int
from numpyro import distributions as dist

from polar_bayes.diagnostics.parameters import Scalar, scalars
from polar_bayes.errors import FitError
from polar_bayes.inference.compile import compiled
from polar_bayes.inference.files import check_fit
from polar_bayes.inference.initialization import STARTS, CompiledPotential
from polar_bayes.inference.optimize import Modes, ValueAndGradient, find_modes, from_prior
from polar_bayes.inference.program import Program, compile_program
from polar_bayes.inference.request import Request, resolve
from polar_bayes.inference.result import posterior_of
from polar_bayes.observation.data import Observations, observe
from polar_bayes.observation.links import AbstractLink
from polar_bayes.physics.scene import Scene
from polar_bayes.progress import Progress, no_progress

PRIOR_DRAWS = 500


class Question(NamedTuple):
    """A model and a capture, ready to be asked."""

    request: Request
    data: Observations
    program: Program
    prior: np.ndarray


def pose(
    capture: xr.Dataset,
    model: str | Callable,
    scene: str | Scene | None,
    priors: Mapping[str, dist.Distribution] | None,
    links: AbstractLink | Mapping[str, AbstractLink] | None,
    largest_view_zenith: float | None,
    seed: int,
) -> Question:
    """Check what a caller asked for and compile it; to be called in double precision."""
    request = resolve(capture, model, scene, priors, links, largest_view_zenith, seed, "double")
    data = observe(request.capture, largest_view_zenith=request.largest_view_zenith)
    program = compile_program(request.bind(request.scene), data)
    drawn = from_prior(program, jax.random.key(seed), PRIOR_DRAWS, data)
    return Question(request, data, program, drawn)


def find_peaks(
    question: Question, progress: Progress | None, potential: ValueAndGradient | None = None
) -> Modes:
    """The modes of the posterior, heaviest first."""
    potential = potential or CompiledPotential(question.program, question.data)
    return find_modes(potential, question.prior[:STARTS], progress or no_progress)


def flat_parameters(
    program: Program, z: Float[Array, " size"], data: Observations
) -> Float[Array, " parameter"]:
    """All parameters in one row, by name."""
    told = program.parameters(z, data)
    return jnp.concatenate([jnp.ravel(told[name]) for name in sorted(told)])


class Labels(NamedTuple):
    """The scalar parameters as tables list them."""

    scalars: list[Scalar]
    rows: list[int]

    @property
    def names(self) -> list[str]:
        """Such as `refractive_index[550]`."""
        return [scalar.label for scalar in self.scalars]

    @property
    def prior_sd(self) -> np.ndarray:
        """Of the draws from the prior, (parameter,)."""
        return np.array([scalar.draws.std() for scalar in self.scalars])


def label_parameters(question: Question) -> Labels:
    """Name every scalar parameter of a model, with its prior."""
    program, data = question.program, question.data
    told = compiled(jax.vmap(lambda z: program.parameters(z, data)))(question.prior)
    draws = {name: np.asarray(x)[None] for name, x in told.items()}
    found = scalars(with_labels(posterior_of(program, draws), question.request.capture))
    begins, begin = {}, 0
    for name in sorted(draws):
        begins[name], begin = begin, begin + int(np.prod(draws[name].shape[2:], initial=1))
    rows, seen = [], dict.fromkeys(draws, 0)
    for scalar in found:  # the entries of one variable follow each other in row order
        rows.append(begins[scalar.name] + seen[scalar.name])
        seen[scalar.name] += 1
    return Labels(found, rows)


def with_labels(group: xr.Dataset, capture: xr.Dataset) -> xr.Dataset:
    """A group of draws with the capture's own labels of its axes, such as wavelengths."""
    known = {str(dim): capture[dim] for dim in group.dims if dim in capture.coords}
    return group.assign_coords(known)


# --- Over which values of the parameters a design is averaged: draws of what the posterior allows


FOLD = 7
"""Sets the key of these draws apart from that of the prior's."""


def draws_at(modes: Modes, count: int, seed: int) -> Float[np.ndarray, "draw size"]:
    """Draws of the normal approximation at the heaviest mode."""
    key = jax.random.fold_in(jax.random.key(seed), FOLD)
    noise = np.asarray(jax.random.normal(key, (count, modes.z.shape[1])))
    return modes.z[0] + noise @ np.linalg.cholesky(modes.covariance[0]).T


def draws_of(question: Question, result: xr.DataTree, count: int) -> Float[np.ndarray, "draw size"]:
    """Draws of a fit, evenly spaced, as unconstrained vectors."""
    check_fit(result, "next_views: result")
    program = question.program
    whole = program.constrain(jnp.zeros(program.size))
    groups = [result.get(name) for name in ("posterior", "unconstrained_posterior")]
    sites = {}
    for name in program.supports:
        group = next((g for g in groups if g is not None and name in g.data_vars), None)
        size = int(np.size(whole[name]))
        if group is None or group[name].size % size or group[name].ndim < 2:
            raise FitError(
                f"it has no draws of {name} as this model has it",
                where="next_views: result",
                hint="give a fit of the same capture, model, scene and links",
            )
        values = group[name].transpose("chain", "draw", ...).to_numpy()
        sites[name] = values.reshape(-1, *whole[name].shape)
    number = min(len(x) for x in sites.values())
    finite = np.all(
        [np.isfinite(x.reshape(number, -1)).all(axis=1) for x in sites.values()], axis=0
    )
    kept = np.flatnonzero(finite)
    if kept.size == 0:
        raise FitError(
            "none of its draws is finite",
            where="next_views: result",
            hint="give a fit that succeeded",
        )
    kept = kept[np.linspace(0, kept.size - 1, min(count, kept.size)).round().astype(int)]

    return unconstrain(program, {name: x[kept] for name, x in sites.items()})


def unconstrain(
    program: Program, values: Mapping[str, Float[np.ndarray, "draw ..."]]
) -> Float[np.ndarray, "draw size"]:
    """Draws of all latent sites as unconstrained vectors."""

    def free(values: dict[str, Array]) -> Array:
        moved = {n: dist.biject_to(s).inv(values[n]) for n, s in program.supports.items()}
        return ravel_pytree(moved)[0]

    sites = {name: jnp.asarray(values[name]) for name in program.supports}
    return np.asarray(compiled(jax.vmap(free))(sites))


def embed(program: Program, wide: Program) -> Int[np.ndarray, " size"]:
    """Where the coordinates of a program stand in one with more readings."""
    ours, theirs = (
        {n: np.asarray(x) for n, x in one.unravel(jnp.arange(float(one.size))).items()}
        for one in (program, wide)
    )
    places = np.zeros(program.size, int)
    for name, position in ours.items():
        if name not in theirs or theirs[name].shape != position.shape:
            raise FitError(
                f"every view has its own {name}, which views not yet taken cannot tell",
                where="next_views: model",
                hint="use a model whose parameters do not belong to single views",
            )
        places[position.astype(int).ravel()] = theirs[name].astype(int).ravel()
    return places
