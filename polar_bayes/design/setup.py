"""The set-up of a design problem: model, capture, posterior modes and coordinate labels."""

import dataclasses
import functools
import json
import math
from collections.abc import Mapping

import jax
import numpy as np
import xarray as xr
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from polar_bayes.diagnostics.parameters import Scalar, label_scalars
from polar_bayes.errors import FitError
from polar_bayes.inference.compiled_model import CompiledModel
from polar_bayes.inference.files import check_fit
from polar_bayes.inference.initialization import modes_from_prior
from polar_bayes.inference.problem import compile_request
from polar_bayes.inference.program import PRIOR_DRAWS, Program, from_prior, places
from polar_bayes.inference.request import Request
from polar_bayes.inference.result import PROVENANCE
from polar_bayes.numerics.compile import compiled
from polar_bayes.numerics.optimize import Modes, NumpyPotential, ValueAndGradient
from polar_bayes.observation.data import Observations
from polar_bayes.progress import Progress, no_progress


@dataclasses.dataclass(frozen=True, eq=False)
class DesignProblem:
    """A model and a capture, compiled, with unconstrained draws from the prior (draw, size)."""

    request: Request
    data: Observations
    compiled_model: CompiledModel
    prior: np.ndarray

    @property
    def program(self) -> Program:
        """The model as functions of one unconstrained vector."""
        return self.compiled_model.program

    @functools.cached_property
    def drawn(self) -> dict[str, Array]:
        """Parameters of the draws from the prior, by name, (1, draw, ...)."""
        return self.program.parameters_of_chains(self.prior[None], self.data)

    @functools.cached_property
    def scalars(self) -> list[Scalar]:
        """The scalar parameters in the order of tables, with their draws from the prior."""
        return label_scalars(self.program, self.request.capture, self.drawn)

    @property
    def names(self) -> list[str]:
        """Such as `refractive_index[550]`."""
        return [scalar.label for scalar in self.scalars]

    @property
    def prior_sd(self) -> np.ndarray:
        """Of the draws from the prior, (parameter,)."""
        return np.array([scalar.draws.std() for scalar in self.scalars])

    @functools.cached_property
    def rows(self) -> list[int]:
        """The index of each scalar in the vector of all parameters."""
        numbers = places({name: x.shape[2:] for name, x in self.drawn.items()})
        positions = {name: x[None, None] for name, x in numbers.items()}
        found = label_scalars(self.program, self.request.capture, positions)
        return [int(scalar.draws.item()) for scalar in found]


def provenance_attrs(request: Request, **more: object) -> dict[str, str]:
    """Return the attribute that holds capture, model and settings of a result as JSON."""
    capture = str(request.capture.attrs.get("name", "capture"))
    found = {**request.describe(), "capture": capture, **more}
    return {PROVENANCE: json.dumps(found, sort_keys=True)}


def make_design_problem(request: Request) -> DesignProblem:
    """Compile the model of a request, or find it in the cache; x64 must be enabled."""
    compiled_model, data = compile_request(request)
    prior = from_prior(compiled_model.program, jax.random.key(request.seed), PRIOR_DRAWS, data)
    return DesignProblem(request, data, compiled_model, prior)


def posterior_modes(
    problem: DesignProblem, progress: Progress | None, potential: ValueAndGradient | None = None
) -> Modes:
    """Return the joint posterior modes, the one of largest weight first."""
    potential = potential or NumpyPotential(
        problem.program.value_and_gradient, problem.data, problem.data.brightness.dtype
    )
    return modes_from_prior(potential, problem.prior, progress or no_progress)


# --- Names of parameters and coordinates ----------------------------------------------------------


def parameter_vector(
    program: Program, z: Float[Array, " size"], data: Observations
) -> Float[Array, " parameter"]:
    """Return all parameters as one vector, in alphabetical order."""
    return ravel_pytree(program.parameters(z, data))[0]


# --- Draws of the posterior, over which the criterion of a design is averaged ---------------------


def posterior_draws(
    problem: DesignProblem, result: xr.DataTree | None, count: int, progress: Progress | None
) -> Float[np.ndarray, "draw size"]:
    """Return draws of a fit, or of the Laplace approximation at the heaviest mode."""
    if result is not None:
        return _fit_draws(problem, result, count)
    modes = posterior_modes(problem, progress)
    # Another key than that of the draws from the prior.
    key = jax.random.fold_in(jax.random.key(problem.request.seed), 7)
    noise = np.asarray(jax.random.normal(key, (count, modes.z.shape[1])))
    return modes.z[0] + noise @ np.linalg.cholesky(modes.covariance[0]).T


def _fit_draws(
    problem: DesignProblem, result: xr.DataTree, count: int
) -> Float[np.ndarray, "draw size"]:
    """Return finite, evenly spaced draws of a fit as unconstrained vectors."""
    where, program = "next_views: result", problem.program
    check_fit(result, where)
    template = program.latent_shapes
    groups = [result.get(name) for name in ("posterior", "unconstrained_posterior")]
    sites = {}
    for name in program.supports:
        group = next((g for g in groups if g is not None and name in g.data_vars), None)
        shape = template[name].shape
        if group is None or group[name].size % math.prod(shape) or group[name].ndim < 2:
            hint = "give a fit of the same capture, model, scene and links"
            what = f"it has no draws of {name} as this model has it"
            raise FitError(what, where=where, hint=hint)
        values = group[name].transpose("chain", "draw", ...).to_numpy()
        sites[name] = values.reshape(-1, *shape)
    number = min(len(x) for x in sites.values())
    finite = [np.isfinite(x.reshape(number, -1)).all(axis=1) for x in sites.values()]
    usable = np.flatnonzero(np.all(finite, axis=0))
    if usable.size == 0:
        raise FitError("none of its draws is finite", where=where, hint="give a fit that succeeded")
    spaced = np.linspace(0, usable.size - 1, min(count, usable.size)).round().astype(int)
    return unconstrain(program, {name: x[usable[spaced]] for name, x in sites.items()})


def unconstrain(
    program: Program, values: Mapping[str, Float[np.ndarray, "draw ..."]]
) -> Float[np.ndarray, "draw size"]:
    """Convert draws of all latent sites to unconstrained vectors."""
    sites = {name: values[name] for name in program.supports}
    return np.asarray(compiled(jax.vmap(program.unconstrain))(sites))


def coordinate_indices(program: Program, extended: Program) -> Int[np.ndarray, " size"]:
    """Map a program's coordinates to those of the same model with more views."""
    theirs = extended.positions
    indices = np.zeros(program.size, int)
    for name, position in program.positions.items():
        if name not in theirs or theirs[name].shape != position.shape:
            what = f"{name} belongs to single views, and no reading of a new view determines it yet"
            hint = "use a model whose parameters do not belong to single views"
            raise FitError(what, where="next_views: model", hint=hint)
        indices[position] = theirs[name]
    return indices
