"""Choice of effects: a full scene without the effects that a capture cannot show.

Each effect is left out alone, then all that change little are left out together (backward
elimination); while together they change too much, the effect that alone changes most is restored.
"""

import dataclasses
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.metadata import version
from typing import Any, override

import jax
import numpy as np
import pandas as pd
import xarray as xr
from numpyro import distributions as dist

from polar_bayes.errors import FitError, SceneError
from polar_bayes.inference.files import COSTS
from polar_bayes.inference.request import resolve
from polar_bayes.observation.links import AbstractLink
from polar_bayes.physics.scene import FULL_SCENES, Scene
from polar_bayes.physics.variants import (
    Effect,
    KeyPath,
    effects_of,
    find_effects,
    parts_of,
    simplify,
)
from polar_bayes.priors import resolve_priors
from polar_bayes.progress import Progress, no_progress, with_progress
from polar_bayes.scenes.posterior_change import Baseline, PosteriorChange, SceneDensities

# --- Selection of effects -------------------------------------------------------------------------


def find_forced(
    effects: Sequence[Effect], keep: str | Iterable[str], drop: str | Iterable[str]
) -> tuple[list[Effect], list[Effect]]:
    """Return the effects that the user requests to keep, and to drop."""

    def find(names: str | Iterable[str], where: str) -> list[Effect]:
        names = (names,) if isinstance(names, str) else names
        return [effect for name in names for effect in find_effects(name, effects, where)]

    kept, dropped = find(keep, "keep"), find(drop, "drop")
    for effect in dropped:
        if effect in kept:
            raise SceneError(
                "the effect is in both keep and drop", where=effect.name, hint="remove it from one"
            )
    return kept, dropped


class EffectSelection:
    """Changes by leaving out each effect, and the scene with the effects that are kept."""

    scene: Scene
    selected_from: Baseline
    """Full scene without the effects that the user drops: the reference of comparisons."""
    combined: PosteriorChange
    """Change of the posterior by the selected scene."""

    def __init__(
        self,
        densities: SceneDensities,
        full: Scene,
        effects: Sequence[Effect],
        parameters: tuple[str, ...] | None,
        tolerance: float,
    ) -> None:
        self.densities, self.full, self.tolerance = densities, full, tolerance
        self.baseline = densities.baseline(full, parameters)
        density = self.baseline.fit.density
        for name in parameters or ():
            if name not in (*density.labels, *density.sites):
                raise FitError(
                    "the scene with everything on has no such parameter",
                    where=f"parameters: {name!r}",
                    hint=f"give any of {', '.join(dict.fromkeys(density.sites))}",
                )
        self.changes: dict[Effect, PosteriorChange] = {}
        for number, effect in enumerate(effects):
            self.changes[effect] = self.baseline.compare(densities.density(effect.apply(full)))
            densities.progress("comparing effects", (number + 1) / len(effects))
        self.kept: dict[Effect, bool] = {}
        self.reasons: dict[Effect, str] = {}

    def change(self, effect: Effect) -> float:
        """Return the largest change of a judged parameter without the effect."""
        return self.baseline.largest_change(self.changes[effect])

    def select(self, keep: Sequence[Effect], drop: Sequence[Effect]) -> None:
        """Leave out all effects that change little, and those that the user drops."""
        forced = [options[0] for options in self._by_key_path(drop).values()]
        baseline = self._without(forced)
        forced_paths = {effect.key_path for effect in forced}
        options = self._by_key_path(
            effect
            for effect in self.changes
            if self.change(effect) <= self.tolerance
            and effect.key_path not in forced_paths
            and not self._removes_any(effect, keep)
        )
        remarks = dict.fromkeys((*forced, *keep), "by your choice")
        while True:
            optional = [effects[0] for effects in options.values() if effects]
            scene = simplify(self.full, [*forced, *optional])
            combined = baseline.compare(self.densities.density(scene))
            if baseline.largest_change(combined) <= self.tolerance or not optional:
                break
            worst = max(optional, key=self.change)
            options[worst.key_path].remove(worst)
            remarks[worst] = (
                f"without all other effects that may be dropped, {baseline.describe(combined)}"
            )
        self.scene, self.selected_from, self.combined = scene, baseline, combined
        dropped = {effect.key_path: effect for effect in (*forced, *optional)}
        left = [part for _, part in parts_of(scene)]
        for effect in self.changes:
            instead = dropped.get(effect.key_path)
            self.kept[effect] = instead is None and effect.part in left
            remark = remarks.get(effect, "")
            if not remark and instead not in (None, effect):
                remark = f"{instead.name} instead"
            elif not remark and instead is None and not self.kept[effect]:
                remark = "it is removed with the part that contains it"
            self.reasons[effect] = self._reason(effect, remark)

    def _without(self, forced: list[Effect]) -> Baseline:
        """Return the baseline without the effects that the user drops."""
        if not forced:
            return self.baseline
        bare = simplify(self.full, forced)
        fit = self.baseline.compare(self.densities.density(bare)).fit
        if not fit.found:
            return self.densities.baseline(bare, self.baseline.names)
        return dataclasses.replace(self.baseline, fit=fit)

    def _by_key_path(self, effects: Iterable[Effect]) -> dict[KeyPath, list[Effect]]:
        """Group effects by the path of their part, replacements with fewest operations first."""

        def operations(effect: Effect) -> float:
            return self.densities.density(effect.apply(self.full)).operations

        groups: dict[KeyPath, list[Effect]] = {}
        for effect in sorted(effects, key=operations):
            groups.setdefault(effect.key_path, []).append(effect)
        return groups

    def _removes_any(self, effect: Effect, keep: Sequence[Effect]) -> bool:
        """Return whether leaving out the effect would remove a part that is to be kept."""
        rest = [part for _, part in parts_of(effect.apply(self.full))]
        return any(kept.part not in rest for kept in keep)

    def _reason(self, effect: Effect, remark: str) -> str:
        """Explain why an effect is kept or dropped."""
        change, is_kept = self.change(effect), self.kept[effect]
        found = self.baseline.describe(self.changes[effect])
        if change <= self.tolerance:
            which = "parameter" if self.baseline.names is None else "judged parameter"
            found = f"alone no {which} changes by more than {max(change, 0.001):.2g} sd"
            remark = remark or ("a part inside it is kept by your choice" if is_kept else "")
        missing = [] if is_kept else self.baseline.missing(self.changes[effect])
        unfitted = f"not fitted then: {', '.join(missing)}" if missing else ""
        return "; ".join(text for text in (remark, found, unfitted) if text)


