"""Over which values of the parameters a design is averaged: draws of what the posterior allows."""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int
from numpyro import distributions as dist

from polar_bayes.errors import FitError
from polar_bayes.identifiability.peak import Question
from polar_bayes.inference.files import check_fit
from polar_bayes.inference.modes import Modes
from polar_bayes.inference.program import Program
from polar_bayes.inference.tracing import compiled

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
                mend="give a fit of the same capture, model, scene and links",
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
            mend="give a fit that succeeded",
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
                mend="use a model whose parameters do not belong to single views",
            )
        places[position.astype(int).ravel()] = theirs[name].astype(int).ravel()
    return places
