"""Forward selection of a scene, from simple to complex, by leave-one-out cross-validation.

The simplest candidate is fitted first. Then every extension by one part is; the one that predicts
best is taken if it gains more than the standard error of the gain, or if it gains at all and the
criticism of the present scene finds that something is left to explain. Where a body is added, the
other bodies are compared with it before anything else is. When no extension is taken, or so many
fits were made, alternatives to the present scene are fitted, so that what cannot be told apart is
compared. Layers that nobody sees, films and the back of a plate, come last.

Source:
    Vehtari, Gelman & Gabry (2017), Stat. Comput. 27, 1413 (PSIS-LOO and the error of differences);
    Sivula, Magnusson, Matamoros & Vehtari (2020), arXiv:2008.10296 (differences below 4 are small);
    Yao, Vehtari, Simpson & Gelman (2018), Bayesian Analysis 13, 917 (stacking; Bayesian bootstrap).
"""

import contextlib
import dataclasses
import functools
import math
import time
import warnings
from collections.abc import Callable, Container, Iterable, Mapping
from typing import Any

import jax
import numpy as np
import pandas as pd
import xarray as xr
from numpyro import distributions as dist

from polar_bayes.capture.plausibility import allowing_prior, indices_by_eye
from polar_bayes.capture.schema import validate
from polar_bayes.diagnostics.compare import compare_predictions
from polar_bayes.diagnostics.criticism import criticize
from polar_bayes.diagnostics.predictive import predictive_checks
from polar_bayes.diagnostics.view import FitView, view_of
from polar_bayes.errors import FitError, SceneError, one_line
from polar_bayes.inference.checks import NEAR_BOUND
from polar_bayes.inference.problem import make_problem
from polar_bayes.inference.request import Request, resolve
from polar_bayes.inference.result import CENTRAL_95, bounds_of
from polar_bayes.methods.importance import Importance
from polar_bayes.numerics.compile import OutOfTimeError, run_until
from polar_bayes.observation.links import AbstractLink
from polar_bayes.physics.instrument import Discrepancy
from polar_bayes.physics.scene import Scene
from polar_bayes.physics.variants import unseen_layers
from polar_bayes.priors import INDICES, parse_prior, support_bounds
from polar_bayes.progress import Progress, no_progress, with_progress
from polar_bayes.scenes.fit_request import fit_request
from polar_bayes.scenes.library import (
    Choice,
    SceneLibrary,
    default_links,
    named_setup,
    scene_library,
)
from polar_bayes.scenes.neighbors import suits_index
from polar_bayes.scenes.sentences import SceneComparison, is_apart
from polar_bayes.setups import SETUPS, UNSTATED, Setup

MAX_FITS = 12
"""Largest number of candidates that forward selection fits."""

MAX_ALTERNATIVES = 4
"""Largest number of additional alternatives; other slopes and bodies come first."""

TIME_WAS_UP = "the time was up"
"""Reason for not fitting a scene within the seconds of a comparison."""

LEAST_WEIGHT = 0.05
"""Stacking weight below which a scene is excluded."""

BOOTSTRAPS, EM_STEPS = 400, 300
"""Replicates of the Bayesian bootstrap of stacking weights, and steps of each optimization."""


@dataclasses.dataclass(frozen=True, eq=False)
class _Fit:
    """One fitted candidate."""

    view: FitView
    request: Request
    seconds: float
    findings: pd.Series
    pointwise: np.ndarray
    unreliable: int
    index_bound: float

    @property
    def elpd(self) -> float:
        return float(self.pointwise.sum())

    @property
    def unexplained(self) -> bool:
        """Whether criticism says that the readings hold more than the scene."""
        checks = {"priors", "noise", "angle", "wavelength", "leave-one-out"}
        return not checks.isdisjoint(self.findings.index)

    @property
    def is_contradicted(self) -> bool:
        """True if parameters lie where their priors have almost no probability."""
        return self.findings.get("priors") == "problem"


