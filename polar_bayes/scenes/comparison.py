"""Forward selection of a scene, from simple to complex, by leave-one-out cross-validation.

The simplest candidate is fitted first. Then every extension by one part is; the one that predicts
best is taken if it gains more than the standard error of the gain, or if it gains at all and the
criticism of the present scene finds that something is left to explain. When no extension is taken,
the alternatives to the present scene are fitted, so that what cannot be told apart is compared.

Source:
    Vehtari, Gelman & Gabry (2017), Stat. Comput. 27, 1413 (PSIS-LOO and the error of differences);
    Sivula, Magnusson, Matamoros & Vehtari (2020), arXiv:2008.10296 (differences below 4 are small);
    Yao, Vehtari, Simpson & Gelman (2018), Bayesian Analysis 13, 917 (stacking; Bayesian bootstrap).
"""

import dataclasses
import json
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import jax
import numpy as np
import pandas as pd
import xarray as xr
from numpyro import distributions as dist

from polar_bayes.capture.schema import validate
from polar_bayes.diagnostics.compare import compare_predictions
from polar_bayes.diagnostics.criticism import criticize
from polar_bayes.diagnostics.parameters import CENTRAL_95, scalars
from polar_bayes.diagnostics.predictive import predictive_checks
from polar_bayes.errors import FitError, SceneError, one_line
from polar_bayes.inference.fitting import fit_request
from polar_bayes.inference.laplace import Importance
from polar_bayes.inference.request import Request, resolve
from polar_bayes.observation.links import AbstractLink
from polar_bayes.physics.scene import Scene
from polar_bayes.progress import Progress, no_progress, with_progress
from polar_bayes.scenes.candidates import (
    Choice,
    SceneLibrary,
    default_links,
    named_setup,
    scene_library,
)
from polar_bayes.scenes.sentences import ERRORS_APART, SMALL_DIFFERENCE

METHOD = Importance(draws=2048, rounds=6)
"""Of the fits that are compared."""

MAX_FITS = 12
"""Candidates that are fitted at most."""


LEAST_WEIGHT = 0.05
"""Stacking weight below which a scene does not remain."""

BOOTSTRAPS, EM_STEPS = 400, 300
"""Of stacking weights: replicates of the Bayesian bootstrap, and steps of each optimization."""

RESIDUAL_CHECKS = ("priors", "noise", "angle", "wavelength", "leave-one-out")
"""Checks of `criticize` by which a scene has left something unexplained."""


@dataclasses.dataclass(frozen=True, eq=False)
class SceneComparison:
    """Comparison of several scenes for one capture.

    Args:
        table: A row for each scene, best first: elpd and se (nat), elpd_diff and dse (to the best),
            weight (stacking; 0 for a scene that does not remain), unreliable (readings whose Pareto
            k is above 0.7), seconds, criticism (checks that found a caution or problem).
        intervals: A row for each material parameter and scene that has it, in the order of the
            table: mean, sd, q2.5, q97.5 (unit of the parameter).
        between: For each material parameter of all remaining scenes, the share of its stacked
            variance that is between scenes, unit 1.
        scenes: The scenes, by name.
        fits: The fits that were compared, by name.
        left_out: By scene, why it could not be fitted.
        requests: What was fitted, by scene, with every default filled in.
    """

    table: pd.DataFrame
    intervals: pd.DataFrame
    between: pd.Series
    scenes: Mapping[str, Scene]
    fits: Mapping[str, xr.DataTree]
    left_out: Mapping[str, str]
    requests: Mapping[str, Request]

    @property
    def weights(self) -> dict[str, float]:
        """Stacking weights of the scenes that remain, largest first."""
        remaining = self.table["weight"][self.table["weight"] > 0.0]
        return {str(k): float(v) for k, v in remaining.sort_values(ascending=False).items()}

    def to_dataset(self) -> xr.Dataset:
        """The tables as a dataset with the dims scene and parameter, as a fit holds them."""
        table = self.table.rename_axis("scene")
        intervals = self.intervals.rename(columns={"q2.5": "low", "q97.5": "high"})
        labels = list(dict.fromkeys(intervals.index.get_level_values(0)))
        wide = {
            name: intervals[name].unstack(0).reindex(index=table.index, columns=labels).to_numpy()
            for name in ("mean", "sd", "low", "high")
        }
        parts = [repr(self.scenes[name]) for name in table.index]
        texts = {"parts": parts, "criticism": list(table["criticism"])}
        numbers = ("elpd", "se", "elpd_diff", "dse", "weight", "unreliable", "seconds")
        return xr.Dataset(
            {
                **{name: ("scene", table[name].to_numpy(float)) for name in numbers},
                **{name: ("scene", np.array(text, dtype=str)) for name, text in texts.items()},
                **{name: (("scene", "parameter"), values) for name, values in wide.items()},
                "between_share": ("parameter", self.between.reindex(labels).to_numpy(float)),
            },
            {"scene": table.index.to_numpy(str), "parameter": np.array(labels, dtype=str)},
            {"left_out": json.dumps(dict(self.left_out))},
        )


