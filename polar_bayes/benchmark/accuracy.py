"""The public verb: what each method and setting gets wrong for one capture, and what it costs."""

import dataclasses
import json
import os
from collections.abc import Callable, Iterable, Mapping
from importlib.metadata import version
from typing import Any, NamedTuple

import jax
import numpy as np
import xarray as xr
from numpyro import distributions as dist

from polar_bayes.benchmark.reference import Distances, Judge, Reference, distances, run_reference
from polar_bayes.benchmark.run import (
    DIALS,
    AbstractDial,
    Measured,
    Trial,
    problem_of,
    run_fresh,
    run_trial,
)
from polar_bayes.errors import FitError, PolarBayesError
from polar_bayes.inference.files import ACCURACY, OF_ALL, Schema, holds, load_tree
from polar_bayes.inference.methods import LADDER
from polar_bayes.inference.request import Method, Request, resolve
from polar_bayes.inference.result import PROVENANCE
from polar_bayes.observation.links import AbstractLink
from polar_bayes.physics.scene import Scene
from polar_bayes.progress import Progress, no_progress, with_progress

AS_GIVEN = "as given"
FOLD = 7
"""Folded into the key of the reference."""

DESCRIPTIONS: Mapping[str, tuple[str, str]] = {
    "mean_error": ("posterior mean minus that of the reference, in its sds", "1"),
    "sd_error": ("posterior sd over that of the reference, minus 1", "1"),
    "low_error": ("2.5% end of the interval minus that of the reference, in its sds", "1"),
    "high_error": ("97.5% end of the interval minus that of the reference, in its sds", "1"),
    "wasserstein": ("Wasserstein distance from the reference, in its sds", "1"),
    "r_hat": ("largest R-hat of all coordinates", "1"),
    "k_hat": ("Pareto k-hat of the importance weights", "1"),
    "effective_draws": ("independent draws that the draws are worth", "1"),
    "gradients": ("evaluations of the log density with its gradient", "1"),
    "densities": ("evaluations of the log density alone", "1"),
    "seconds_first": ("time to the parameters of all draws in a fresh process", "s"),
    "seconds_again": ("time of the next fit of the same layout", "s"),
    "peak_memory": ("most memory that the process held", "MiB"),
    "memory_before": ("memory that the process held after its imports", "MiB"),
    "problems": ("what the method itself objects to; or why it has no answer", "1"),
    "reference_mean": ("posterior mean of the reference", ""),
    "reference_sd": ("posterior sd of the reference", ""),
    "reference_mean_error": ("its Monte Carlo standard error, in its sds", "1"),
    "reference_sd_error": ("Monte Carlo standard error of its sd, in its sds", "1"),
    "reference_wasserstein": ("distance of one half of its chains from the other", "1"),
}


