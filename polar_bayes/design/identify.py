"""Identifiability: which parameters, and which combinations of them, a capture determines."""

from collections.abc import Callable, Mapping

import jax
import numpy as np
import pandas as pd
import scipy.linalg
import xarray as xr
from numpyro import distributions as dist

from polar_bayes.design.fisher import (
    paper_information,
    positive_definite,
    prior_precision,
    reading_information,
    total_information,
)
from polar_bayes.design.setup import (
    DesignProblem,
    make_design_problem,
    parameter_vector,
    posterior_modes,
    provenance_attrs,
)
from polar_bayes.inference.request import resolve
from polar_bayes.numerics.compile import compiled
from polar_bayes.observation.data import Observations
from polar_bayes.observation.links import AbstractLink
from polar_bayes.physics.part import notation
from polar_bayes.physics.scene import MATERIAL_PARAMETERS, Scene
from polar_bayes.progress import Progress, with_progress


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
    r"""Compute what a capture determines, by the Fisher information at the posterior mode.

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
        `prior_share` of the variance (1: the data add nothing; 0: the prior does not matter),
        `sensitivity` (by how many standard deviations of the noise one prior sd moves all readings
        together, all else fixed); `paper_information` (the paper's sum of kappa S^2 over degrees of
        polarization with Beta noise, all else fixed), `exact_information` (the Fisher information
        of the same readings), both per squared unit of the parameter, and `paper_sd`, the posterior
        sd expected from the paper's sum: these three NaN where no noise is Beta. `correlation` of
        two parameters. By `direction`, weakest first: `information` of the data over that of the
        prior in that combination of the model's coordinates, `weight` of each parameter in it, in
        prior sds, and `movement`: by how many sds of the noise that parameter's part alone moves
        the readings. (All parts together move them by the root of `information`.)

    Raises:
        CaptureError: The capture does not hold what a fit needs.
        FitError: Something cannot be used, or no mode was found.

    Source:
        Lehmann & Casella (1998), Theory of Point Estimation, section 2.6; the paper's sum:
        `polar_bayes.design.fisher`.
    """
    request = resolve(capture, model, scene, priors, links, largest_view_zenith, seed, "double")
    with jax.enable_x64(True):
        problem = make_design_problem(request)
        return _identify_at(problem, posterior_modes(problem, progress).z[0])


def _identify_at(problem: DesignProblem, mode: np.ndarray) -> xr.Dataset:
    program = problem.program

    @compiled
    def evaluate(z: jax.Array, data: Observations) -> tuple:
        readings = reading_information(program, z, data)
        return (
            total_information(readings),
            prior_precision(program, z, data),
            *paper_information(readings, program.size),
            jax.jacfwd(lambda z: parameter_vector(program, z, data))(z),
            parameter_vector(program, z, data),
        )

    information, prior, paper, exact, jacobian, values = (
        np.asarray(x) for x in evaluate(mode, problem.data)
    )
    prior = positive_definite(prior, problem.prior)
    jacobian = jacobian[problem.rows]

    def covariance_given(information: np.ndarray | float) -> np.ndarray:
        return jacobian @ np.linalg.inv(information + prior) @ jacobian.T

    covariance = covariance_given(information)
    sd, before, paper_sd = (
        np.sqrt(np.diagonal(matrix))
        for matrix in (covariance, covariance_given(0.0), covariance_given(paper))
    )
    strength, directions = scipy.linalg.eigh(information, prior)
    weight = (jacobian @ directions) / before[:, None]
    largest = np.argmax(np.abs(weight), axis=0)
    weight = weight * np.sign(weight[largest, np.arange(strength.size)])
    inverse = np.linalg.pinv(jacobian)

    def conditional(information: np.ndarray) -> np.ndarray:
        """Return the information about each parameter where all others are known."""
        return np.maximum(np.einsum("ip,ij,jp->p", inverse, information, inverse), 0.0)

    sensitivity = np.sqrt(conditional(information))
    dataset = xr.Dataset(
        {
            "value": ("parameter", values[problem.rows]),
            "prior_sd": ("parameter", problem.prior_sd),
            "expected_sd": ("parameter", sd),
            "prior_share": ("parameter", (sd / before) ** 2),
            "sensitivity": ("parameter", sensitivity * problem.prior_sd),
            "paper_information": ("parameter", conditional(paper)),
            "exact_information": ("parameter", conditional(exact)),
            "paper_sd": ("parameter", paper_sd),
            "correlation": (("parameter", "other"), covariance / np.outer(sd, sd)),
            "information": ("direction", strength),
            "weight": (("direction", "parameter"), weight.T),
            "movement": (("direction", "parameter"), np.abs(weight.T) * sensitivity * before),
        },
        coords={
            "parameter": problem.names,
            "other": problem.names,
            "name": ("parameter", [scalar.name for scalar in problem.scalars]),
        },
    )
    for scalar in problem.scalars:
        dataset.attrs[f"meaning_of_{scalar.name}"] = notation(scalar.name).meaning
    return dataset.assign_attrs(provenance_attrs(problem.request))


