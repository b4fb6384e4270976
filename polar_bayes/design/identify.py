"""The public verb: which parameters, and which combinations of them, does a capture determine?"""

import json
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import scipy.linalg
import xarray as xr
from numpyro import distributions as dist

from polar_bayes.design.fisher import (
    look,
    prior_precision,
    sd_with,
    sound_precision,
    sum_as_paper,
    sum_information,
)
from polar_bayes.design.setup import (
    Labels,
    Question,
    find_peaks,
    flat_parameters,
    label_parameters,
    pose,
)
from polar_bayes.errors import FitError
from polar_bayes.inference.compile import compiled
from polar_bayes.inference.request import Request
from polar_bayes.inference.result import PROVENANCE
from polar_bayes.observation.data import Observations
from polar_bayes.observation.links import AbstractLink
from polar_bayes.physics.part import notation
from polar_bayes.physics.scene import MATERIAL_PARAMETERS, Scene
from polar_bayes.progress import Progress, with_progress


class Expected(NamedTuple):
    """Information and covariance of the unconstrained coordinates."""

    data: np.ndarray
    prior: np.ndarray
    paper: np.ndarray
    exact: np.ndarray
    slopes: np.ndarray
    values: np.ndarray


@with_progress
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
        `polar_bayes.design.fisher`.
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


# --- What a capture determines and what it does not, as a table and in words ----------------------


UNTOLD, PARTLY = 0.8, 0.3
"""Share of the prior in a parameter's variance from which it is not, or only partly, determined."""

COUPLED = 0.9
"""Correlation from which two parameters trade off."""

WEAK = 1.0
"""Information along a direction, over the prior's, below which the data say less than it did."""

PART = 0.3
"""Share of the largest movement of the readings from which a parameter is named in a direction."""


def identifiability_table(found: xr.Dataset) -> pd.DataFrame:
    """One row for each parameter.

    Args:
        found: What `polar_bayes.identify` returns.

    Returns:
        Columns value, prior_sd, expected_sd, prior_share, sensitivity and
        paper_sd.

    Raises:
        FitError: It is something else.
    """
    _check(found)
    columns = ["value", "prior_sd", "expected_sd", "prior_share", "sensitivity", "paper_sd"]
    return found[columns].drop_vars("name").to_dataframe()


def identifiability_sentences(found: xr.Dataset) -> list[str]:
    """What is not determined, and what trades off, in words.

    Args:
        found: What `polar_bayes.identify` returns.

    Returns:
        Parameters of the material that the data tell little of; the weakest direction, where the
        data say less of it than the prior, it is one of the material and several parameters make
        it; then pairs that trade off, the closest first; or one sentence that says that all is
        well.

    Raises:
        FitError: It is something else.
    """
    _check(found)
    said = []
    is_material = np.isin(found["name"].to_numpy(), MATERIAL_PARAMETERS)
    for at in np.flatnonzero(is_material):
        row = found.isel(parameter=at)
        share = float(row["prior_share"])
        if share >= PARTLY:
            how = "is not determined" if share >= UNTOLD else "is only partly determined"
            said.append(
                f"{row['parameter'].item()} {how}: {share:.0%} of its variance is the prior's "
                f"(sd {float(row['prior_sd']):.3g} before the data, "
                f"{float(row['expected_sd']):.3g} expected after)."
            )
    said += _weakest_direction(found, is_material)
    told = is_material & (found["prior_share"].to_numpy() < UNTOLD)
    correlation, names = found["correlation"].to_numpy(), found["parameter"].to_numpy()
    for i, j in _coupled(correlation, told, told | ~is_material):
        way = "raises" if correlation[i, j] > 0.0 else "lowers"
        said.append(
            f"{names[i]} and {names[j]} trade off: raising one {way} the other (correlation "
            f"{correlation[i, j]:.2f}), and the readings hardly change."
        )
    return said or ["Every parameter of the material is determined by the data."]


def _weakest_direction(found: xr.Dataset, is_material: np.ndarray) -> list[str]:
    """The combination that the readings see least of, where its parts alone would be seen."""
    weakest = found.isel(direction=0)
    weight, movement = weakest["weight"].to_numpy(), weakest["movement"].to_numpy()
    parts = np.flatnonzero(movement >= PART * movement.max())
    strength = float(weakest["information"])
    is_mixture = parts.size > 1 and movement.max() > 2.0  # one alone is not determined, as said
    if strength >= WEAK or not is_mixture or not is_material[np.argmax(np.abs(weight))]:
        return []
    names = found["parameter"].to_numpy()
    parts = parts[np.argsort(-np.abs(weight[parts]))]
    mixed = ", ".join(f"{names[part]} by {weight[part]:+.2g}" for part in parts)
    return [
        f"The weakest direction moves {mixed} prior sds together: the readings move by "
        f"{np.sqrt(max(strength, 0.0)):.2g} sds of their noise, though {names[parts[0]]} alone "
        f"would move them by {movement[parts[0]]:.2g}."
    ]


def _coupled(correlation: np.ndarray, first: np.ndarray, second: np.ndarray) -> list:
    """Pairs of the first kind with the second whose correlation is high, the closest first."""
    pairs = [
        (i, j)
        for i in np.flatnonzero(first)
        for j in np.flatnonzero(second)
        if (i < j or not first[j]) and abs(correlation[i, j]) >= COUPLED
    ]
    return sorted(pairs, key=lambda pair: -abs(correlation[pair]))


def _check(found: xr.Dataset) -> None:
    if not isinstance(found, xr.Dataset) or "prior_share" not in found:
        raise FitError(
            "it says nothing of identifiability",
            where="identifiability",
            hint="give what polar_bayes.identify returns",
        )