@with_progress
def compare_scenes(
    capture: xr.Dataset,
    scenes: Mapping[str, Scene] | None = None,
    *,
    model: str | Callable = "per_material",
    priors: Mapping[str, dist.Distribution] | None = None,
    links: AbstractLink | Mapping[str, AbstractLink] | None = None,
    largest_view_zenith: float | None = None,
    seed: int = 0,
    precision: str = "double",
    seconds: float | None = None,
    progress: Progress | None = None,
) -> SceneComparison:
    """Compare scenes for one capture, from simple to complex.

    Each scene is fitted by adaptive importance sampling. Scenes remain that predict readings as
    well as the best one, within two standard errors of the difference or 4 nat, and whose
    parameters their priors allow; their weights are stacking weights.

    Args:
        capture: A Dataset of the capture schema; validated here.
        scenes: Scenes by name, all of which are fitted; by default those that
            `polar_bayes.scenes.scene_library` allows, as far as the readings call for them.
        model: As for `polar_bayes.fit`.
        priors: As for `polar_bayes.fit`; each for the scenes that read its parameter.
        links: As for `polar_bayes.fit`; by default those of the set-up that the capture names, or
            those that its variables and stated errors allow.
        largest_view_zenith: As for `polar_bayes.fit`.
        seed: As for `polar_bayes.fit`.
        precision: As for `polar_bayes.fit`.
        seconds: Wall time of the comparison, > 0; by default as long as it takes. Only the first
            scene is always fitted; what is not done by then is left out, and named.
        progress: Called with the name of a stage and the fraction of it that is done.

    Returns:
        The comparison, with tables of scenes and of the intervals of material parameters.

    Raises:
        CaptureError: The capture does not hold what a fit needs.
        SceneError: Something is no scene.
        FitError: A model, prior or link cannot be used, or no scene could be fitted.

    Source:
        Vehtari, Gelman and Gabry (2017), Statistics and Computing 27, 1413 (leave-one-out); Yao et
        al. (2018), Bayesian Analysis 13, 917 (stacking).
    """
    arguments = FitArguments(
        validate(capture), model, priors, links, largest_view_zenith, seed, precision,
        seconds=seconds,
    )  # fmt: skip
    if scenes is None:
        return compare_candidates(arguments, progress or no_progress)
    fits = _Fits(arguments.among(_checked(scenes).values()), progress or no_progress)
    with jax.enable_x64(precision == "double"):
        fits.add_all({one_line(str(name)): scene for name, scene in scenes.items()}, len(scenes))
    return _comparison(fits)


def compare_candidates(arguments: "FitArguments", progress: Progress) -> SceneComparison:
    """Compare the scenes that the capture allows, until readings need no more parts."""
    library = scene_library(arguments.capture, arguments.variables)
    simplest = library.scene(library.simplest)
    fringes = "wavelength" in arguments.capture.coords
    layered = [each.apply(simplest) for each in unseen_layers(simplest, has_wavelength=fringes)]
    arguments = arguments.among([*library.single_parts(), *layered]).measured
    lifted = lifted_prior(arguments, simplest)
    fits = _Fits(arguments.with_priors(lifted), progress)
    with jax.enable_x64(arguments.precision == "double"):
        _select(fits, library)
        found = _comparison(fits, *_choose_layers(fits, fringes=fringes))
    if not lifted:
        return found
    stated = {name: arguments.request(scene) for name, scene in found.scenes.items()}
    return dataclasses.replace(found, lifted=lifted, requests=stated)


def lifted_prior(arguments: "FitArguments", scene: Scene) -> dict[str, dist.Distribution]:
    """Return a prior that includes the index by Brewster's angle if the default does not."""
    # A scene could otherwise win by bending the optics until the index is one that is allowed.
    by_eye = indices_by_eye(arguments.capture)
    if not any(by_eye.values()):
        return {}
    priors, own = arguments.request(scene).priors, arguments.priors or {}
    name = next((name for name in INDICES if name in priors), None)
    if name is None or name in own:
        return {}
    text = allowing_prior(by_eye, support_bounds(priors[name]))
    return {name: parse_prior(text, name)} if text else {}


