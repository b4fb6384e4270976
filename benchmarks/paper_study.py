"""Definitions of the paper's evaluation: classes of materials, the protocol, and scores.

A class is a narrow population around a preset. Truths are drawn from it, the fits believe the
paper's priors: what they get wrong is what the wide prior costs where materials are alike.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import numpyro
import scipy.stats
import xarray as xr
from jaxtyping import Array
from numpyro import distributions as dist
from one_material import SCENE

import polar_bayes as pb
from polar_bayes.models.sites import declare_readings, draw_independent, material_parameters
from polar_bayes.observation.data import Observations
from polar_bayes.simulation import BRIGHT_LEVEL, BRIGHT_QUANTILE, NOISE

CLASSES = tuple(pb.simulation.PRESETS)
NAMES = ("roughness", "subsurface_fraction", "absorption", "refractive_index")
PAPER = dataclasses.replace(pb.setups.SETUPS["paper"], scene=SCENE, priors={})
"""The set-up with the paper's own priors; the set-up `paper` allows more for a bare surface."""
INDEX = "refractive_index"
COLOR = 550.0
LARGEST, GRAZING = 85.0, 75.0
SPREADS = {
    "roughness": 0.2,  # of the logarithm
    "absorption": 0.2,  # of the logarithm
    "subsurface_fraction": 0.3,  # of the log odds
    "refractive_index": 0.02,
    "exposure": 0.01,  # of the logarithm, as the next two
    "concentration_scale": 0.1,
    "intensity_scale": 0.1,
}


@dataclasses.dataclass(frozen=True)
class Study:
    """Options of the command line.

    Args:
        simulations: Of each cell of a table.
        method: Of `polar_bayes.calibrate`.
        seed: Of truths, noise and draws.
    """

    simulations: int
    method: str = "importance"
    seed: int = 0

    def calibrate(self, capture: xr.Dataset, **asked: Any) -> xr.DataTree:
        """Simulations of one layout, fitted by the paper's priors unless told otherwise."""
        asked = {"method": self.method, "scene": PAPER, "seed": self.seed, **asked}
        return pb.calibrate(capture, simulations=self.simulations, **asked)


def layout(largest_view_zenith: float = LARGEST) -> xr.Dataset:
    """The protocol of 40 views, one color. Full scale is stated: it never depends on the views."""
    protocol = pb.simulation.Protocol(largest_view_zenith=largest_view_zenith, wavelengths=())
    return pb.simulate("leaf", scene=SCENE, protocol=protocol)


def center(name: str) -> dict[str, float]:
    """The middle of a class, in the parameters' own units."""
    material = pb.simulation.PRESETS[name].at(np.array([COLOR]))
    return {each: float(np.ravel(material[each])[0]) for each in NAMES}


@dataclasses.dataclass(frozen=True)
class Population:
    """Materials of some classes, each class as likely: a model to simulate with, not to fit.

    Args:
        classes: Names of presets.
    """

    classes: tuple[str, ...] = CLASSES

    def __call__(
        self, data: Observations, scene: pb.Scene, priors: Mapping, links: Mapping
    ) -> None:
        """Declare the story of one capture."""
        which = numpyro.sample("which", dist.Uniform(0.0, float(len(self.classes))))
        at = jnp.clip(jnp.floor(which).astype(int), 0, len(self.classes) - 1)
        centers = [center(name) for name in self.classes]
        own = around({name: jnp.asarray([each[name] for each in centers])[at] for name in NAMES})
        parameters = {
            name: draw_independent(name, data, own) for name in material_parameters(scene)
        }
        own["exposure"] = dist.LogNormal(jnp.log(exposure(parameters, scene)), SPREADS["exposure"])
        declare_readings(parameters, data, scene, own, links)


def around(middle: Mapping[str, Any]) -> dict[str, dist.Distribution]:
    """The distributions of a class around its middle, and those of the noise."""
    whole = {**NOISE, **middle}
    told: dict[str, dist.Distribution] = {
        name: dist.LogNormal(jnp.log(whole[name]), spread)
        for name, spread in SPREADS.items()
        if name in whole
    }
    name = "subsurface_fraction"
    odds = dist.Normal(jnp.log(middle[name]) - jnp.log1p(-middle[name]), SPREADS[name])
    told[name] = dist.TransformedDistribution(odds, dist.transforms.SigmoidTransform())
    told[INDEX] = dist.TruncatedNormal(middle[INDEX], SPREADS[INDEX], low=1.2, high=2.0)
    return told


