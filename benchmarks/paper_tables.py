"""Table 1 (the protocol by class) and Table 2 (with and without views beyond 75 degrees)."""

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array
from paper_study import (
    CLASSES,
    GRAZING,
    INDEX,
    LARGEST,
    NAMES,
    PAPER,
    Figure,
    NormalScores,
    Population,
    Study,
    change_of,
    header,
    joined,
    layout,
    mean_of,
    row,
    scores,
    share_of,
    told,
)

import polar_bayes as pb
from polar_bayes.design.fisher import paper_information, reading_information, total_information
from polar_bayes.design.setup import unconstrain
from polar_bayes.inference.program import Program, compile_program
from polar_bayes.inference.request import resolve
from polar_bayes.observation.data import Observations, observe

PRIOR_DRAWS = 100_000
LEVELS = (0.5, 0.8, 0.95)
PAPER_CLASSES = {
    "leaves": ("leaf",),
    "fruit": ("fruit",),
    "plastics and coatings": ("plastic", "coating"),
}
"""Classes of the paper's table 1, each with the presets that stand for it."""


def table1(study: Study) -> None:
    """Error, coverage and width of every parameter in every class."""
    capture = layout()
    guess, _ = prior_moments()
    trees = []
    header("class", "parameter", "MAE", "MAE of the prior's mean", "95% holds", "mean width")
    for name in CLASSES:
        tree = study.calibrate(capture, truth={"model": Population((name,))})
        trees.append(tree)
        for parameter in NAMES:
            found = scores(tree, parameter)
            blind = np.abs(guess[parameter] - tree["truth"][parameter].to_numpy())
            row(
                name,
                parameter,
                mean_of(found.error),
                mean_of(blind),
                share_of(found.held),
                mean_of(found.width),
            )
    print(f"\nfits: {told(trees)}\n")
    header("class", *(f"{level:.0%} holds" for level in LEVELS))
    by_class = dict(zip(CLASSES, trees, strict=True))
    for title, names in PAPER_CLASSES.items():
        row(title, *(coverage([by_class[name] for name in names], level) for level in LEVELS))


def coverage(trees: list[xr.DataTree], level: float) -> Figure:
    """Share of the central intervals that hold the truth: mean over parameters, then captures."""
    held = []
    for tree in trees:
        ranks = np.stack([tree["prior_sbc"][name].to_numpy().ravel() for name in NAMES])
        held.append(np.mean(np.abs(ranks - 0.5) <= 0.5 * level, axis=0))
    return mean_of(np.concatenate(held))


def prior_moments() -> tuple[dict[str, float], dict[str, float]]:
    """Means and standard deviations of the default priors."""
    keys = jax.random.split(jax.random.key(0), len(NAMES))
    draws = {
        name: np.asarray(pb.PRIORS[name].sample(key, (PRIOR_DRAWS,)))
        for name, key in zip(NAMES, keys, strict=True)
    }
    return (
        {name: float(x.mean()) for name, x in draws.items()},
        {name: float(x.std()) for name, x in draws.items()},
    )


class Eigenvalues(NamedTuple):
    """Smallest eigenvalue of the information about the four parameters, at every truth.

    Args:
        paper: Of the paper's sum of kappa S S' over the degrees of polarization, noise known.
        whole: Of all readings, noise and exposure unknown, in units of the prior's sd.
    """

    paper: np.ndarray
    whole: np.ndarray


class Information:
    """Fisher information of a layout about the material, compiled once."""

    def __init__(self, capture: xr.Dataset, largest_view_zenith: float | None = None) -> None:
        with jax.enable_x64(True):
            request = resolve(
                capture,
                "per_material",
                PAPER,
                None,
                None,
                largest_view_zenith,
                0,
                "double",
            )
            self.data = observe(request.capture, largest_view_zenith=request.largest_view_zenith)
            self.program = compile_program(request.bind(), self.data)
        self._run = jax.jit(
            lambda z: jax.lax.map(lambda each: _at(self.program, each, self.data), z)
        )

    def eigenvalues(self, truth: xr.Dataset) -> Eigenvalues:
        """Return eigenvalues at the truths of simulations."""
        program = self.program
        with jax.enable_x64(True):
            z = unconstrain(program, {name: truth[name].to_numpy() for name in program.supports})
            paper, whole, slope = (np.asarray(x) for x in self._run(jnp.asarray(z)))
            places = program.unravel(jnp.arange(program.size))
        material = np.array([int(places[name]) for name in NAMES])
        nuisance = np.setdiff1d(np.arange(program.size), material)
        scale = slope[:, material]  # of the parameters by their coordinates
        unit = np.array([prior_moments()[1][name] for name in NAMES])
        # What the unknown noise takes away from the material: the Schur complement.
        across = whole[:, material][:, :, nuisance]
        own = whole[:, nuisance][:, :, nuisance]
        left = whole[:, material][:, :, material] - across @ np.linalg.solve(
            own, np.swapaxes(across, 1, 2)
        )
        return Eigenvalues(
            _smallest(paper[:, material][:, :, material], 1.0 / scale),
            _smallest(left, unit / scale),
        )


