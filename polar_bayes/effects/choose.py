"""The effects that a capture can see: everything on, weighed one by one, the rest left out."""

import dataclasses
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.metadata import version
from typing import Any, override

import jax
import numpy as np
import xarray as xr
from numpyro import distributions as dist

from polar_bayes.effects.compare_scenes import Change, Cost, Reference, Scales
from polar_bayes.effects.variants import Effect, Place, effects_of, find_effects, parts_of, simplify
from polar_bayes.errors import FitError, SceneError
from polar_bayes.inference.request import resolve
from polar_bayes.observation.links import AbstractLink
from polar_bayes.physics.scene import FULL_SCENES, Scene
from polar_bayes.priors import resolve_priors
from polar_bayes.progress import Progress, no_progress, with_progress

# --- Which effects a scene keeps: each is weighed alone, then all that may go are weighed together


@dataclasses.dataclass(frozen=True)
class Wishes:
    """What the user decided."""

    keep: tuple[Effect, ...] = ()
    drop: tuple[Effect, ...] = ()

    @classmethod
    def of(
        cls, effects: Sequence[Effect], keep: str | Iterable[str], drop: str | Iterable[str]
    ) -> "Wishes":
        """The effects that words mean."""
        kept, dropped = (
            tuple(effect for word in words for effect in find_effects(word, effects, where))
            for where, words in (("keep", _words(keep)), ("drop", _words(drop)))
        )
        for effect in dropped:
            if effect in kept:
                raise SceneError(
                    "it is both to keep and to drop", where=effect.name, hint="name it in one only"
                )
        return cls(kept, dropped)

    def hold(self, effect: Effect, full: Scene) -> bool:
        """Whether leaving out the effect would take away something that is to be kept."""
        rest = [part for _, part in parts_of(effect.apply(full))]
        return any(kept.part not in rest for kept in self.keep)


@dataclasses.dataclass(frozen=True, eq=False)
class Weighed:
    """Each effect left out alone of the scene with everything on."""

    whole: Reference
    changes: dict[Effect, Change]
    operations: dict[Effect, float]

    def size(self, effect: Effect) -> float:
        """The largest change of a judged parameter without the effect."""
        return self.whole.size(self.changes[effect])

    def by_place(self, effects: Iterable[Effect]) -> dict[Place, list[Effect]]:
        """Effects by the place of their part, the replacement of fewest operations first."""
        places: dict[Place, list[Effect]] = {}
        for effect in sorted(effects, key=self.operations.__getitem__):
            places.setdefault(effect.place, []).append(effect)
        return places


@dataclasses.dataclass(frozen=True, eq=False)
class Verdict:
    """What the rule comes to."""

    scene: Scene
    base: Reference
    combined: Change
    kept: dict[Effect, bool]
    reasons: dict[Effect, str]


def weigh(
    scales: Scales, full: Scene, effects: Sequence[Effect], parameters: tuple[str, ...] | None
) -> Weighed:
    """Leave out each effect alone."""
    whole = scales.reference(full, parameters)
    _check_names(whole, parameters or ())
    changes, operations = {}, {}
    for number, effect in enumerate(effects):
        density = scales.density(effect.apply(full))
        changes[effect] = whole.compare(density)
        operations[effect] = density.compiled.operations
        scales.progress("weighing effects", (number + 1) / len(effects))
    return Weighed(whole, changes, operations)


def decide(
    scales: Scales, full: Scene, weighed: Weighed, wishes: Wishes, tolerance: float
) -> Verdict:
    """Leave out together whatever may go."""
    forced = [options[0] for options in weighed.by_place(wishes.drop).values()]
    base = weighed.whole
    if forced:
        bare = simplify(full, forced)
        base = base.beside(scales.density(bare))
        if not base.peak.found:
            base = scales.reference(bare, base.names)
    free = [
        effect
        for effect in weighed.changes
        if weighed.size(effect) <= tolerance
        and effect.place not in {other.place for other in forced}
        and not wishes.hold(effect, full)
    ]
    chosen, combined, put_back = _go_together(
        lambda gone: base.compare(scales.density(simplify(full, [*forced, *gone]))),
        base,
        weighed,
        free,
        tolerance,
    )
    scene = simplify(full, [*forced, *chosen])
    replaced = {effect.place: effect for effect in (*forced, *chosen)}
    left = [part for _, part in parts_of(scene)]
    kept = {e: e.place not in replaced and e.part in left for e in weighed.changes}
    remarks = dict.fromkeys((*forced, *wishes.keep), "by your choice") | put_back
    for effect in kept.keys() - remarks.keys() - set(chosen):
        remarks[effect] = _remark(effect, replaced, kept[effect])
    reasons = {e: _reason(weighed, e, tolerance, remarks.get(e), kept[e]) for e in kept}
    return Verdict(scene, base, combined, kept, reasons)