@dataclasses.dataclass(frozen=True, eq=False)
class FitArguments:
    """Arguments that the fits of all candidates share: all except scene and method."""

    capture: xr.Dataset
    model: str | Callable
    priors: Mapping[str, dist.Distribution] | None
    links: AbstractLink | Mapping[str, AbstractLink] | None
    largest_view_zenith: float | None
    seed: int
    precision: str
    known: Mapping[str, float] | None = None
    setup: Setup | None = None
    scene_parameters: frozenset[str] = frozenset()
    """Parameters that any of the scenes reads."""
    seconds: float | None = None
    """Limit of the comparison's wall time, in seconds; None: no limit."""
    begun: float = dataclasses.field(default_factory=time.perf_counter)

    def __post_init__(self) -> None:
        if self.seconds is not None and not self.seconds > 0.0:
            hint = "give a time above 0, such as 60"
            raise FitError(f"seconds is {self.seconds}", where="compare_scenes", hint=hint)

    @property
    def deadline(self) -> float:
        """End of the comparison, by `time.perf_counter`."""
        return math.inf if self.seconds is None else self.begun + self.seconds

    @property
    def chosen_links(self) -> AbstractLink | Mapping[str, AbstractLink] | None:
        """The given links, or links for a capture without a suitable set-up."""
        return default_links(self.capture) if self.links is None else self.links

    @property
    def variables(self) -> set[str]:
        """Recorded variables that are fitted."""
        links, setup = self.chosen_links, named_setup(self.capture)
        if isinstance(links, AbstractLink):
            return {*links.observables, "intensity"} & set(self.capture)
        names = links if links is not None else setup.links if setup else ()
        return set(names) & set(self.capture)

    def among(self, scenes: Iterable[Scene]) -> "FitArguments":
        """Return the arguments for these scenes."""
        names = frozenset(name for scene in scenes for name in scene.parameters)
        return dataclasses.replace(self, scene_parameters=names)

    @property
    def measured(self) -> "FitArguments":
        """The arguments with an instrument that nobody called perfect."""
        is_named = "setup" in self.capture.attrs
        return self if is_named else dataclasses.replace(self, setup=SETUPS[UNSTATED])

    def with_priors(self, priors: Mapping[str, dist.Distribution]) -> "FitArguments":
        """Return the arguments with these priors added or replaced."""
        return dataclasses.replace(self, priors={**(self.priors or {}), **priors} or None)

    def request(self, scene: Scene) -> Request:
        """Return the request of one scene, without priors that only other scenes read."""
        others = self.scene_parameters - set(scene.parameters)
        own = {name: prior for name, prior in (self.priors or {}).items() if name not in others}
        setup = dataclasses.replace(self.setup, scene=scene) if self.setup else scene
        asked = self.capture, self.model, setup, own or None, self.chosen_links
        limits = self.largest_view_zenith, self.seed, self.precision
        return resolve(*asked, *limits, known=self.known)


class _Fits:
    """Fitted candidates, by name."""

    def __init__(self, arguments: FitArguments, progress: Progress) -> None:
        self.arguments, self.progress = arguments, progress
        self.done: dict[str, _Fit] = {}
        self.failed: dict[str, str] = {}

    @property
    def count(self) -> int:
        """Number of candidates that were tried."""
        return len(self.done) + len(self.failed)

    def add_all(self, scenes: Mapping[str, Scene], most: int) -> None:
        """Fit candidates until a total number of them has been tried."""
        requests = {name: self.arguments.request(scene) for name, scene in scenes.items()}
        waiting = list(requests.values())
        for number, name in enumerate(requests):
            if self.done and time.perf_counter() >= self.arguments.deadline:
                self.failed[name] = TIME_WAS_UP
                continue
            stage = f"comparing scenes: {name} ({self.count + 1} of at most {most})"
            share, deadline = self.count / most, self.arguments.deadline if self.done else math.inf
            self.progress(stage, share)
            work = functools.partial(_fitted, name, waiting[number : number + 2], stage, share)
            try:
                self.done[name] = run_until(deadline, self.progress, work)
            except (FitError, np.linalg.LinAlgError) as error:
                self.failed[name] = one_line(str(error))
            except OutOfTimeError:
                self.failed[name] = TIME_WAS_UP