@dataclasses.dataclass(frozen=True, eq=False)
class _Fit:
    """One fitted candidate."""

    tree: xr.DataTree
    request: Request
    seconds: float
    findings: pd.Series
    pointwise: np.ndarray

    @property
    def elpd(self) -> float:
        return float(self.pointwise.sum())

    @property
    def unexplained(self) -> bool:
        """Whether criticism says that the readings hold more than the scene."""
        return any(name in self.findings.index for name in RESIDUAL_CHECKS)

    @property
    def is_contradicted(self) -> bool:
        """Whether the parameters are where their priors hardly allow them."""
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
    setting = Setting(validate(capture), model, priors, links, largest_view_zenith, seed, precision)
    if scenes is None:
        return compare_candidates(setting, progress or no_progress)
    fits = _Fits(setting.among(_checked(scenes).values()), progress or no_progress)
    with jax.enable_x64(precision == "double"):
        for name, scene in scenes.items():
            fits.add(one_line(str(name)), scene, len(scenes))
    return _comparison(fits)


def compare_candidates(setting: "Setting", progress: Progress) -> SceneComparison:
    """Compare the scenes that the capture allows, as far as its readings call for them."""
    library = scene_library(setting.capture, setting.variables)
    fits = _Fits(setting.among(library.single_parts()), progress)
    with jax.enable_x64(setting.precision == "double"):
        _select(fits, library)
    return _comparison(fits)


@dataclasses.dataclass(frozen=True, eq=False)
class Setting:
    """What all candidates have in common: the arguments of a fit but scene and method."""

    capture: xr.Dataset
    model: str | Callable
    priors: Mapping[str, dist.Distribution] | None
    links: AbstractLink | Mapping[str, AbstractLink] | None
    largest_view_zenith: float | None
    seed: int
    precision: str
    scene_parameters: frozenset[str] = frozenset()
    """Parameters that any of the scenes reads."""

    @property
    def chosen_links(self) -> AbstractLink | Mapping[str, AbstractLink] | None:
        """The links given, or those that a capture without a suitable set-up calls for."""
        return default_links(self.capture) if self.links is None else self.links

    @property
    def variables(self) -> set[str]:
        """Recorded variables that are fitted."""
        links, setup = self.chosen_links, named_setup(self.capture)
        if isinstance(links, AbstractLink):
            return {*links.observables, "intensity"} & set(self.capture)
        names = links if links is not None else setup.links if setup else ()
        return set(names) & set(self.capture)

    def among(self, scenes: Iterable[Scene]) -> "Setting":
        """The same, for these scenes."""
        names = frozenset(name for scene in scenes for name in scene.parameters)
        return dataclasses.replace(self, scene_parameters=names)

    def request(self, scene: Scene) -> Request:
        """The request for one scene; a prior for a parameter that only others read is not used."""
        others = self.scene_parameters - set(scene.parameters)
        own = {name: prior for name, prior in (self.priors or {}).items() if name not in others}
        return resolve(
            self.capture,
            self.model,
            scene,
            own or None,
            self.chosen_links,
            self.largest_view_zenith,
            self.seed,
            self.precision,
        )


