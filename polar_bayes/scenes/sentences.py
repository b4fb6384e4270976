"""What a comparison of scenes says, as a table and in sentences."""

import json
from typing import Protocol

import numpy as np
import pandas as pd
import xarray as xr

SMALL_DIFFERENCE = 4.0
"""Difference in elpd, unit nat, below which two scenes are not told apart, whatever its error."""

ERRORS_APART = 2.0
"""Standard errors of the difference beyond which a scene is told apart from the best."""
MUCH_BETWEEN = 0.1
"""Share of the variance of a parameter between scenes that is told."""


class Comparison(Protocol):
    """What `polar_bayes.compare_scenes` returns, as far as it is read here."""

    def to_dataset(self) -> xr.Dataset:
        """The tables of the comparison."""


def scene_table(result: xr.DataTree | Comparison) -> pd.DataFrame:
    """A row for each scene: predictions, weight, intervals of the material, and criticism.

    Args:
        result: What `polar_bayes.compare_scenes` returned, or a fit with scene="auto".

    Returns:
        Columns elpd, se, elpd_diff and dse (nat), weight, a text `mean [q2.5, q97.5]` for each
        material parameter, unreliable (readings whose Pareto k is above 0.7), criticism and
        seconds; empty for a fit of one's own scene.
    """
    found = _dataset(result)
    if found is None:
        return pd.DataFrame()
    table = found[["elpd", "se", "elpd_diff", "dse", "weight"]].to_dataframe()
    for name in found["parameter"].to_numpy():
        own = found.sel(parameter=name)
        ends = zip(*(own[end].to_numpy() for end in ("mean", "low", "high")), strict=True)
        table[str(name)] = [
            f"{mean:.3f} [{low:.3f}, {high:.3f}]" if np.isfinite(mean) else ""
            for mean, low, high in ends
        ]
    for name in ("unreliable", "criticism", "seconds"):
        table[name] = found[name].to_numpy()
    return table


def scene_sentences(result: xr.DataTree | Comparison) -> list[str]:
    """Which scenes were compared, which remain and why, and what the choice does to the intervals.

    Args:
        result: What `polar_bayes.compare_scenes` returned, or a fit with scene="auto".

    Returns:
        Sentences; none for a fit by a scene of one's own choice.
    """
    found = _dataset(result)
    if found is None:
        return []
    weight = found["weight"].to_series().sort_values(ascending=False, kind="stable")
    remaining = weight[weight > 0.0]
    chosen = str(remaining.index[0])
    count = found.sizes["scene"]
    were = "scene was" if count == 1 else "scenes were"
    sentences = [f"{count} {were} fitted, from simple to complex."]
    if len(remaining) == 1:
        sentences.append(f"One remains: {chosen}.")
    else:
        listed = ", ".join(f"{name} ({share:.0%})" for name, share in remaining.items())
        sentences.append(
            f"{len(remaining)} remain, and the answer is stacked from them: {listed}. They predict "
            "readings about equally well."
        )
    others = found.sel(scene=[name for name in found["scene"].to_numpy() if weight[name] == 0.0])
    sentences += [_why_not(others.sel(scene=name)) for name in others["scene"].to_numpy()[:4]]
    if len(remaining) > 1:
        sentences += _between(found)
    unexplained = str(found["criticism"].sel(scene=chosen).item())
    if unexplained:
        sentences.append(
            f"Criticism of {chosen} is left: {unexplained}; no candidate explains it, so the scene "
            "may lack a part that the library does not have."
        )
    for name, why in json.loads(str(found.attrs.get("left_out", "{}"))).items():
        sentences.append(f"{name} could not be fitted: {why}.")
    return sentences


def _why_not(scene: xr.Dataset) -> str:
    """Why a scene does not remain."""
    name, difference = str(scene["scene"].item()), abs(float(scene["elpd_diff"]))
    error = float(scene["dse"])
    if difference > max(SMALL_DIFFERENCE, ERRORS_APART * error):
        return f"Not {name}: it predicts worse, by {difference:.1f} ± {error:.1f} nat in all."
    if "priors" in str(scene["criticism"].item()):
        return f"Not {name}: its parameters are where their priors hardly allow them."
    return f"Not {name}: it adds nothing to the others ({difference:.1f} ± {error:.1f} nat behind)."


def _between(found: xr.Dataset) -> list[str]:
    """What share of the width of each interval is between scenes."""
    share = found["between_share"].to_series().dropna()
    much = share[share >= MUCH_BETWEEN]
    if much.empty:
        return ["The remaining scenes agree: hardly any of the width is between them."]
    listed = ", ".join(f"{name} {value:.0%}" for name, value in much.items())
    return [f"Variance between the remaining scenes: {listed}; the rest is within each of them."]


def _dataset(result: xr.DataTree | Comparison) -> xr.Dataset | None:
    if not isinstance(result, xr.DataTree):
        return result.to_dataset()
    return result["scenes"].to_dataset() if "scenes" in result.children else None
