"""The ledger of effects: what each changes and costs, kept or not and why, as one dataset."""

import json
import math
from collections.abc import Iterable, Mapping
from importlib.metadata import version
from typing import Any

import numpy as np
import xarray as xr

from polar_bayes.budget.cost import Cost
from polar_bayes.budget.rule import Verdict, Weighed, Wishes
from polar_bayes.physics.scene import Scene

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
