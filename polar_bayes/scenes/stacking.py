"""Stacked posterior of several scenes: draws of each fit in proportion to its stacking weight.

Source:
    Yao, Vehtari, Simpson & Gelman (2018), Bayesian Analysis 13, 917.
"""

import json
import time
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
import pandas as pd
import xarray as xr

from polar_bayes.diagnostics.convergence import verdict
from polar_bayes.diagnostics.parameters import SAMPLE_DIMS
from polar_bayes.errors import FitError
from polar_bayes.inference.fitting import fit_request
from polar_bayes.inference.laplace import Importance
from polar_bayes.inference.least_squares import Point
from polar_bayes.inference.method import AbstractMethod
from polar_bayes.inference.result import PROVENANCE, provenance_of
from polar_bayes.progress import Progress
from polar_bayes.scenes.comparison import (
    ERRORS_APART,
    SMALL_DIFFERENCE,
    SceneComparison,
    Setting,
    compare_candidates,
)

OF_DRAWS = (
    *("posterior", "sample_stats", "log_prior", "log_likelihood"),
    *("posterior_predictive", "noise_free"),
)
"""Groups whose draws are those of the posterior."""

SHARED = ("prior", "prior_predictive", "observed_data", "constant_data")
"""Groups that are taken from the scene of largest weight."""

NOT_STACKED = ("log_weight", "lp")
"""Statistics whose constants differ between scenes."""

BY_PARAMETER = ("priors", "bounds", "prior_probability", "fixed", "declared")
"""Entries of the provenance that are mappings by parameter."""

MUCH_BETWEEN = 0.1
"""Share of the variance between scenes that is worth a sentence of its own."""


def fit_best_scenes(setting: Setting, method: AbstractMethod, progress: Progress) -> xr.DataTree:
    """Compare scenes, and fit those that remain by a method; their posteriors are stacked."""
    if isinstance(method, Point):
        raise FitError(
            "a point estimate has no width to compare scenes by",
            where="fit: scene='auto', method='point'",
            hint="use method='laplace', or compare_scenes and then a scene of your choice",
        )
    comparison = compare_candidates(setting, progress)
    weights = comparison.weights
    alone = len(weights) == 1
    with jax.enable_x64(setting.precision == "double"):
        fits = {
            name: comparison.fits[name]
            if isinstance(method, Importance)  # the comparison has more rounds of the same
            else fit_request(
                comparison.requests[name],
                method,
                progress,
                time.perf_counter(),
                with_comparisons=alone,
            )
            for name in weights
        }
    result = next(iter(fits.values())) if alone else stack_fits(fits, weights)
    result["scenes"] = xr.DataTree(comparison_dataset(comparison))
    provenance = json.loads(result.attrs[PROVENANCE]) | {"scene": "auto"}
    result.attrs[PROVENANCE] = json.dumps(provenance, sort_keys=True)
    return result


def stack_fits(fits: Mapping[str, xr.DataTree], weights: Mapping[str, float]) -> xr.DataTree:
    """One fit whose draws are of several fits, over the parameters that they share."""
    trees = {name: fits[name] for name in sorted(weights, key=lambda name: -weights[name])}
    first = next(iter(trees.values()))
    index = _draws_of_each(trees, weights)
    chains = min(tree["posterior"].sizes["chain"] for tree in trees.values())
    shared = _shared([tree["posterior"].to_dataset() for tree in trees.values()])
    groups: dict[str, xr.Dataset] = {}
    for group in (name for name in OF_DRAWS if all(name in t.children for t in trees.values())):
        datasets = [tree[group].to_dataset() for tree in trees.values()]
        names = [name for name in _shared(datasets) if name not in NOT_STACKED]
        if not names:
            continue
        parts = [
            each[names]
            .isel(chain=slice(chains), draw=index[name])
            .drop_vars("draw", errors="ignore")
            for name, each in zip(trees, datasets, strict=True)
        ]
        groups[group] = _shuffled(xr.concat(parts, "draw", combine_attrs="override"))
    for group in (name for name in SHARED if name in first.children):
        dataset = first[group].to_dataset()
        groups[group] = dataset[shared] if group == "prior" else dataset
    stacked = xr.DataTree.from_dict(groups)
    stacked.attrs = {**first.attrs, PROVENANCE: _provenance(trees, weights, shared)}
    return stacked


def _draws_of_each(
    trees: Mapping[str, xr.DataTree], weights: Mapping[str, float]
) -> dict[str, np.ndarray]:
    """Evenly spaced draws of each fit, as many as its weight allows where no draw is repeated."""
    sizes = {name: tree["posterior"].sizes["draw"] for name, tree in trees.items()}
    total = min(sizes[name] / weights[name] for name in trees)
    return {
        name: np.linspace(0, size - 1, max(1, round(total * weights[name]))).astype(int)
        for name, size in sizes.items()
    }