def exposure(parameters: Mapping[str, Any], scene: pb.Scene = SCENE) -> Array:
    """Return the exposure that `simulate` would choose for the whole protocol."""
    geometry = pb.Geometry.from_degrees(**pb.simulation.Protocol(wavelengths=()).angles())
    seen = scene.predict({n: jnp.asarray(x) for n, x in parameters.items()}, geometry)
    return BRIGHT_LEVEL / jnp.quantile(seen["intensity"], BRIGHT_QUANTILE)


class NormalScores(NamedTuple):
    """Scores of one parameter of every simulation, (simulation,); NaN without an answer.

    Args:
        error: Size of estimate minus truth.
        held: Whether the 95% interval holds the truth; without an answer it does not.
        width: Of that interval.
    """

    error: np.ndarray
    held: np.ndarray
    width: np.ndarray


def score(estimate: Any, low: Any, high: Any, truth: Any) -> NormalScores:
    """Scores of estimates and intervals; an interval without end is no answer."""
    estimate, low, high, truth = (np.asarray(x, float) for x in (estimate, low, high, truth))
    width = np.where(np.isfinite(high - low), high - low, np.nan)
    held = np.isfinite(width) & (low <= truth) & (truth <= high)
    return NormalScores(np.abs(estimate - truth), held, width)


def scores(tree: xr.DataTree, name: str) -> NormalScores:
    """Scores of posterior means and central 95% intervals of a calibration."""
    marginals = tree["marginals"].to_dataset()
    low, high = (marginals[f"{name}_quantile"].sel(quantile=q) for q in (0.025, 0.975))
    return score(marginals[name], low, high, tree["truth"][name])


def told(trees: list[xr.DataTree]) -> str:
    """Count the fits without an answer, and those with an answer in doubt."""
    missing, doubted, every = 0, 0, 0
    for tree in trees:
        status = tree["fits"]["status"].to_numpy()
        unknown = np.isnan(tree["marginals"][INDEX].to_numpy())
        missing += int(unknown.sum())
        doubted += int(np.sum(~unknown & (status != 0)))
        every += status.size
    return f"{missing} of {every} without an answer, {doubted} doubted by their status"


def joined(parts: list[NormalScores]) -> NormalScores:
    """Join the results of several classes."""
    return NormalScores(*(np.concatenate(each) for each in zip(*parts, strict=True)))


class Figure(NamedTuple):
    """A number and its Monte Carlo standard error."""

    value: float
    error: float

    def __str__(self) -> str:
        if not math.isfinite(self.value):
            return "-"
        if not math.isfinite(self.error) or self.error <= 0.0:
            return f"{self.value:.3g}"
        digits = max(0, 1 - math.floor(math.log10(self.error)))
        return f"{self.value:.{digits}f} ± {self.error:.{digits}f}"

    def percent(self) -> str:
        """A share as percent."""
        return f"{100.0 * self.value:+.1f} ± {100.0 * self.error:.1f}%"


def mean_of(values: np.ndarray) -> Figure:
    """Mean over the simulations that have an answer."""
    known = values[np.isfinite(values)]
    if known.size < 2:
        return Figure(math.nan, math.nan)
    return Figure(float(known.mean()), float(known.std(ddof=1) / math.sqrt(known.size)))


def change_of(new: np.ndarray, old: np.ndarray) -> Figure:
    """Mean over another mean, minus one; both of the same simulations (delta method)."""
    both = np.isfinite(new) & np.isfinite(old)
    if both.sum() < 2:
        return Figure(math.nan, math.nan)
    new, old = new[both], old[both]
    ratio = new.mean() / old.mean()
    error = np.std(new - ratio * old, ddof=1) / (old.mean() * math.sqrt(both.sum()))
    return Figure(float(ratio - 1.0), float(error))


def share_of(held: np.ndarray) -> str:
    """A share with its 95% interval (Wilson)."""
    found = scipy.stats.binomtest(int(held.sum()), held.size)
    sure = found.proportion_ci(0.95, method="wilson")
    return f"{found.statistic:.3f} [{sure.low:.2f}, {sure.high:.2f}]"


def row(*cells: Any) -> None:
    """A row of a markdown table, as soon as it is known."""
    print("| " + " | ".join(str(cell) for cell in cells) + " |", flush=True)


def header(*names: str) -> None:
    """The first two rows of a markdown table."""
    row(*names)
    row(*("---" for _ in names))