class _Fits:
    """The candidates that were fitted, by name."""

    def __init__(self, setting: Setting, progress: Progress) -> None:
        self.setting, self.progress = setting, progress
        self.done: dict[str, _Fit] = {}
        self.failed: dict[str, str] = {}

    @property
    def count(self) -> int:
        """Candidates that were tried."""
        return len(self.done) + len(self.failed)

    def add(self, name: str, scene: Scene, most: int) -> None:
        """Fit one candidate."""
        self.progress(f"comparing scenes: {name}", self.count / most)
        begun = time.perf_counter()
        request = self.setting.request(scene)
        try:
            tree = fit_request(request, METHOD, no_progress, begun, with_comparisons=False)
            loo = [check.loo for check in predictive_checks(tree).values()]
            if not loo or any(each is None for each in loo):
                raise FitError(
                    "its draws do not predict the readings", where=name, hint="fit it alone"
                )
            findings = criticize(tree)["level"]
        except (FitError, np.linalg.LinAlgError) as error:
            self.failed[name] = one_line(str(error))
            return
        pointwise = np.concatenate([each.pointwise for each in loo if each is not None])
        findings = findings[findings.isin(["caution", "problem"])]
        seconds = time.perf_counter() - begun
        self.done[name] = _Fit(tree, request, seconds, findings, pointwise)


def _checked(scenes: Mapping[str, Scene]) -> Mapping[str, Scene]:
    """The scenes of a caller, refused where they are none."""
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
    """Forward selection, then the alternatives to what was selected."""
    best = library.simplest
    _fit_choices(fits, library, [best])
    looked_at_alternatives = False
    while fits.count < MAX_FITS:
        extensions = list(library.extensions(best))
        _fit_choices(fits, library, extensions)
        better = _better(fits, best, extensions)
        if better is None and not looked_at_alternatives:
            looked_at_alternatives = True
            alternatives = list(library.alternatives(best))
            _fit_choices(fits, library, alternatives)
            better = _better(fits, best, alternatives)
        if better is None:
            break
        best = better


def _fit_choices(fits: _Fits, library: SceneLibrary, choices: Iterable[Choice]) -> None:
    for choice in choices:
        name = name_of(choice)
        if name not in fits.done and name not in fits.failed and fits.count < MAX_FITS:
            fits.add(name, library.scene(choice), MAX_FITS)


def _better(fits: _Fits, best: Choice, choices: Iterable[Choice]) -> Choice | None:
    """Of some choices the one that predicts best, where it is to replace the best so far."""
    fitted = [choice for choice in choices if name_of(choice) in fits.done]
    if not fitted:
        return None
    present = fits.done.get(name_of(best))
    found = max(fitted, key=lambda choice: fits.done[name_of(choice)].elpd)
    if present is None:
        return found
    gain = fits.done[name_of(found)].pointwise - present.pointwise
    error = float(np.sqrt(gain.size * gain.var()))
    enough = gain.sum() > error or (present.unexplained and gain.sum() > 0.0)
    return found if enough else None


def name_of(choice: Choice) -> str:
    """Name of a choice: its parts."""
    return " + ".join(filter(None, choice))


# --- Which scenes remain, and the tables ----------------------------------------------------------


