"""Ablations of the paper's model: fits that leave out one part, on the same data."""

import dataclasses
import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import override

import jax.numpy as jnp
import numpy as np
import xarray as xr
from jax.scipy.stats import norm
from jaxtyping import Array, Float
from numpyro import distributions as dist

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from paper_study import (
    CLASSES,
    INDEX,
    NAMES,
    NormalScores,
    Population,
    Study,
    change_of,
    header,
    joined,
    layout,
    mean_of,
    row,
    score,
    scores,
    share_of,
)
from plates import LINKS, PLATE, plates

import polar_bayes as pb
from polar_bayes.observation.data import Observations
from polar_bayes.observation.distributions import SensorStudentT
from polar_bayes.observation.links import AbstractLink

BETA, HEAVY = pb.links.BetaLink(), pb.links.StudentTLink(degrees_of_freedom=3.0)
PATCHES, SPREAD, ERROR, REPETITIONS = 6, 0.02, 0.05, 12


class SensorNormal(SensorStudentT):
    """Normal noise that stops at zero and at full scale."""

    @override
    def log_prob(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        distance = (value - self.location) / self.scale
        inside = norm.logpdf(distance) - jnp.log(self.scale)
        stopped = norm.logsf(jnp.where(self.saturated, distance, -distance))
        return jnp.where(self.saturated | (value <= 0.0), stopped, inside)


@dataclasses.dataclass(frozen=True)
class NormalSensorLink(pb.links.StudentTLink):
    """The intensity as `StudentTLink` has it, with normal noise of the same scale."""

    @override
    def distribution(
        self, name: str, prediction: Mapping, data: Observations, noise: Mapping
    ) -> dist.Distribution:
        like = super().distribution(name, prediction, data, noise)
        return SensorNormal(math.inf, like.location, like.scale, like.saturated, like.full_scale)


def ablations(study: Study) -> None:
    """Noise models and pooling; views beyond 75 degrees are Table 2."""
    print(f"{len(CLASSES)} classes, {study.simulations} materials of each\n")
    noise(
        study,
        "DoP told with Beta noise",
        told={"dop": BETA, "intensity": pb.links.StudentTLink()},
        fitted={"Beta": {}, "Normal": {"dop": pb.links.NormalLink()}},
    )
    noise(
        study,
        "intensity told with Student's t of 3 degrees of freedom",
        told={"dop": BETA, "intensity": HEAVY},
        fitted={"Student-t": {}, "Normal": {"intensity": NormalSensorLink()}},
    )
    pooling(study)


def noise(
    study: Study,
    title: str,
    told: Mapping[str, AbstractLink],
    fitted: Mapping[str, Mapping[str, AbstractLink]],
) -> None:
    """Fit the same simulations by the links that generated them, and by others."""
    capture = layout()
    found: dict[str, list[xr.DataTree]] = {
        label: [
            study.calibrate(
                capture,
                links={**told, **instead},
                truth={"links": told, "model": Population((name,))},
            )
            for name in CLASSES
        ]
        for label, instead in fitted.items()
    }
    print(f"\n{title}:\n")
    header("parameter", "fitted with", "MAE", "95% holds", "mean width", "MAE changes", "width")
    right = next(iter(fitted))
    for parameter in NAMES:
        by = {n: joined([scores(tree, parameter) for tree in trees]) for n, trees in found.items()}
        for label, own in by.items():
            row(parameter, label, *_told(own), *_against(own, by[right], label == right))


def _told(own: NormalScores) -> tuple:
    return mean_of(own.error), share_of(own.held), mean_of(own.width)


def _against(own: NormalScores, first: NormalScores, same: bool) -> tuple[str, str]:
    if same:
        return "", ""
    pairs = (own.error, first.error), (own.width, first.width)
    error, width = (change_of(*pair).percent() for pair in pairs)
    return error, width


def pooling(study: Study) -> None:
    """Fit the index of plates of one batch, pooled and separately."""
    found: dict[str, list[NormalScores]] = {"per_material": [], "hierarchical": []}
    converged = dict.fromkeys(found, 0)
    for repetition in range(REPETITIONS):
        random = np.random.default_rng(1000 + study.seed + repetition)
        truth = np.clip(random.normal(1.5, SPREAD, PATCHES), 1.25, 1.95)
        capture = plates(truth, ERROR, seed=study.seed + repetition)
        for model, told in found.items():
            asked = {"scene": PLATE, "links": LINKS, "method": "nuts", "seed": repetition}
            result = pb.fit(capture, model=model, **asked)
            converged[model] += bool(pb.verdict(result).passed)
            draws = result["posterior"][INDEX].stack(all=("chain", "draw"))
            low, high = draws.quantile([0.025, 0.975], "all").to_numpy()
            told.append(score(draws.mean("all"), low, high, truth))
    print(
        f"\n{REPETITIONS} batches of {PATCHES} smooth plates whose index differs by {SPREAD}, "
        f"6 views, error {ERROR} in q, NUTS:\n"
    )
    header("model", "MAE of n", "95% holds", "mean width", "MAE changes", "width", "converged")
    # Plates of one batch go together: errors are those of means over batches.
    means = {
        model: NormalScores(*(np.mean(each, axis=1) for each in zip(*told, strict=True)))
        for model, told in found.items()
    }
    first = means["per_material"]
    for model, own in means.items():
        against = _against(own, first, model == "per_material")
        whole = share_of(joined(found[model]).held)
        row(
            model,
            mean_of(own.error),
            whole,
            mean_of(own.width),
            *against,
            f"{converged[model]} of {REPETITIONS}",
        )