# --- The ledger: what each effect changes and costs -----------------------------------------------


EFFECT, PARAMETER, BOTH = ("effect",), ("parameter",), ("effect", "parameter")

DESCRIPTIONS: Mapping[str, tuple[str, str]] = {
    "largest_move": ("largest change of a predicted reading, in sds of its noise", "1"),
    "rms_move": ("root mean square of the same over all valid readings", "1"),
    "shift": ("shift of the posterior without the effect, in posterior sds", "1"),
    "sd_ratio": ("posterior sd without the effect over that with it", "1"),
    "change": ("largest change of a judged parameter: shift, or sd ratio minus 1", "1"),
    "operations": ("operations that the effect adds to one log density", "1"),
    "compile_seconds": ("time that the effect adds to compiling the log density", "s"),
    "run_seconds": ("time that the effect adds to one log density", "s"),
    "kept": ("whether the scene keeps the effect", "1"),
    "forced": ("whether the user decided that", "1"),
    "reason": ("why", "1"),
    "judged": ("whether the parameter decides", "1"),
    "combined_shift": ("shift when all that is dropped is left out together, posterior sds", "1"),
    "combined_sd_ratio": ("posterior sd over that of the full scene, likewise", "1"),
}


def make_ledger(
    selection: EffectSelection, forced: Sequence[Effect], settings: Mapping[str, str | float | int]
) -> xr.Dataset:
    """Combine changes, costs and selection into one dataset."""
    full, costs = selection.full, selection.densities.costs()
    effects, changes = tuple(selection.changes), tuple(selection.changes.values())
    labels = selection.baseline.fit.density.labels
    shape = (len(effects), len(labels))

    def of_all_labels(values: np.ndarray) -> list[float]:
        """Insert NaN for parameters that the user dropped."""
        known = dict(zip(selection.selected_from.fit.density.labels, values, strict=True))
        return [known.get(label, math.nan) for label in labels]

    columns: dict[str, tuple[tuple[str, ...], Any]] = {
        "largest_move": (EFFECT, [each.largest_move for each in changes]),
        "rms_move": (EFFECT, [each.rms_move for each in changes]),
        "shift": (BOTH, np.reshape([each.shift for each in changes], shape)),
        "sd_ratio": (BOTH, np.reshape([each.sd_ratio for each in changes], shape)),
        "change": (EFFECT, [selection.change(effect) for effect in effects]),
        "kept": (EFFECT, np.asarray([selection.kept[effect] for effect in effects], bool)),
        "forced": (EFFECT, [effect in forced for effect in effects]),
        "reason": (EFFECT, _texts(selection.reasons[effect] for effect in effects)),
        "judged": (PARAMETER, selection.baseline.judged),
        "combined_shift": (PARAMETER, of_all_labels(selection.combined.shift)),
        "combined_sd_ratio": (PARAMETER, of_all_labels(selection.combined.sd_ratio)),
    }
    attributes: dict[str, str | float | int] = {
        **settings,
        "combined_change": selection.selected_from.largest_change(selection.combined),
        "full_scene": repr(full),
        "chosen_scene": repr(selection.scene),
        "versions": json.dumps({n: version(n) for n in ("polar_bayes", "jax", "numpyro")}),
    }
    without = [costs[effect.apply(full)] for effect in effects]
    for name in COSTS:
        whole = costs[full][name]
        columns[name] = (EFFECT, [whole - cost[name] for cost in without])
        attributes[f"full_{name}"] = whole
        attributes[f"chosen_{name}"] = costs[selection.scene][name]
    return xr.Dataset(
        {
            name: (*columns[name], {"long_name": long_name, "units": units})
            for name, (long_name, units) in DESCRIPTIONS.items()
        },
        coords={
            "effect": _texts(effect.name for effect in effects),
            "path": (EFFECT, _texts(effect.path for effect in effects)),
            "parameter": _texts(labels),
        },
        attrs=attributes,
    )