def _shared(datasets: list[xr.Dataset]) -> list[str]:
    """Variables of one shape but for their draws in all datasets."""

    def shape(variable: xr.DataArray) -> dict[Any, int]:
        return {dim: n for dim, n in variable.sizes.items() if dim not in SAMPLE_DIMS}

    first, *others = datasets
    return [
        str(name)
        for name, variable in first.data_vars.items()
        if all(name in each and shape(each[name]) == shape(variable) for each in others)
    ]


def _shuffled(dataset: xr.Dataset) -> xr.Dataset:
    """Draws in random order, the same in every group: chains mix the scenes."""
    order = np.random.default_rng(0).permutation(dataset.sizes["draw"])
    return dataset.isel(draw=order).assign_coords(draw=np.arange(order.size))


def _provenance(
    trees: Mapping[str, xr.DataTree], weights: Mapping[str, float], shared: list[str]
) -> str:
    """That of the heaviest scene; problems are those of all."""
    each = {name: provenance_of(tree) for name, tree in trees.items()}
    found = dict(next(iter(each.values())))
    for key in ("modes", "k_hat"):
        found.pop(key, None)
    for key in BY_PARAMETER:
        found[key] = {n: x for n, x in (found.get(key) or {}).items() if n in shared}
    found["scene_parts"] = "; ".join(
        f"{weights[name]:.2f} x {own.get('scene_parts', '')}" for name, own in each.items()
    )
    verdicts = {name: verdict(tree) for name, tree in trees.items()}
    found["problems"] = [
        f"{name}: {problem.rstrip('.')}"
        for name, own in verdicts.items()
        for problem in (() if own.converged else own.problems)
    ]
    return json.dumps(found, sort_keys=True)


# --- The comparison as a group of the result, and in sentences ------------------------------------


def comparison_dataset(comparison: SceneComparison) -> xr.Dataset:
    """The tables of a comparison as a dataset with the dims scene and parameter."""
    table = comparison.table.rename_axis("scene")
    intervals = comparison.intervals.rename(columns={"q2.5": "low", "q97.5": "high"})
    labels = list(dict.fromkeys(intervals.index.get_level_values(0)))
    wide = {
        name: intervals[name].unstack(0).reindex(index=table.index, columns=labels).to_numpy()
        for name in ("mean", "sd", "low", "high")
    }
    parts = [repr(comparison.scenes[name]) for name in table.index]
    texts = {"parts": parts, "criticism": list(table["criticism"])}
    numbers = ("elpd", "se", "elpd_diff", "dse", "weight", "unreliable", "seconds")
    return xr.Dataset(
        {
            **{name: ("scene", table[name].to_numpy(float)) for name in numbers},
            **{name: ("scene", np.array(text, dtype=str)) for name, text in texts.items()},
            **{name: (("scene", "parameter"), values) for name, values in wide.items()},
            "between_share": ("parameter", comparison.between.reindex(labels).to_numpy(float)),
        },
        {"scene": table.index.to_numpy(str), "parameter": np.array(labels, dtype=str)},
        {"left_out": json.dumps(dict(comparison.left_out))},
    )


def scene_table(result: xr.DataTree | SceneComparison) -> pd.DataFrame:
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


def scene_sentences(result: xr.DataTree | SceneComparison) -> list[str]:
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
        return f"Not {name}: it predicts worse, by {difference:.1f} +- {error:.1f} nat in all."
    if "priors" in str(scene["criticism"].item()):
        return f"Not {name}: its parameters are where their priors hardly allow them."
    return (
        f"Not {name}: it adds nothing to the others ({difference:.1f} +- {error:.1f} nat behind)."
    )


def _between(found: xr.Dataset) -> list[str]:
    """What share of the width of each interval is between scenes."""
    share = found["between_share"].to_series().dropna()
    much = share[share >= MUCH_BETWEEN]
    if much.empty:
        return ["The remaining scenes agree: hardly any of the width is between them."]
    listed = ", ".join(f"{name} {value:.0%}" for name, value in much.items())
    return [f"Variance between the remaining scenes: {listed}; the rest is within each of them."]


def _dataset(result: xr.DataTree | SceneComparison) -> xr.Dataset | None:
    if isinstance(result, SceneComparison):
        return comparison_dataset(result)
    return result["scenes"].to_dataset() if "scenes" in result.children else None