def _go_together(
    without: Callable[[list[Effect]], Change],
    base: Reference,
    weighed: Weighed,
    free: list[Effect],
    tolerance: float,
) -> tuple[list[Effect], Change, dict[Effect, str]]:
    """The effects that may go together, what changes then, and why others came back."""
    waiting = weighed.by_place(free)
    put_back: dict[Effect, str] = {}
    while True:
        chosen = [options[0] for options in waiting.values() if options]
        combined = without(chosen)
        if base.size(combined) <= tolerance or not chosen:
            return chosen, combined, put_back
        worst = max(chosen, key=weighed.size)
        waiting[worst.place].remove(worst)
        put_back[worst] = f"with all others that could go, {base.says(combined)}"


def _remark(effect: Effect, replaced: Mapping[Place, Effect], kept: bool) -> str:
    """What decided about an effect that neither the user nor the rule picked."""
    if effect.place in replaced:
        return f"{replaced[effect.place].name} instead"
    return "" if kept else "it goes with the part around it"


def _reason(
    weighed: Weighed, effect: Effect, tolerance: float, remark: str | None, kept: bool
) -> str:
    """Why an effect stays or goes: what decided beside the rule, and what the rule saw."""
    size, change = weighed.size(effect), weighed.changes[effect]
    seen = weighed.whole.says(change)
    if size <= tolerance:
        which = "parameter" if weighed.whole.names is None else "judged parameter"
        seen = f"alone no {which} changes by more than {max(size, 0.001):.2g} sd"
        remark = remark or ("a part of it stays by your choice" if kept else "")
    lost = () if kept else weighed.whole.lost(change)
    unfitted = f"not fitted then: {', '.join(lost)}" if lost else ""
    return "; ".join(text for text in (remark, seen, unfitted) if text)


def _check_names(whole: Reference, parameters: Iterable[str]) -> None:
    density = whole.peak.density
    for name in parameters:
        if name not in density.labels and name not in density.sites:
            raise FitError(
                "the scene with everything on has no such parameter",
                where=f"parameters: {name!r}",
                hint=f"give any of {', '.join(dict.fromkeys(density.sites))}",
            )


def _words(names: str | Iterable[str]) -> tuple[str, ...]:
    return (names,) if isinstance(names, str) else tuple(names)


# --- The ledger of effects: what each changes and costs, kept or not and why, as one dataset ------


EFFECT, PARAMETER, BOTH = ("effect",), ("parameter",), ("effect", "parameter")
COSTS = ("operations", "compile_seconds", "run_seconds")

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
    full: Scene,
    weighed: Weighed,
    verdict: Verdict,
    wishes: Wishes,
    costs: Mapping[Scene, Cost],
    settings: Mapping[str, str | float | int],
) -> xr.Dataset:
    """Put a ledger together."""
    whole, effects, changes = weighed.whole, tuple(weighed.changes), tuple(weighed.changes.values())
    saved = [(costs[full], costs[effect.apply(full)]) for effect in effects]
    labels = whole.peak.density.labels
    shape = (len(effects), len(labels))
    columns: dict[str, tuple[tuple[str, ...], Any]] = {
        "largest_move": (EFFECT, [change.largest_move for change in changes]),
        "rms_move": (EFFECT, [change.rms_move for change in changes]),
        "shift": (BOTH, np.reshape([change.shift for change in changes], shape)),
        "sd_ratio": (BOTH, np.reshape([change.sd_ratio for change in changes], shape)),
        "change": (EFFECT, [weighed.size(effect) for effect in effects]),
        **{
            name: (EFFECT, [getattr(on, name) - getattr(off, name) for on, off in saved])
            for name in COSTS
        },
        "kept": (EFFECT, np.asarray([verdict.kept[effect] for effect in effects], bool)),
        "forced": (EFFECT, [effect in (*wishes.keep, *wishes.drop) for effect in effects]),
        "reason": (EFFECT, _texts(verdict.reasons[effect] for effect in effects)),
        "judged": (PARAMETER, whole.judged),
        "combined_shift": (PARAMETER, _by_label(labels, verdict, verdict.combined.shift)),
        "combined_sd_ratio": (PARAMETER, _by_label(labels, verdict, verdict.combined.sd_ratio)),
    }
    ledger = xr.Dataset(
        {
            name: (dims, values, dict(zip(("long_name", "units"), DESCRIPTIONS[name], strict=True)))
            for name, (dims, values) in columns.items()
        },
        coords={
            "effect": _texts(effect.name for effect in effects),
            "path": (EFFECT, _texts(effect.path for effect in effects)),
            "parameter": _texts(labels),
        },
        attrs=dict(settings) | {"combined_change": verdict.base.size(verdict.combined)},
    )
    for which, scene in (("full", full), ("chosen", verdict.scene)):
        ledger.attrs[f"{which}_scene"] = repr(scene)
        for name in COSTS:
            ledger.attrs[f"{which}_{name}"] = getattr(costs[scene], name)
    packages = ("polar_bayes", "jax", "numpyro")
    ledger.attrs["versions"] = json.dumps({name: version(name) for name in packages})
    return ledger