def _smallest(matrix: np.ndarray, scale: np.ndarray) -> np.ndarray:
    scaled = scale[:, :, None] * matrix * scale[:, None, :]
    return np.linalg.eigvalsh(scaled)[:, 0]


def _at(program: Program, z: Array, data: Observations) -> tuple[Array, Array, Array]:
    """Return the paper's and the whole information, and the derivatives of the coordinates."""
    seen = program.describe(jax.random.key(0), z, data).center["intensity"]
    # Full scale is that of the sensor, not that of the views at hand.
    data = dataclasses.replace(data, brightness=jnp.clip(seen, 0.0, 1.0))
    slopes = jax.jacfwd(program.constrain)(z)
    flat = jnp.sum(jnp.stack([slopes[name] for name in program.supports]), axis=0)
    readings = reading_information(program, z, data)
    return paper_information(readings, program.size)[0], total_information(readings), flat


def table2(study: Study) -> None:
    """The same materials by three protocols; differences are paired by material."""
    whole, narrow = layout(LARGEST), layout(GRAZING)
    few = int(np.sum(whole["view_zenith"] <= GRAZING))
    kinds = {
        f"40 to {LARGEST:g}": (whole, None),
        f"40 to {GRAZING:g}": (narrow, None),
        f"{few} of the first, to {GRAZING:g}": (whole, GRAZING),
    }
    asked = {label: Information(*given) for label, given in kinds.items()}
    header(
        "class",
        "views",
        "smallest eigenvalue, paper's sum",
        "the same, all readings",
        "MAE of n",
        "95% holds",
        "mean width of n",
    )
    found: dict[str, list[tuple]] = {label: [] for label in kinds}
    for name in CLASSES:
        for label, (capture, limit) in kinds.items():
            tree = study.calibrate(
                capture, truth={"model": Population((name,))}, largest_view_zenith=limit
            )
            values = asked[label].eigenvalues(tree["truth"].to_dataset())
            own = scores(tree, INDEX)
            found[label].append((own, values))
            row(name, label, *_summary(own, values))
    for label, pairs in found.items():
        own = joined([each for each, _ in pairs])
        values = Eigenvalues(*(np.concatenate(x) for x in zip(*(x for _, x in pairs), strict=True)))
        row("all classes", label, *_summary(own, values))
    first, *others = kinds
    for other in others:
        print(f"\n{first} degrees instead of {other}, paired by material:\n")
        header("class", "width of n", "MAE of n", "coverage of n", "paper's eigenvalue", "all")
        pairs = list(zip(found[first], found[other], strict=True))
        for name, pair in zip(CLASSES, pairs, strict=True):
            row(name, *_differences([pair]))
        row("all classes", *_differences(pairs))


def _summary(own: NormalScores, values: Eigenvalues) -> tuple:
    """Eigenvalues, error, coverage and width of some captures."""
    eigenvalues = geometric(values.paper), geometric(values.whole)
    return *eigenvalues, mean_of(own.error), share_of(own.held), mean_of(own.width)


def _differences(pairs: list) -> tuple:
    """Differences of width, error, coverage and eigenvalues, over simulations of some classes."""

    def both(take) -> tuple[np.ndarray, np.ndarray]:
        new, old = ([take(each[at]) for each in pairs] for at in (0, 1))
        return np.concatenate(new).astype(float), np.concatenate(old).astype(float)

    held = both(lambda each: each[0].held)
    shares = Figure(*mean_of(held[0] - held[1]))
    return (
        change_of(*both(lambda each: each[0].width)).percent(),
        change_of(*both(lambda each: each[0].error)).percent(),
        f"{shares.value:+.3f} ± {shares.error:.3f}",
        f"x {ratio(*both(lambda each: each[1].paper))}",
        f"x {ratio(*both(lambda each: each[1].whole))}",
    )


def geometric(values: np.ndarray) -> Figure:
    """Geometric mean, with its standard error."""
    logarithm = mean_of(np.log(np.maximum(values, 1e-300)))
    middle = math.exp(logarithm.value)
    return Figure(middle, middle * logarithm.error)


def ratio(new: np.ndarray, old: np.ndarray) -> Figure:
    """Geometric mean of paired ratios."""
    return geometric(np.maximum(new, 1e-300) / np.maximum(old, 1e-300))
