"""The public verb: which parameters, and which combinations of them, does a capture determine?"""

import json
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
import xarray as xr
from numpyro import distributions as dist

from polar_bayes.diagnostics.parameters import Scalar, scalars
from polar_bayes.identifiability.fisher import expected_information, prior_precision
from polar_bayes.inference.ground import STARTS, compiled_potential
from polar_bayes.inference.program import Program, compile_program
from polar_bayes.inference.request import Request, resolve
from polar_bayes.inference.result import PROVENANCE, posterior_of
from polar_bayes.inference.search import Progress, find_modes, from_prior
from polar_bayes.observation.data import Observations, observe
from polar_bayes.observation.links import AbstractLink
from polar_bayes.physics.notation import notation
from polar_bayes.physics.scene import Scene

PRIOR_DRAWS = 500


class Expected(NamedTuple):
    """Information and covariance of the unconstrained coordinates.

    Args:
        data: Fisher information of the capture.
        prior: Curvature of the prior.
        slopes: Derivatives of the parameters, flattened, by the coordinates.
        values: The parameters there.
    """

    data: np.ndarray
    prior: np.ndarray
    slopes: np.ndarray
    values: np.ndarray


def identify(
    capture: xr.Dataset,
    *,
    model: str | Callable = "per_material",
    scene: str | Scene | None = None,
    priors: Mapping[str, dist.Distribution] | None = None,
    links: AbstractLink | Mapping[str, AbstractLink] | None = None,
    largest_view_zenith: float | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> xr.Dataset:
    r"""What a capture determines, by the Fisher information of its readings at the mode.

    The expected posterior covariance is $(F + P)^{-1}$, with $F$ the information of all readings
    and $P$ the curvature of the prior; noise and instrument parameters are unknown in it.

    Args:
        capture: As for `polar_bayes.fit`; the other arguments too.
        model: A name or a callable.
        scene: A name, a `Scene` or None.
        priors: Overrides.
        links: One link, a mapping or None.
        largest_view_zenith: Unit degree, or None for the set-up's own.
        seed: Of the starts.
        progress: Called with the name of a stage and the fraction of it that is done.

    Returns:
        By `parameter`: `value` at the mode, `prior_sd`, `expected_sd` of the posterior,
        `prior_share` of the information (1: the data say nothing; 0: the prior does not matter),
        `sensitivity` (by how many standard deviations of the noise one prior sd moves all readings
        together, all else held); `correlation` of two parameters. By `direction`, weakest first:
        `information` that the data add to what the prior has in that combination of the model's
        coordinates, and `weight` of each parameter in it, in prior sds.

    Raises:
        CaptureError: The capture does not hold what a fit needs.
        FitError: Something cannot be used, or no mode was found.

    Source:
        Lehmann & Casella (1998), Theory of Point Estimation, section 2.6.
    """
    request = resolve(
        capture, model, "laplace", scene, priors, links, largest_view_zenith, seed, "double"
    )
    with jax.enable_x64(True):
        data = observe(request.capture, largest_view_zenith=request.largest_view_zenith)
        program = compile_program(request.bind(request.scene), data)
        key_starts, key_prior = jax.random.split(jax.random.key(seed))
        starts = np.asarray(from_prior(program, key_starts, STARTS, data))
        modes = find_modes(compiled_potential(program, data), starts, progress or _silent)
        expected = _expect(program, modes.z[0], data)
        drawn = np.asarray(from_prior(program, key_prior, PRIOR_DRAWS, data))
        prior = jax.jit(jax.vmap(lambda z: program.parameters(z, data)))(drawn)
    draws = {name: np.asarray(x)[None] for name, x in prior.items()}
    return _assemble(request, scalars(posterior_of(program, draws)), expected, sorted(prior))


def _silent(stage: str, fraction: float) -> None:
    """No progress to show."""


def _expect(program: Program, z: np.ndarray, data: Observations) -> Expected:
    def parameters(z: jax.Array) -> jax.Array:
        told = program.parameters(z, data)
        return jnp.concatenate([jnp.ravel(told[name]) for name in sorted(told)])

    @jax.jit
    def found(z: jax.Array, data: Observations) -> tuple:
        return (
            expected_information(program, z, data),
            prior_precision(program, z, data),
            jax.jacfwd(parameters)(z),
            parameters(z),
        )

    return Expected(*(np.asarray(x) for x in found(jnp.asarray(z), data)))


def _assemble(
    request: Request, found: list[Scalar], expected: Expected, order: list[str]
) -> xr.Dataset:
    rows = _rows_of(found, order)
    slopes, values = expected.slopes[rows], expected.values[rows]
    labels = [scalar.label for scalar in found]
    prior_sd = np.array([scalar.draws.std() for scalar in found])
    whole = np.linalg.inv(expected.data + expected.prior)
    alone = np.linalg.inv(expected.prior)
    covariance = slopes @ whole @ slopes.T
    before = np.einsum("pi,ij,pj->p", slopes, alone, slopes)
    sd = np.sqrt(np.diag(covariance))
    strength, directions = scipy.linalg.eigh(expected.data, expected.prior)
    back = np.linalg.pinv(slopes)  # of one parameter, all others held
    sensitivity = np.sqrt(np.maximum(np.einsum("ip,ij,jp->p", back, expected.data, back), 0.0))
    weight = (slopes @ directions) / np.sqrt(before)[:, None]
    dataset = xr.Dataset(
        {
            "value": ("parameter", values),
            "prior_sd": ("parameter", prior_sd),
            "expected_sd": ("parameter", sd),
            "prior_share": ("parameter", sd**2 / before),
            "sensitivity": ("parameter", sensitivity * prior_sd),
            "correlation": (("parameter", "other"), covariance / np.outer(sd, sd)),
            "information": ("direction", strength),
            "weight": (("direction", "parameter"), weight.T),
        },
        coords={
            "parameter": labels,
            "other": labels,
            "name": ("parameter", [s.name for s in found]),
        },
    )
    for scalar in found:
        dataset.attrs[f"meaning_of_{scalar.name}"] = notation(scalar.name).meaning
    dataset.attrs[PROVENANCE] = json.dumps(_provenance(request), sort_keys=True)
    return dataset


def _rows_of(found: list[Scalar], order: list[str]) -> list[int]:
    """Where each scalar stands among the flattened parameters, which stand by name."""
    counts = {name: sum(scalar.name == name for scalar in found) for name in order}
    begins = dict(zip(order, np.cumsum([0, *counts.values()]), strict=False))
    seen: dict[str, int] = {}
    rows = []
    for scalar in found:  # the entries of one variable follow each other in row order
        rows.append(int(begins[scalar.name]) + seen.get(scalar.name, 0))
        seen[scalar.name] = seen.get(scalar.name, 0) + 1
    return rows


def _provenance(request: Request) -> dict[str, Any]:
    return {
        "model": request.model_name,
        "scene": request.scene_name,
        "scene_parts": repr(request.scene),
        "links": {name: repr(link) for name, link in request.links.items()},
        "seed": request.seed,
        "capture": str(request.capture.attrs.get("name", "capture")),
    }