def _fitted(name: str, requests: list[Request], stage: str, share: float, report: Progress) -> _Fit:
    """Return the fit of the first request, with predictions and criticism."""
    for each in requests:
        _begin_to_compile(each)  # the next one while this one runs
    begun, request = time.perf_counter(), requests[0]

    def progress(*_: object) -> None:  # where a thread that was abandoned ends
        report(stage, share)

    tree = fit_request(request, Importance(), progress, begun, with_comparisons=False)
    view = view_of(tree)
    checks = predictive_checks(view)
    loo = [check.loo for check in checks.values() if check.loo is not None]
    if not loo or len(loo) < len(checks):
        raise FitError("its draws do not predict the readings", where=name, hint="fit it alone")
    levels = criticize(view)["level"]
    findings = levels[levels.isin(["caution", "problem"])]
    return _Fit(
        view,
        request,
        seconds=time.perf_counter() - begun,
        findings=findings,
        pointwise=np.concatenate([each.pointwise for each in loo]),
        unreliable=sum(each.unreliable for each in loo),
        # Under a film the index of a body that hardly shows is where its prior has it.
        index_bound=_index_bound(view)
        if "bounds" in findings.index and request.scene.coat is None
        else float("nan"),
    )


def _index_bound(fit: FitView) -> float:
    """Return the prior bound at which an interval of the index ends; NaN if none."""
    for scalar in fit.scalars:
        if scalar.name in INDICES:
            ends = np.quantile(scalar.draws, CENTRAL_95)
            for bound in bounds_of(fit.provenance, scalar.name):
                if np.abs(ends - bound).min() < NEAR_BOUND * np.ptp(ends):
                    return bound
    return float("nan")


def _begin_to_compile(request: Request) -> None:
    """Trace the programs of a fit now, and compile them in another thread."""
    with contextlib.suppress(FitError):  # told when the fit is done
        problem = make_problem(request, jax.random.key(request.seed))
        Importance().prepare(problem)
        problem.prepare_predictions()


def _checked(scenes: Mapping[str, Scene]) -> Mapping[str, Scene]:
    """Return the caller's scenes; refuse anything else."""
    hint = "give scenes by name, such as {'mirror': Scene(SmoothSurface())}, or leave it out"
    if not isinstance(scenes, Mapping) or not scenes:
        raise FitError("there is nothing to compare", where="compare_scenes: scenes", hint=hint)
    for name, scene in scenes.items():
        if not isinstance(scene, Scene):
            raise SceneError(
                f"{scene!r} is no scene", where=f"compare_scenes: scenes[{name!r}]", hint=hint
            )
    return scenes


def _select(fits: _Fits, library: SceneLibrary) -> None:
    """Run forward selection, then fit the alternatives to the selected scene."""
    best = library.simplest
    _fit_choices(fits, library, [best])
    looked_at_alternatives = False
    refuted: set[str] = set()  # surfaces that are not tried again before the alternatives
    while True:
        extensions = [each for each in library.extensions(best) if each[0] not in refuted]
        _fit_choices(fits, library, extensions)
        refuted |= {each[0] for each in extensions if _is_worse(fits, best, each)} - {best[0]}
        better = _better(fits, best, extensions)
        if better is not None and better[1] != best[1]:
            # Which body it is comes first: systematic errors explain what a wrong body lacks.
            bodies = list(library.other_bodies(better))
            _fit_choices(fits, library, bodies)
            better = _better(fits, better, bodies) or better
        if better is None and not looked_at_alternatives:
            looked_at_alternatives = True
            alternatives = list(library.alternatives(best))
            _fit_choices(fits, library, alternatives, fits.count + MAX_ALTERNATIVES)
            better = _better(fits, best, alternatives)
        if better is None:
            break
        best = better