def _texts(texts: Iterable[str]) -> np.ndarray:
    return np.asarray(list(texts), object)


def ledger_table(ledger: xr.Dataset) -> pd.DataFrame:
    """Return one row for each effect, as text.

    `data` is the largest move of a reading [noise sd]; `shift` [posterior sd] and `sd` are the
    largest changes of a judged parameter; `operations` and `time` are shares of the full scene's.
    """
    judged = ledger.isel(parameter=ledger["judged"].to_numpy().astype(bool))
    rows = {}
    for name in ledger["effect"].to_numpy():
        row = judged.sel(effect=name)
        rows[str(name)] = {
            "data": f"{float(row['largest_move']):.2g}",
            "shift": _largest(row["shift"].to_numpy(), "+.2f"),
            "sd": _largest(row["sd_ratio"].to_numpy() - 1.0, "+.0%"),
            "operations": _share(float(row["operations"]), ledger.attrs["full_operations"]),
            "time": _share(float(row["run_seconds"]), ledger.attrs["full_run_seconds"]),
            "result": f"{'kept' if bool(row['kept']) else 'dropped'}: {row['reason'].item()}",
        }
    columns = ["data", "shift", "sd", "operations", "time", "result"]
    return pd.DataFrame.from_dict(rows, orient="index", columns=columns)


def ledger_sentences(ledger: xr.Dataset) -> list[str]:
    """State how many effects are kept, and what leaving out the others changes and saves."""
    kept, forced = (ledger[name].to_numpy().astype(bool) for name in ("kept", "forced"))
    if not kept.size:
        return ["The scene has no effect that could be left out."]
    sentences = [f"{np.sum(kept)} of {kept.size} effects are kept."]
    if (~kept & ~forced).any():
        which = "parameter" if bool(ledger["judged"].all()) else "judged parameter"
        sentences.append(
            f"Leaving out the others together changes no {which} by more than "
            f"{max(float(ledger.attrs['combined_change']), 0.001):.2g} posterior sd."
        )
    if (~kept & forced).any():
        names = ", ".join(map(str, ledger["effect"].to_numpy()[~kept & forced]))
        sentences.append(f"By your choice {names} is left out.")
    if not kept.all():
        before, after = (1e3 * ledger.attrs[f"{which}_run_seconds"] for which in ("full", "chosen"))
        sentences.append(f"One log density takes {after:.2g} ms in place of {before:.2g} ms.")
    return sentences


def ledger_summary(ledger: xr.Dataset) -> dict[str, Any]:
    """Return the effects table in types of JSON; values that are not finite become None.

    Args:
        ledger: A ledger.

    Returns:
        Keys effects (name to its numbers, `kept`, `forced` and `reason`), full, chosen (operations
        and seconds of one log density), combined_change, tolerance, seed and scene.
    """
    labels = [str(label) for label in ledger["parameter"].to_numpy()]
    single = [str(name) for name in ledger.data_vars if ledger[name].dims == EFFECT]
    effects = {}
    for name in ledger["effect"].to_numpy():
        row = ledger.sel(effect=name)
        effects[str(name)] = {key: _json_value(row[key].item()) for key in single} | {
            key: dict(zip(labels, map(_json_value, row[key].to_numpy().tolist()), strict=True))
            for key in ("shift", "sd_ratio")
        }
    costs = {
        which: {name: _json_value(ledger.attrs[f"{which}_{name}"]) for name in COSTS}
        for which in ("full", "chosen")
    }
    names = ("combined_change", "tolerance", "seed")
    settings = {name: _json_value(ledger.attrs[name]) for name in names}
    return {"effects": effects, **costs, **settings, "scene": ledger.attrs["chosen_scene"]}


