"""Where identifiability is asked about: the heaviest mode of a capture's posterior."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array, Float
from numpyro import distributions as dist

from polar_bayes.diagnostics.parameters import Scalar, scalars
from polar_bayes.inference.ground import STARTS, CompiledPotential
from polar_bayes.inference.modes import Modes, ValueAndGradient
from polar_bayes.inference.program import Program, compile_program
from polar_bayes.inference.request import Request, resolve
from polar_bayes.inference.result import posterior_of
from polar_bayes.inference.search import find_modes, from_prior
from polar_bayes.inference.tracing import compiled
from polar_bayes.observation.data import Observations, observe
from polar_bayes.observation.links import AbstractLink
from polar_bayes.physics.scene import Scene
from polar_bayes.progress import Progress, silent

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
    request = resolve(
        capture, model, "laplace", scene, priors, links, largest_view_zenith, seed, "double"
    )
    data = observe(request.capture, largest_view_zenith=request.largest_view_zenith)
    program = compile_program(request.bind(request.scene), data)
    drawn = from_prior(program, jax.random.key(seed), PRIOR_DRAWS, data)
    return Question(request, data, program, drawn)


def find_peaks(
    question: Question, progress: Progress | None, potential: ValueAndGradient | None = None
) -> Modes:
    """The modes of the posterior, heaviest first."""
    potential = potential or CompiledPotential(question.program, question.data)
    return find_modes(potential, question.prior[:STARTS], progress or silent)


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