def _choose_layers(fits: _Fits, *, fringes: bool) -> tuple[list[str], list[str]]:
    """Return scenes that remain, with or without a layer, and undecided layers.

    Systematic errors stand in for layers, so that layers are tried without them. A film makes the
    index that of the body below it, so that it has to be told apart from none.
    """
    bare = list(fits.done)
    clean = [name for name in bare if not fits.done[name].request.scene.has(Discrepancy)]
    if not clean:
        return bare, []
    best, base = (max(names, key=lambda name: fits.done[name].elpd) for names in (bare, clean))

    def fit_layers(bases: Iterable[str], layer: str = "") -> list[str]:
        scenes = {
            f"{name} + {each.name}": each.apply(scene)
            for name in bases
            for scene in [fits.done[name].request.scene]
            for each in unseen_layers(scene, has_wavelength=fringes)
            if layer in ("", each.name)
            and (each.name == "thin film" or suits_index(each.name, index))
        }
        fits.add_all(scenes, fits.count + len(scenes))
        return [name for name in scenes if name in fits.done]

    def gain(name: str, other: str) -> tuple[float, float]:
        return _gain(fits.done[name], fits.done[other])

    posterior = fits.done[base].view.result["posterior"].data_vars
    index = posterior["refractive_index"].to_numpy() if "refractive_index" in posterior else None
    layered = fit_layers([base])
    found = max(layered, key=lambda name: fits.done[name].elpd, default=base)
    if is_apart(*gain(found, base)):
        near = [name for name in clean if name != base and not is_apart(*gain(base, name))]
        layered_base, others = found, fit_layers(near, found.removeprefix(f"{base} + "))
        found = max([found, *others], key=lambda name: fits.done[name].elpd)
        more, error = gain(found, best)
        if not is_apart(-more, error) and (more > 0.0 or not fits.done[found].unexplained):
            return [layered_base, *others], []
    more, error = gain(found, base)
    if more > error and fits.done[found].elpd > fits.done[best].elpd:
        return [*bare, found], []  # it predicts best, if not by much: both answers are stacked
    return bare, [name for name in layered if not is_apart(*gain(best, name))]


def _fit_choices(
    fits: _Fits, library: SceneLibrary, choices: Iterable[Choice], most: int | None = None
) -> None:
    """Fit choices that were not tried yet, up to a total number."""
    most = MAX_FITS if most is None else most
    tried = {*fits.done, *fits.failed}
    new = {name: choice for choice in choices if (name := name_of(choice)) not in tried}
    scenes = {name: library.scene(new[name]) for name in list(new)[: max(most - fits.count, 0)]}
    fits.add_all(scenes, MAX_FITS + MAX_ALTERNATIVES)


def _better(fits: _Fits, best: Choice, choices: Iterable[Choice]) -> Choice | None:
    """Return the best-predicting choice that should replace the current best, if any."""
    fitted = [choice for choice in choices if name_of(choice) in fits.done]
    if not fitted:
        return None
    present = fits.done.get(name_of(best))
    found = max(fitted, key=lambda choice: fits.done[name_of(choice)].elpd)
    if present is None:
        return found
    gain, error = _gain(fits.done[name_of(found)], present)
    enough = gain > error or (present.unexplained and gain > 0.0)
    return found if enough else None


def _is_worse(fits: _Fits, best: Choice, choice: Choice) -> bool:
    """Return whether a choice predicts significantly worse than the current best."""
    if not {name_of(best), name_of(choice)} <= fits.done.keys():
        return False
    gain, error = _gain(fits.done[name_of(choice)], fits.done[name_of(best)])
    return is_apart(-gain, error)


def _gain(one: _Fit, other: _Fit) -> tuple[float, float]:
    """Return the gain in elpd of one fit over another, and its standard error, in nats."""
    gain = one.pointwise - other.pointwise
    return float(gain.sum()), float(np.sqrt(gain.size * gain.var()))


def name_of(choice: Choice) -> str:
    """Return the name of a choice, made of its parts."""
    return " + ".join(filter(None, choice))


# --- Which scenes remain, and the tables ----------------------------------------------------------


def _comparison(
    fits: _Fits, allowed: Container[str] | None = None, undecided: Iterable[str] = ()
) -> SceneComparison:
    if not fits.done:
        reasons = "; ".join(f"{name}: {why}" for name, why in fits.failed.items())
        raise FitError(
            f"no scene could be fitted ({reasons})",
            where="compare_scenes",
            hint="compare scenes of one material at a time, or give priors",
        )
    table = _predictions(fits.done)
    remaining = _remaining(fits.done, table, allowed)
    weights = pd.Series(
        stacking_weights(np.stack([fits.done[name].pointwise for name in remaining], axis=1)),
        index=remaining,
    )
    weights = weights[weights >= LEAST_WEIGHT]
    table["weight"] = (weights / weights.sum()).reindex(table.index).fillna(0.0)
    ordered = {name: fits.done[name] for name in table.index}
    table["seconds"] = [fit.seconds for fit in ordered.values()]
    table["index_bound"] = [fit.index_bound for fit in ordered.values()]
    table["criticism"] = [", ".join(fit.findings.index) for fit in ordered.values()]
    intervals = _intervals({name: fit.view for name, fit in ordered.items()})
    return SceneComparison(
        table=table,
        intervals=intervals,
        between=between_scenes(intervals, table["weight"]),
        scenes={name: fit.request.scene for name, fit in ordered.items()},
        fits={name: fit.view.result for name, fit in ordered.items()},
        left_out=fits.failed,
        requests={name: fit.request for name, fit in ordered.items()},
        undecided=tuple(undecided),
    )