def _comparison(fits: _Fits) -> SceneComparison:
    if not fits.done:
        reasons = "; ".join(f"{name}: {why}" for name, why in fits.failed.items())
        raise FitError(
            f"no scene could be fitted ({reasons})",
            where="compare_scenes",
            hint="compare scenes of one material at a time, or give priors",
        )
    table = _predictions({name: fit.tree for name, fit in fits.done.items()})
    remaining = _remaining(fits.done, table)
    weights = pd.Series(
        stacking_weights(np.stack([fits.done[name].pointwise for name in remaining], axis=1)),
        index=remaining,
    )
    weights = weights[weights >= LEAST_WEIGHT]
    table["weight"] = (weights / weights.sum()).reindex(table.index).fillna(0.0)
    ordered = {name: fits.done[name] for name in table.index}
    table["seconds"] = [fit.seconds for fit in ordered.values()]
    table["criticism"] = [", ".join(fit.findings.index) for fit in ordered.values()]
    intervals = _intervals({name: fit.tree for name, fit in ordered.items()})
    return SceneComparison(
        table=table,
        intervals=intervals,
        between=between_scenes(intervals, table["weight"]),
        scenes={name: fit.request.scene for name, fit in ordered.items()},
        fits={name: fit.tree for name, fit in ordered.items()},
        left_out=fits.failed,
        requests={name: fit.request for name, fit in ordered.items()},
    )


def _predictions(trees: Mapping[str, xr.DataTree]) -> pd.DataFrame:
    """Leave-one-out predictions of each fit, best first."""
    columns = ["elpd", "se", "elpd_diff", "dse", "weight", "unreliable"]
    table, left_out = compare_predictions(trees)
    if len(trees) == 1:
        (name, tree), *_ = trees.items()
        loo = [check.loo for check in predictive_checks(tree).values() if check.loo is not None]
        pointwise = np.concatenate([each.pointwise for each in loo])
        error = float(np.sqrt(pointwise.size * pointwise.var()))
        unreliable = sum(each.unreliable for each in loo)
        row = [float(pointwise.sum()), error, 0.0, 0.0, 1.0, unreliable]
        return pd.DataFrame([row], columns=columns, index=pd.Index([name]))
    if table.empty:
        raise FitError(
            " ".join(left_out.values()), where="compare_scenes", hint="give scenes of one capture"
        )
    return table[columns]


def _remaining(fits: Mapping[str, _Fit], table: pd.DataFrame) -> list[str]:
    """Scenes that are not told apart from the best, and that their priors allow if any are."""
    apart = table["elpd_diff"].abs() > np.maximum(SMALL_DIFFERENCE, ERRORS_APART * table["dse"])
    near = [str(name) for name in table.index[~apart]]
    allowed = [name for name in near if not fits[name].is_contradicted]
    return allowed or near


def stacking_weights(pointwise: np.ndarray) -> np.ndarray:
    """Stacking weights (scene,) of elpd (reading, scene), averaged over the Bayesian bootstrap."""
    # The optimum alone is often a corner: of two scenes that predict alike it takes one.
    readings, scenes = pointwise.shape
    density = np.exp(pointwise - pointwise.max(axis=1, keepdims=True))
    shares = np.random.default_rng(0).dirichlet(np.ones(readings), BOOTSTRAPS)
    weights = np.full((BOOTSTRAPS, scenes), 1.0 / scenes)
    for _ in range(EM_STEPS):  # the weights of a mixture whose components are known
        weights = weights * ((shares / (weights @ density.T)) @ density)
    return weights.mean(axis=0)


def _intervals(trees: Mapping[str, xr.DataTree]) -> pd.DataFrame:
    """Material parameters of each fit."""
    rows: dict[tuple[str, str], Any] = {}
    for name, tree in trees.items():
        for scalar in scalars(tree["posterior"].to_dataset()):
            if scalar.is_material:
                draws = scalar.draws.ravel()
                ends = np.quantile(draws, CENTRAL_95)
                rows[scalar.label, name] = (draws.mean(), draws.std(), *ends)
    labels = list(dict.fromkeys(label for label, _ in rows))
    order = [(label, name) for label in labels for name in trees if (label, name) in rows]
    table = pd.DataFrame([rows[key] for key in order], columns=["mean", "sd", "q2.5", "q97.5"])
    table.index = pd.MultiIndex.from_tuples(order, names=["parameter", "scene"])
    return table


def between_scenes(intervals: pd.DataFrame, weights: pd.Series) -> pd.Series:
    """Share of the variance between scenes, by the law of total variance."""
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