def _by_label(labels: Iterable[str], verdict: Verdict, values: np.ndarray) -> list[float]:
    """Values for the parameters of the full scene; NaN for what the user dropped."""
    there = dict(zip(verdict.base.peak.density.labels, values, strict=True))
    return [there.get(label, math.nan) for label in labels]


def _texts(texts: Iterable[str]) -> np.ndarray:
    return np.asarray(list(texts), object)


def ledger_table(ledger: xr.Dataset) -> str:
    """The ledger as lines of text, one for each effect.

    Args:
        ledger: Of a scene that `polar_bayes.choose_effects` returned, or read back from a file.

    Returns:
        A table: the largest move of a reading [noise sd]; the largest shift [posterior sd] and
        the largest change of the sd of a judged parameter; the effect's share of the full scene's
        operations and time; kept or dropped, and why.
    """
    heads = ("effect", "data", "shift", "sd", "operations", "time", "")
    rows = [heads, *((name, *cells) for name, cells in ledger_rows(ledger).items())]
    widths = [max(len(row[column]) for row in rows) for column in range(len(heads) - 1)]
    lines = []
    for name, *cells, verdict in rows:
        right = (cell.rjust(width) for cell, width in zip(cells, widths[1:], strict=True))
        lines.append("  ".join((name.ljust(widths[0]), *right, verdict)).rstrip())
    return "\n".join(lines)


def ledger_summary(ledger: xr.Dataset) -> dict[str, Any]:
    """The ledger as JSON can hold it; what is not finite becomes None.

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
        effects[str(name)] = {key: _plain(row[key].item()) for key in single} | {
            key: dict(zip(labels, map(_plain, row[key].to_numpy().tolist()), strict=True))
            for key in ("shift", "sd_ratio")
        }
    costs = {
        which: {name: _plain(ledger.attrs[f"{which}_{name}"]) for name in COSTS}
        for which in ("full", "chosen")
    }
    said = {name: _plain(ledger.attrs[name]) for name in ("combined_change", "tolerance", "seed")}
    return {"effects": effects, **costs, **said, "scene": ledger.attrs["chosen_scene"]}


def ledger_rows(ledger: xr.Dataset) -> dict[str, tuple[str, ...]]:
    """The cells of each effect's row as text: data, shift, sd, operations, time, verdict."""
    judged = ledger["judged"].to_numpy().astype(bool)
    rows: dict[str, tuple[str, ...]] = {}
    for index, name in enumerate(ledger["effect"].to_numpy()):
        row = ledger.isel(effect=index)
        shift = row["shift"].to_numpy()[judged]
        width = row["sd_ratio"].to_numpy()[judged] - 1.0
        shares = (
            _ratio(float(row[cost]), ledger.attrs[f"full_{cost}"])
            for cost in ("operations", "run_seconds")
        )
        verdict = "kept" if bool(row["kept"]) else "dropped"
        rows[str(name)] = (
            f"{float(row['largest_move']):.2g}",
            _signed(_furthest(shift), ".2f"),
            _signed(_furthest(width), ".0%"),
            *(_signed(share, ".0%").removeprefix("+") for share in shares),
            f"{verdict}: {row['reason'].item()}",
        )
    return rows


