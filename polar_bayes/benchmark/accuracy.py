"""Accuracy study: errors of methods and settings for one capture, and what they cost."""

from collections.abc import Callable, Iterable, Mapping
from importlib.metadata import version
from typing import Any

import jax
import numpy as np
import xarray as xr
from numpyro import distributions as dist

from polar_bayes.benchmark.advice import AS_GIVEN
from polar_bayes.benchmark.reference import (
    DISTANCES,
    Reference,
    ReferenceRun,
    distances,
    run_reference,
)
from polar_bayes.benchmark.run import (
    OVERRIDES,
    AbstractOverride,
    Trial,
    run_in_subprocess,
    run_trial,
)
from polar_bayes.design.setup import provenance_attrs
from polar_bayes.errors import FitError, PolarBayesError
from polar_bayes.inference.problem import make_problem
from polar_bayes.inference.request import Request, resolve
from polar_bayes.methods.method import AbstractMethod
from polar_bayes.methods.study import STUDY_METHODS
from polar_bayes.observation.links import AbstractLink
from polar_bayes.physics.scene import Scene
from polar_bayes.progress import Progress, no_progress, with_progress

DIAGNOSTICS = ("r_hat", "pareto_k", "ess", "gradients", "densities")
COSTS_OF_PROCESS = ("seconds_first", "peak_memory", "memory_before")
"""Costs that can be measured only for a trial that runs in its own process."""

DESCRIPTIONS: Mapping[str, tuple[str, str]] = {
    "mean_error": ("posterior mean minus that of the reference, in its sds", "1"),
    "sd_error": ("posterior sd over that of the reference, minus 1", "1"),
    "low_error": ("2.5% end of the interval minus that of the reference, in its sds", "1"),
    "high_error": ("97.5% end of the interval minus that of the reference, in its sds", "1"),
    "wasserstein": ("Wasserstein distance from the reference, in its sds", "1"),
    "r_hat": ("largest R-hat of all coordinates", "1"),
    "pareto_k": ("Pareto k of the importance weights", "1"),
    "ess": ("effective number of independent draws", "1"),
    "gradients": ("evaluations of the log density with its gradient", "1"),
    "densities": ("evaluations of the log density alone", "1"),
    "seconds_first": ("time to the parameters of all draws in a fresh process", "s"),
    "seconds_again": ("time of the next fit of the same layout", "s"),
    "peak_memory": ("most memory that the process held", "MiB"),
    "memory_before": ("memory that the process held after its imports", "MiB"),
    "problems": ("problems that the method reports, or the error that it ended with", "1"),
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
    methods: Mapping[str, AbstractMethod] | None = None,
    overrides: Iterable[AbstractOverride] = OVERRIDES,
    reference: Reference | None = None,
    fresh: bool = True,
    model: str | Callable = "per_material",
    scene: str | Scene | None = None,
    priors: Mapping[str, dist.Distribution] | None = None,
    links: AbstractLink | Mapping[str, AbstractLink] | None = None,
    largest_view_zenith: float | None = None,
    seed: int = 0,
    partial: Callable[[xr.DataTree], object] | None = None,
    progress: Progress | None = None,
) -> xr.DataTree:
    """Compare methods on one capture with a reference posterior: their errors and their costs.

    Args:
        capture: A Dataset of the capture schema; validated here.
        methods: Methods by name; by default `polar_bayes.methods.STUDY_METHODS`.
        overrides: What else is changed, one at a time, on every method; `()` for the methods alone.
        reference: How well the reference posterior must be known.
        fresh: True runs every trial in a process of its own, so that the first time includes all
            compilation and the memory is its own. False runs them here: much faster, but without
            first times and memory, which would not be theirs.
        model: As for `polar_bayes.fit`; scene, priors, links and largest_view_zenith too.
        scene: A name, a `Scene` or None.
        priors: Overrides.
        links: One link, a mapping or None.
        largest_view_zenith: Unit degree, or None for the set-up's own.
        seed: Of the random numbers.
        partial: Called with the study of the rows so far, after each row but the last.
        progress: Called with the name of a stage and the fraction of it that is done.

    Returns:
        A tree whose group `accuracy` has a row for each method and override (coordinates `method`
        and `override`), and by row and parameter the distances from the reference; see the
        attribute `long_name` of each variable. `polar_bayes.summary`,
        `accuracy_sentences` and `plot_accuracy` read it.

    Raises:
        CaptureError: The capture does not hold what a fit needs.
        SceneError: No such scene.
        FitError: A prior, link or setting cannot be used, or there is no reference.
    """
    request = resolve(capture, model, scene, priors, links, largest_view_zenith, seed, "double")
    show = progress or no_progress
    trials = _trials(request, STUDY_METHODS if methods is None else methods, tuple(overrides))
    show("reference", 0.0)
    with jax.enable_x64(True):
        # Folded, so that the reference shares no random number with a trial.
        key = jax.random.fold_in(jax.random.key(seed), 7)
        key_search, key_draws = jax.random.split(key)
        problem = make_problem(request, key_search)
        reference_run = run_reference(reference or Reference(), problem, key_draws)
    show("reference", 1.0)
    rows: list[dict[str, Any]] = []

    def study() -> xr.DataTree:
        dataset = _dataset(list(trials)[: len(rows)], rows, reference_run)
        tree = xr.DataTree(children={"accuracy": xr.DataTree(dataset)})
        tree.attrs |= provenance_attrs(
            request,
            accuracy=len(rows),
            fresh_processes=fresh,
            versions={name: version(name) for name in ("polar_bayes", "jax", "numpyro")},
        )
        return tree

    for number, trial in enumerate(trials.values()):
        show("trials", number / len(trials))
        if rows and partial is not None:
            partial(study())
        rows.append(_row(trial, reference_run, fresh=fresh))
    show("trials", 1.0)
    return study()