# --- Table and sentences --------------------------------------------------------------------------


UNDETERMINED, PARTLY = 0.8, 0.3
"""Shares of prior in a parameter's variance from which it is not, or only partly, determined."""


def identifiability_table(found: xr.Dataset) -> pd.DataFrame:
    """Return the results of `identify`, one row for each parameter."""
    columns = ["value", "prior_sd", "expected_sd", "prior_share", "sensitivity", "paper_sd"]
    return found[columns].drop_vars("name").to_dataframe()


def identifiability_sentences(found: xr.Dataset) -> list[str]:
    """State which material parameters are not determined, and which trade off.

    The weakest direction is stated where it is one of the material, several parameters are part of
    it, and the prior determines more of it than the data do.
    """
    is_material = np.isin(found["name"].to_numpy(), MATERIAL_PARAMETERS)
    sentences = []
    for at in np.flatnonzero(is_material & (found["prior_share"].to_numpy() >= PARTLY)):
        row = found.isel(parameter=at)
        share = float(row["prior_share"])
        how = "is not determined" if share >= UNDETERMINED else "is only partly determined"
        sentences.append(
            f"{row['parameter'].item()} {how}: {share:.0%} of its variance is the prior's "
            f"(sd {float(row['prior_sd']):.3g} before the data, "
            f"{float(row['expected_sd']):.3g} expected after)."
        )
    sentences += _weakest_direction(found, is_material) + _correlated_pairs(found, is_material)
    return sentences or ["Every parameter of the material is determined by the data."]


def _weakest_direction(found: xr.Dataset, is_material: np.ndarray) -> list[str]:
    """Describe the direction of least information, if it is weaker than each parameter."""
    weakest = found.isel(direction=0)
    weight, movement = weakest["weight"].to_numpy(), weakest["movement"].to_numpy()
    parts = np.flatnonzero(movement >= 0.3 * movement.max())
    strength = float(weakest["information"])
    is_mixture = parts.size > 1 and movement.max() > 2.0
    # From 1 on the readings determine more of the direction than the prior does.
    if strength >= 1.0 or not is_mixture or not is_material[np.argmax(np.abs(weight))]:
        return []
    names = found["parameter"].to_numpy()
    parts = parts[np.argsort(-np.abs(weight[parts]))]
    mixed = ", ".join(f"{names[part]} by {weight[part]:+.2g}" for part in parts)
    return [
        f"The weakest direction moves {mixed} prior sds together: the readings move by "
        f"{np.sqrt(max(strength, 0.0)):.2g} sds of their noise, though {names[parts[0]]} alone "
        f"would move them by {movement[parts[0]]:.2g}."
    ]


def _correlated_pairs(found: xr.Dataset, is_material: np.ndarray) -> list[str]:
    """List correlated pairs of a determined material parameter and another parameter."""
    correlation, names = found["correlation"].to_numpy(), found["parameter"].to_numpy()
    first = is_material & (found["prior_share"].to_numpy() < UNDETERMINED)
    second = first | ~is_material
    pairs = [
        (i, j)
        for i in np.flatnonzero(first)
        for j in np.flatnonzero(second)
        if (i < j or not first[j]) and abs(correlation[i, j]) >= 0.9
    ]
    return [
        f"{names[i]} and {names[j]} trade off: raising one "
        f"{'raises' if correlation[i, j] > 0.0 else 'lowers'} the other (correlation "
        f"{correlation[i, j]:.2f}), and the readings hardly change."
        for i, j in sorted(pairs, key=lambda pair: -abs(correlation[pair]))
    ]
