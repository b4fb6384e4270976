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

from polar_bayes.identifiability.fisher import (
    look,
    prior_precision,
    sound_precision,
    sum_information,
)
from polar_bayes.identifiability.paper import sd_with, sum_as_paper
from polar_bayes.identifiability.peak import (
    Labels,
    Question,
    find_peaks,
    flat_parameters,
    label_parameters,
    pose,
)
from polar_bayes.inference.request import Request
from polar_bayes.inference.result import PROVENANCE
from polar_bayes.inference.tracing import compiled
from polar_bayes.observation.data import Observations
from polar_bayes.observation.links import AbstractLink
from polar_bayes.physics.notation import notation
from polar_bayes.physics.scene import Scene
from polar_bayes.progress import Progress, watched


class Expected(NamedTuple):
    """Information and covariance of the unconstrained coordinates."""

    data: np.ndarray
    prior: np.ndarray
    paper: np.ndarray
    exact: np.ndarray
    slopes: np.ndarray
    values: np.ndarray


@watched
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
        together, all else held); `paper_information` (the paper's sum of kappa S^2 over degrees of
        polarization with Beta noise, all else held), `exact_information` (what the same readings
        tell), both per squared unit of the parameter, and `paper_sd`, the posterior sd that the
        paper's sum promises: these three NaN where no noise is Beta. `correlation` of two
        parameters. By `direction`, weakest first: `information` that the data add to what the
        prior has in that combination of the model's coordinates, and `weight` of each parameter in
        it, in prior sds, and `movement`: by how many sds of the noise that
        parameter's part alone moves the readings. (All parts together move them by the root of
        `information`.)

    Raises:
        CaptureError: The capture does not hold what a fit needs.
        FitError: Something cannot be used, or no mode was found.

    Source:
        Lehmann & Casella (1998), Theory of Point Estimation, section 2.6; the paper's sum:
        `polar_bayes.identifiability.paper`.
    """
    with jax.enable_x64(True):
        question = pose(capture, model, scene, priors, links, largest_view_zenith, seed)
        expected = _expect(question, find_peaks(question, progress).z[0])
        labels = label_parameters(question)
    return _assemble(question.request, labels, expected)


def _expect(question: Question, z: np.ndarray) -> Expected:
    program = question.program

    @compiled
    def found(z: jax.Array, data: Observations) -> tuple:
        seen = look(program, z, data)
        return (
            sum_information(seen),
            prior_precision(program, z, data),
            *sum_as_paper(seen, program.size),
            jax.jacfwd(lambda z: flat_parameters(program, z, data))(z),
            flat_parameters(program, z, data),
        )

    expected = Expected(*(np.asarray(x) for x in found(jnp.asarray(z), question.data)))
    return expected._replace(prior=sound_precision(expected.prior, question.prior))


def _assemble(request: Request, labels: Labels, expected: Expected) -> xr.Dataset:
    slopes, values = expected.slopes[labels.rows], expected.values[labels.rows]
    prior_sd = labels.prior_sd
    whole = np.linalg.inv(expected.data + expected.prior)
    covariance = slopes @ whole @ slopes.T
    before = sd_with(np.zeros_like(expected.prior), expected.prior, slopes)
    sd = np.sqrt(np.diag(covariance))
    strength, directions = scipy.linalg.eigh(expected.data, expected.prior)
    weight = (slopes @ directions) / before[:, None]
    largest = np.argmax(np.abs(weight), axis=0)
    weight = weight * np.sign(weight[largest, np.arange(strength.size)])
    back = np.linalg.pinv(slopes)  # of one parameter, all others held

    def alone(information: np.ndarray) -> np.ndarray:
        return np.maximum(np.einsum("ip,ij,jp->p", back, information, back), 0.0)

    dataset = xr.Dataset(
        {
            "value": ("parameter", values),
            "prior_sd": ("parameter", prior_sd),
            "expected_sd": ("parameter", sd),
            "prior_share": ("parameter", (sd / before) ** 2),
            "sensitivity": ("parameter", np.sqrt(alone(expected.data)) * prior_sd),
            "paper_information": ("parameter", alone(expected.paper)),
            "exact_information": ("parameter", alone(expected.exact)),
            "paper_sd": ("parameter", sd_with(expected.paper, expected.prior, slopes)),
            "correlation": (("parameter", "other"), covariance / np.outer(sd, sd)),
            "information": ("direction", strength),
            "weight": (("direction", "parameter"), weight.T),
            "movement": (
                ("direction", "parameter"),
                np.abs(weight.T) * np.sqrt(alone(expected.data)) * before,
            ),
        },
        coords={
            "parameter": labels.names,
            "other": labels.names,
            "name": ("parameter", [scalar.name for scalar in labels.scalars]),
        },
    )
    for scalar in labels.scalars:
        dataset.attrs[f"meaning_of_{scalar.name}"] = notation(scalar.name).meaning
    dataset.attrs[PROVENANCE] = json.dumps(provenance(request), sort_keys=True)
    return dataset


def provenance(request: Request) -> dict[str, Any]:
    """What a question was about, as far as JSON can hold it."""
    return {
        "model": request.model_name,
        "scene": request.scene_name,
        "scene_parts": repr(request.scene),
        "links": {name: repr(link) for name, link in request.links.items()},
        "seed": request.seed,
        "capture": str(request.capture.attrs.get("name", "capture")),
    }