Trials = dict[tuple[str, str], Trial | PolarBayesError]
"""Trials by names of method and override; an error in place of a trial that cannot be run."""


def _trials(
    request: Request, methods: Mapping[str, AbstractMethod], overrides: tuple[AbstractOverride, ...]
) -> Trials:
    """List every method as given, and with every override that changes something."""
    if not isinstance(methods, Mapping) or not methods:
        hint = "give methods by name, as in STUDY_METHODS"
        raise FitError("there is no method", where="accuracy: methods", hint=hint)
    trials: Trials = {}
    for name, method in methods.items():
        if not isinstance(method, AbstractMethod):
            what = f"a {type(method).__name__} is not a method"
            hint = "give settings such as polar_bayes.methods.Nuts()"
            raise FitError(what, where=f"accuracy: methods[{name!r}]", hint=hint)
        trials[str(name), AS_GIVEN] = Trial(request, method)
    for override in overrides:
        for name, method in methods.items():
            try:
                changed = override.apply(request, method)
            except PolarBayesError as error:  # an override that fails is a row of every method
                trials[str(name), override.name] = error
                continue
            if changed is not None:
                trials[str(name), override.name] = Trial(*changed)
    return trials


def _row(trial: Trial | PolarBayesError, reference: ReferenceRun, *, fresh: bool) -> dict[str, Any]:
    """Return distances, diagnostics and costs of one trial by name; NaN where the trial failed."""
    row: dict[str, Any] = {
        **{name: np.full(len(reference.labels), np.nan) for name in DISTANCES},
        **dict.fromkeys((*DIAGNOSTICS, "seconds_again", *COSTS_OF_PROCESS), np.nan),
    }
    try:
        if isinstance(trial, PolarBayesError):
            raise trial
        found = run_in_subprocess(trial) if fresh else run_trial(trial)
    except PolarBayesError as error:  # a method that fails is a row, too
        return row | {"problems": str(error)}
    shared, ours, theirs = np.intersect1d(found.labels, reference.labels, return_indices=True)
    draws, expected = (
        x.reshape(shared.size, -1) for x in (found.draws[ours], reference.draws[theirs])
    )
    for name, values in distances(draws, expected).items():
        row[name][theirs] = values
    costs = ("seconds_again", *(COSTS_OF_PROCESS if fresh else ()))
    row |= {name: getattr(found.posterior, name) for name in DIAGNOSTICS}
    row |= {name: getattr(found, name) for name in costs}
    return row | {"problems": "; ".join(found.posterior.problems)}


def _dataset(
    names: list[tuple[str, str]], rows: list[dict[str, Any]], reference: ReferenceRun
) -> xr.Dataset:
    draws = reference.draws.reshape(len(reference.labels), -1)
    columns: dict[str, tuple[Any, Any]] = {
        name: ("row", np.array([row[name] for row in rows], float))
        for name in (*DIAGNOSTICS, "seconds_again", *COSTS_OF_PROCESS)
    }
    for name in DISTANCES:
        columns[name] = ("row", "parameter"), np.stack([row[name] for row in rows])
    columns["problems"] = ("row", np.array([row["problems"] for row in rows], object))
    columns |= {
        "reference_mean": ("parameter", draws.mean(axis=1)),
        "reference_sd": ("parameter", draws.std(axis=1)),
        "reference_mean_error": ("parameter", reference.mean_error),
        "reference_sd_error": ("parameter", reference.sd_error),
        "reference_wasserstein": ("parameter", reference.wasserstein),
    }
    methods, overrides = (np.array(texts, object) for texts in zip(*names, strict=True))
    return xr.Dataset(
        {
            name: (*columns[name], {"long_name": long_name, "units": units})
            for name, (long_name, units) in DESCRIPTIONS.items()
        },
        coords={
            "method": ("row", methods),
            "override": ("row", overrides),
            "parameter": np.array(reference.labels, object),
        },
        attrs={
            "reference": reference.method,
            "reference_draws": int(draws.shape[1]),
            "reference_ess": float(reference.posterior.ess),
            "reference_r_hat": float(reference.posterior.r_hat),
            "reference_error": reference.error,
            "reference_doubts": "; ".join(reference.doubts),
        },
    )