def _json_value(value: Any) -> Any:
    """Convert NumPy numbers to Python's, and values that are not finite to None."""
    value = value.item() if isinstance(value, np.generic) else value
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _largest(values: np.ndarray, form: str) -> str:
    """Format the finite value farthest from 0."""
    known = values[np.isfinite(values)]
    return f"{known[np.argmax(np.abs(known))]:{form}}" if known.size else "-"


def _share(part: float, whole: float) -> str:
    share = part / whole if whole > 0.0 else math.nan
    return f"{share:.0%}" if math.isfinite(share) else "-"


# --- The choice -----------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class ChosenScene(Scene):
    """A scene with the table of effects from which it was chosen.

    It is used as any other scene. A fit keeps the ledger in its group `effects`; a scene made from
    it by `dataclasses.replace` has none, because the ledger would no longer be true of it.
    """

    ledger: xr.Dataset | None = dataclasses.field(  # type: ignore[misc]
        default=None, init=False, compare=False, repr=False
    )
    """Changes and costs of each effect; `polar_bayes.scenes.effects` explains them."""

    @override
    def __repr__(self) -> str:
        return repr(simplify(self, ()))  # as one would write it


@with_progress
def choose_effects(
    capture: xr.Dataset,
    *,
    scene: str | Scene | None = None,
    tolerance: float = 0.1,
    keep: str | Iterable[str] = (),
    drop: str | Iterable[str] = (),
    parameters: Iterable[str] | None = None,
    model: str | Callable = "per_material",
    priors: Mapping[str, dist.Distribution] | None = None,
    links: AbstractLink | Mapping[str, AbstractLink] | None = None,
    largest_view_zenith: float | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> ChosenScene:
    """Choose the effects of a scene that this capture can show.

    Each effect is left out alone. It may go if no parameter then moves by more than `tolerance`
    posterior standard deviations, and none changes its standard deviation by more than that share.
    All that may go is then left out together and judged again; while that fails, the effect that
    changes most comes back.

    Args:
        capture: A Dataset of the capture schema; validated here.
        scene: The scene with everything on, or the name of a set-up; by default the set-up that
            the capture names. `polar_bayes.physics.scene.FULL_SCENES` has the scenes of set-ups.
        tolerance: Posterior standard deviations, > 0.
        keep: Effects that stay, by name, class of the part or path, such as "AngleZero".
        drop: Effects that go, whatever they change; the rule asks what the others change then.
        parameters: Names of the parameters that are judged; by default all but those that only
            the effect itself reads.
        model: As for `polar_bayes.fit`.
        priors: As for `polar_bayes.fit`; for parameters of the scene with everything on.
        links: As for `polar_bayes.fit`.
        largest_view_zenith: As for `polar_bayes.fit`.
        seed: Of the search for the mode.
        progress: Called with the name of a stage and the fraction of it that is done.

    Returns:
        The scene to fit, with its `ledger`.

    Raises:
        CaptureError: The capture does not hold what a fit needs.
        SceneError: No such scene or effect.
        FitError: A prior, link or setting cannot be used, or the full scene has no mode.
    """
    if not (isinstance(tolerance, int | float) and tolerance > 0.0):
        raise FitError(
            f"tolerance is {tolerance!r}",
            where="choose_effects",
            hint="give posterior standard deviations above 0, such as 0.1",
        )
    request = resolve(capture, model, scene, None, links, largest_view_zenith, seed, "double")
    full = simplify(FULL_SCENES.get(request.scene_name, request.scene), ())
    effects = effects_of(full)
    kept, dropped = find_forced(effects, keep, drop)
    names = None if parameters is None else tuple(parameters)
    settings: dict[str, str | float | int] = {
        "tolerance": float(tolerance),
        "largest_view_zenith": request.largest_view_zenith,
        "seed": request.seed,
        "links": json.dumps({name: repr(link) for name, link in request.links.items()}),
    }
    own = {name: p for name, p in request.priors.items() if name in full.parameters}
    priors = {**own, **(priors or {})}
    with jax.enable_x64(True):
        densities = SceneDensities(request, priors, progress or no_progress)
        # Unknown priors are refused before minutes are spent.
        resolve_priors(densities.names_read(full), priors)
        selection = EffectSelection(densities, full, effects, names, float(tolerance))
        selection.select(kept, dropped)
        ledger = make_ledger(selection, [*kept, *dropped], settings)
    fields = (field.name for field in dataclasses.fields(Scene))
    chosen = ChosenScene(**{name: getattr(selection.scene, name) for name in fields})
    object.__setattr__(chosen, "ledger", ledger)
    return chosen