def ledger_sentence(ledger: xr.Dataset) -> str:
    """What the ledger comes to, in one sentence.

    Args:
        ledger: A ledger.

    Returns:
        How many effects stay, what leaving out the others changes, and what it saves.
    """
    kept, forced = (ledger[name].to_numpy().astype(bool) for name in ("kept", "forced"))
    if not kept.size:
        return "The scene has no effect that could be left out."
    which = "parameter" if bool(ledger["judged"].all()) else "judged parameter"
    said = [f"{np.sum(kept)} of {kept.size} effects are kept"]
    if (~kept & ~forced).any():
        said.append(
            f"leaving out the others together changes no {which} by more than "
            f"{max(float(ledger.attrs['combined_change']), 0.001):.2g} posterior sd"
        )
    if (~kept & forced).any():
        said.append(f"by your choice {', '.join(_names(ledger, ~kept & forced))} is left out")
    if not kept.all():
        before, after = (ledger.attrs[f"{which}_run_seconds"] for which in ("full", "chosen"))
        said.append(f"one log density takes {1e3 * after:.2g} ms in place of {1e3 * before:.2g} ms")
    return f"{'; '.join(said)}."


def _names(ledger: xr.Dataset, which: np.ndarray) -> list[str]:
    return [str(name) for name in ledger["effect"].to_numpy()[which]]


def _plain(value: Any) -> Any:
    """What JSON knows: numbers of NumPy as Python's own, and None for what is not finite."""
    value = value.item() if isinstance(value, np.generic) else value
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _furthest(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(known[np.argmax(np.abs(known))]) if known.size else math.nan


def _signed(value: float, form: str) -> str:
    return f"{value:+{form}}" if math.isfinite(value) else "-"


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole > 0.0 else math.nan


# --- The effects that a capture can see: everything on, weighed one by one, the rest left out -----


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class ChosenScene(Scene):
    """A scene that knows why it is as it is.

    It is used as any other scene. A fit keeps the ledger in its group `effects`; a scene made from
    it by `dataclasses.replace` has none, because the ledger would no longer be true of it.
    """

    ledger: xr.Dataset | None = dataclasses.field(  # type: ignore[misc]
        default=None, init=False, compare=False, repr=False
    )
    """What each effect changes and costs; `polar_bayes.effects.choose` says how to read it."""

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
    """Keep of a scene what this capture can see.

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
        seed: Of the search for the peak.
        progress: Called with the name of a stage and the fraction of it that is done.

    Returns:
        The scene to fit, with its `ledger`.

    Raises:
        CaptureError: The capture does not hold what a fit needs.
        SceneError: No such scene or effect.
        FitError: A prior, link or setting cannot be used, or the full scene has no peak.
    """
    if not (isinstance(tolerance, int | float) and tolerance > 0.0):
        raise FitError(
            f"tolerance is {tolerance!r}",
            where="choose_effects",
            hint="give posterior standard deviations above 0, such as 0.1",
        )
    request = resolve(capture, model, scene, None, links, largest_view_zenith, seed, "double")
    named = not isinstance(scene, Scene)
    full = simplify(FULL_SCENES[request.scene_name] if named else request.scene, ())
    effects = effects_of(full)
    wishes = Wishes.of(effects, keep, drop)
    names = None if parameters is None else tuple(parameters)
    with jax.enable_x64(True):
        scales = Scales(request, priors, progress or no_progress)
        # What is refused here is refused before minutes are spent.
        resolve_priors(scales.priors(full).read, priors)
        weighed = weigh(scales, full, effects, names)
        verdict = decide(scales, full, weighed, wishes, float(tolerance))
        costs = scales.costs()
    settings: dict[str, str | float | int] = {
        "tolerance": float(tolerance),
        "largest_view_zenith": request.largest_view_zenith,
        "seed": request.seed,
        "links": json.dumps({name: repr(link) for name, link in request.links.items()}),
    }
    choice = ChosenScene(**_fields(verdict.scene))
    ledger = make_ledger(full, weighed, verdict, wishes, costs, settings)
    object.__setattr__(choice, "ledger", ledger)
    return choice


def _fields(scene: Scene) -> dict[str, Any]:
    return {field.name: getattr(scene, field.name) for field in dataclasses.fields(Scene)}