def _predictions(fits: Mapping[str, _Fit]) -> pd.DataFrame:
    """Return leave-one-out predictions of each fit, best first."""
    columns = ["elpd", "se", "elpd_diff", "dse", "weight", "unreliable"]
    if len(fits) == 1:
        ((name, fit),) = fits.items()
        error = float(np.sqrt(fit.pointwise.size * fit.pointwise.var()))
        row = [fit.elpd, error, 0.0, 0.0, 1.0, fit.unreliable]
        return pd.DataFrame([row], columns=columns, index=pd.Index([name]))
    with warnings.catch_warnings():
        # None is declared the best one: scenes that are not told apart are stacked.
        warnings.filterwarnings("ignore", "Difference in performance potentially due to chance")
        table, left_out = compare_predictions({name: fit.view for name, fit in fits.items()})
    if table.empty:
        raise FitError(
            " ".join(left_out.values()), where="compare_scenes", hint="give scenes of one capture"
        )
    return table[columns]


def _remaining(
    fits: Mapping[str, _Fit], table: pd.DataFrame, allowed: Container[str] | None
) -> list[str]:
    """Return scenes not significantly worse than the best that priors allow, if any."""
    apart = is_apart(table["elpd_diff"].abs(), table["dse"])
    near = [str(name) for name in table.index[~apart] if allowed is None or name in allowed]
    near = near or [next(str(name) for name in table.index if name in (allowed or fits))]
    possible = [name for name in near if not fits[name].is_contradicted]
    return possible or near


def stacking_weights(pointwise: np.ndarray) -> np.ndarray:
    """Return stacking weights (scene,) of elpd (reading, scene), by Bayesian bootstrap."""
    # The optimum alone is often a corner: of two scenes that predict alike it takes one.
    readings, scenes = pointwise.shape
    density = np.exp(pointwise - pointwise.max(axis=1, keepdims=True))
    shares = np.random.default_rng(0).dirichlet(np.ones(readings), BOOTSTRAPS)
    weights = np.full((BOOTSTRAPS, scenes), 1.0 / scenes)
    for _ in range(EM_STEPS):  # the weights of a mixture whose components are known
        weights = weights * ((shares / (weights @ density.T)) @ density)
    return weights.mean(axis=0)


def _intervals(fits: Mapping[str, FitView]) -> pd.DataFrame:
    """Return the material parameters of each fit."""
    rows: dict[tuple[str, str], Any] = {}
    for name, fit in fits.items():
        for scalar in fit.scalars:
            if scalar.is_material:
                draws = scalar.draws.ravel()
                ends = np.quantile(draws, CENTRAL_95)
                rows[scalar.label, name] = (draws.mean(), draws.std(), *ends)
    labels = list(dict.fromkeys(label for label, _ in rows))
    order = [(label, name) for label in labels for name in fits if (label, name) in rows]
    table = pd.DataFrame([rows[key] for key in order], columns=["mean", "sd", "q2.5", "q97.5"])
    table.index = pd.MultiIndex.from_tuples(order, names=["parameter", "scene"])
    return table


def between_scenes(intervals: pd.DataFrame, weights: pd.Series) -> pd.Series:
    """Return the share of variance between scenes, by the law of total variance."""
    remaining = weights[weights > 0.0]
    found = {}
    for label in dict.fromkeys(intervals.index.get_level_values(0)):
        rows = intervals.loc[label]
        if set(remaining.index) <= set(rows.index):
            rows = rows.loc[remaining.index]
            mean = float(np.sum(remaining * rows["mean"]))
            between = float(np.sum(remaining * (rows["mean"] - mean) ** 2))
            total = between + float(np.sum(remaining * rows["sd"] ** 2))
            found[label] = between / total if total > 0.0 else 0.0
    return pd.Series(found, dtype=float)