@with_progress
def accuracy(
    capture: xr.Dataset,
    *,
    rungs: Mapping[str, Method] | None = None,
    dials: Iterable[AbstractDial] = DIALS,
    reference: Reference | None = None,
    fresh: bool = True,
    model: str | Callable = "per_material",
    scene: str | Scene | None = None,
    priors: Mapping[str, dist.Distribution] | None = None,
    links: AbstractLink | Mapping[str, AbstractLink] | None = None,
    largest_view_zenith: float | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> xr.DataTree:
    """Climb the ladder of methods on one capture, and measure every rung against the top.

    Args:
        capture: A Dataset of the capture schema; validated here.
        rungs: Methods by name; by default `polar_bayes.methods.LADDER`.
        dials: What else is turned, one at a time, on every rung; `()` for the rungs alone.
        reference: How well the posterior that all are judged by must be known.
        fresh: True runs every trial in a process of its own, so that the first time includes all
            compilation and the memory is its own. False runs them here: much faster, but without
            first times and memory, which would not be theirs.
        model: As for `polar_bayes.fit`; scene, priors, links and largest_view_zenith too.
        scene: A name, a `Scene` or None.
        priors: Overrides.
        links: One link, a mapping or None.
        largest_view_zenith: Unit degree, or None for the set-up's own.
        seed: Of the random numbers.
        progress: Called with the name of a stage and the fraction of it that is done.

    Returns:
        A tree whose group `accuracy` has a row for each rung and dial (coordinates `rung` and
        `dial`), and by row and parameter the distances from the reference; see the attribute
        `long_name` of each variable. `polar_bayes.benchmark.accuracy_table`, `accuracy_advice` and
        `plot_accuracy` read it.

    Raises:
        CaptureError: The capture does not hold what a fit needs.
        SceneError: No such scene.
        FitError: A prior, link or setting cannot be used, or there is no reference.
    """
    request = resolve(
        capture, model, "nuts", scene, priors, links, largest_view_zenith, seed, "double"
    )
    show = progress or no_progress
    trials = _trials(request, LADDER if rungs is None else rungs, tuple(dials))
    show("reference", 0.0)
    with jax.enable_x64(True):
        key = jax.random.fold_in(jax.random.key(seed), FOLD)  # no random number of any trial
        judge = run_reference(reference or Reference(), problem_of(request, key))
    show("reference", 1.0)
    rows = []
    for number, ((rung, dial), trial) in enumerate(trials.items()):
        show("trials", number / len(trials))
        rows.append(_row(rung, dial, trial, judge, run_fresh if fresh else run_trial, fresh))
    show("trials", 1.0)
    about = {
        "accuracy": len(rows),
        "model": request.model_name,
        "scene": request.scene_name,
        "scene_parts": repr(request.scene),
        "links": {name: repr(link) for name, link in request.links.items()},
        "seed": seed,
        "capture": str(request.capture.attrs.get("name", "capture")),
        "fresh_processes": fresh,
        "versions": {name: version(name) for name in ("polar_bayes", "jax", "numpyro")},
    }
    tree = xr.DataTree(children={"accuracy": xr.DataTree(_dataset(rows, judge))})
    tree.attrs[PROVENANCE] = json.dumps(about, sort_keys=True)
    return tree


class Row(NamedTuple):
    """One trial, judged."""

    rung: str
    dial: str
    apart: Distances
    measured: Measured | None
    problems: str
    fresh: bool

    @property
    def numbers(self) -> dict[str, float]:
        """What it cost and says of itself, by name."""
        if self.measured is None:
            return dict.fromkeys(_NUMBERS, np.nan)
        own, costs = self.measured.answer, self.measured
        first = ("seconds_first", "peak_memory", "memory_before")
        return {
            name: np.nan
            if name in first and not self.fresh
            else float(getattr(own if hasattr(own, name) else costs, name))
            for name in _NUMBERS
        }


_NUMBERS = (
    "r_hat",
    "k_hat",
    "effective_draws",
    "gradients",
    "densities",
    "seconds_first",
    "seconds_again",
    "peak_memory",
    "memory_before",
)


def _trials(
    request: Request, rungs: Mapping[str, Method], dials: tuple[AbstractDial, ...]
) -> dict[tuple[str, str], Trial | PolarBayesError]:
    """What is run, or why it cannot be, by rung and dial; all rungs as given come first."""
    if not isinstance(rungs, Mapping) or not rungs:
        raise FitError(
            "there is no rung", where="accuracy: rungs", hint="give methods by name, as in LADDER"
        )
    trials: dict[tuple[str, str], Trial | PolarBayesError] = {}
    for name, method in rungs.items():
        if not isinstance(method, Method):
            raise FitError(
                f"a {type(method).__name__} is not a method",
                where=f"accuracy: rungs[{name!r}]",
                hint="give settings such as polar_bayes.methods.Nuts()",
            )
        trials[str(name), AS_GIVEN] = Trial(request, method, request.seed)
    for dial in dials:
        for name, method in rungs.items():
            try:
                turned = dial.turn(request, method)
            except PolarBayesError as error:  # a dial that fails is a row of every rung
                trials[str(name), dial.name] = error
                continue
            if turned is not None:
                trials[str(name), dial.name] = Trial(*turned, request.seed)
    return trials


def _row(
    rung: str,
    dial: str,
    trial: Trial | PolarBayesError,
    judge: Judge,
    run: Callable[[Trial], Measured],
    fresh: bool,
) -> Row:
    lost = np.full(len(judge.labels), np.nan)
    nothing = Distances(*(lost.copy() for _ in Distances._fields))
    if isinstance(trial, PolarBayesError):
        return Row(rung, dial, nothing, None, str(trial), fresh)
    try:
        found = run(trial)
    except PolarBayesError as error:  # a rung that fails is a row, too
        return Row(rung, dial, nothing, None, str(error), fresh)
    shared = [label for label in judge.labels if label in found.labels]
    ours, theirs = (
        np.stack([draws[labels.index(label)].ravel() for label in shared])
        for labels, draws in ((found.labels, found.draws), (judge.labels, judge.draws))
    )
    at = [judge.labels.index(label) for label in shared]
    for whole, part in zip(nothing, distances(ours, theirs), strict=True):
        whole[at] = part
    return Row(rung, dial, nothing, found, "; ".join(found.answer.problems), fresh)


def _dataset(rows: list[Row], judge: Judge) -> xr.Dataset:
    both, draws = ("row", "parameter"), judge.draws.reshape(len(judge.labels), -1)
    columns: dict[str, tuple[Any, Any]] = {
        name: (both, np.stack([getattr(row.apart, name) for row in rows]))
        for name in Distances._fields
    }
    columns |= {name: ("row", [row.numbers[name] for row in rows]) for name in _NUMBERS}
    columns["problems"] = ("row", np.array([row.problems for row in rows], object))
    columns |= {
        "reference_mean": ("parameter", draws.mean(axis=1)),
        "reference_sd": ("parameter", draws.std(axis=1)),
        "reference_mean_error": ("parameter", judge.mean_error),
        "reference_sd_error": ("parameter", judge.sd_error),
        "reference_wasserstein": ("parameter", judge.halves.wasserstein),
    }
    names = ("long_name", "units")
    return xr.Dataset(
        {
            name: (dims, values, dict(zip(names, DESCRIPTIONS[name], strict=True)))
            for name, (dims, values) in columns.items()
        },
        coords={
            "rung": ("row", np.array([row.rung for row in rows], object)),
            "dial": ("row", np.array([row.dial for row in rows], object)),
            "parameter": np.array(judge.labels, object),
        },
        attrs={
            "reference": judge.made_by,
            "reference_draws": int(draws.shape[1]),
            "reference_effective_draws": float(judge.answer.effective_draws),
            "reference_r_hat": float(judge.answer.r_hat),
            "reference_error": judge.error,
            "reference_doubts": "; ".join(judge.doubts),
        },
    )


# --- Accuracy studies in netCDF files, and what they hold -----------------------------------------


STUDY = Schema(
    kind="accuracy study",
    made_by="polar_bayes.accuracy or load_accuracy",
    command="`polar-bayes accuracy`",
    groups={"accuracy": dataclasses.replace(ACCURACY, needed=True)},
    provenance=OF_ALL,
)


def is_accuracy(tree: object) -> bool:
    """Whether a tree is what `polar_bayes.accuracy` returns, and no fit."""
    return STUDY.describes(tree)


def holds_accuracy(path: str | os.PathLike[str]) -> bool:
    """Whether a file holds an accuracy study; its numbers are not read.

    Args:
        path: Any file.

    Returns:
        False where it is not there, cannot be read, or holds something else.

    Raises:
        Nothing.
    """
    return holds(path, STUDY)


def load_accuracy(path: str | os.PathLike[str]) -> xr.DataTree:
    """An accuracy study from a netCDF file.

    Args:
        path: A file that `polar-bayes accuracy` or `polar_bayes.save_result` wrote.

    Returns:
        The tree, in memory; the file is closed.

    Raises:
        CaptureError: The file is not there.
        FitError: It was damaged, or holds no accuracy study; the variable that is wrong.
    """
    return load_tree(path, STUDY)
