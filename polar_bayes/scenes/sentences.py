"""Results of a comparison of scenes, as a table and in sentences."""

import dataclasses
import itertools
import json
from collections.abc import Iterator, Mapping

import numpy as np
import pandas as pd
import xarray as xr
from numpyro import distributions as dist

from polar_bayes.diagnostics.criticism import whose_index
from polar_bayes.diagnostics.finding import listed
from polar_bayes.inference.request import Request
from polar_bayes.physics.scene import Scene
from polar_bayes.priors import describe_prior

CLEAR = 4.0
"""Difference of expected log densities, in nats, below which it says little (Sivula et al.
2020)."""


def is_apart[T: (float, pd.Series)](difference: T, error: T) -> T:
    """Return whether an elpd difference (nat) is significant: `CLEAR`, and 2 standard errors."""
    return (difference > CLEAR) & (difference > 2.0 * error)


@dataclasses.dataclass(frozen=True, eq=False)
class SceneComparison:
    """Comparison of several scenes for one capture.

    Args:
        table: A row for each scene, best first: elpd and se (nat), elpd_diff and dse (to the best),
            weight (stacking; 0 for a scene that does not remain), unreliable (readings whose Pareto
            k is above 0.7), seconds (of the fit, which is compiled while the one before runs),
            index_bound (bound of the prior at which the interval of the index ends, or NaN),
            criticism (checks that found a caution or problem).
        intervals: A row for each material parameter and scene that has it, in the order of the
            table: mean, sd, q2.5, q97.5 (unit of the parameter).
        between: For each material parameter of all remaining scenes, the share of its stacked
            variance that is between scenes, unit 1.
        scenes: The scenes, by name.
        fits: The fits that were compared, by name.
        left_out: By scene, why it could not be fitted.
        requests: What is to be fitted, by scene, with every default filled in.
        lifted: Prior of the index by which all scenes were compared, by its name, where Brewster's
            angle by eye means an index that the stated prior excludes; otherwise empty.
        undecided: Scenes with a film or a back face that the readings do not tell from none, and
            that do not remain.
    """

    table: pd.DataFrame
    intervals: pd.DataFrame
    between: pd.Series
    scenes: Mapping[str, Scene]
    fits: Mapping[str, xr.DataTree]
    left_out: Mapping[str, str]
    requests: Mapping[str, Request]
    lifted: Mapping[str, dist.Distribution] = dataclasses.field(default_factory=dict)
    undecided: tuple[str, ...] = ()

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
        numbers = (
            *("elpd", "se", "elpd_diff", "dse", "weight", "unreliable", "seconds"),
            "index_bound",
        )
        return xr.Dataset(
            {
                **{name: ("scene", table[name].to_numpy(float)) for name in numbers},
                **{name: ("scene", np.array(text, dtype=str)) for name, text in texts.items()},
                **{name: (("scene", "parameter"), values) for name, values in wide.items()},
                "between_share": ("parameter", self.between.reindex(labels).to_numpy(float)),
            },
            {"scene": table.index.to_numpy(str), "parameter": np.array(labels, dtype=str)},
            {
                "left_out": json.dumps(dict(self.left_out)),
                "lifted": ", ".join(f"{n} by {describe_prior(x)}" for n, x in self.lifted.items()),
                "undecided": json.dumps(list(self.undecided)),
            },
        )


def scene_table(result: xr.DataTree | SceneComparison) -> pd.DataFrame:
    """Return a row for each scene: predictions, weight, intervals and criticism.

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
    """State which scenes remain and why, and the effect of the choice on intervals.

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
    if lifted := found.attrs.get("lifted"):
        sentences.append(
            f"Scenes were compared with {lifted}, since Brewster's angle means an index that the "
            "stated prior excludes; a fit keeps the stated prior."
        )
    if len(remaining) == 1:
        sentences.append(f"One remains: {chosen}.")
    else:
        shares = ", ".join(f"{name} ({share:.0%})" for name, share in remaining.items())
        sentences.append(
            f"{len(remaining)} remain, and the answer is stacked from them: {shares}. They predict "
            "readings about equally well."
        )
    undecided = json.loads(str(found.attrs.get("undecided", "[]")))
    gone = weight.index[(weight == 0.0) & ~weight.index.isin(undecided)]
    others = found.sel(scene=[name for name in found["scene"].to_numpy() if name in gone])
    sentences += [_why_not(others.sel(scene=name)) for name in others["scene"].to_numpy()[:4]]
    if undecided:
        sentences.append(f"The readings do not decide {listed(undecided)}{whose_index(undecided)}.")
    sentences += _escaped(found, chosen)
    if len(remaining) > 1:
        sentences += _between(found)
    unexplained = str(found["criticism"].sel(scene=chosen).item())
    if unexplained:
        sentences.append(
            f"Criticism of {chosen} is left: {unexplained}; no candidate explains it, so the scene "
            "may lack a part that the library does not have."
        )
    left_out = json.loads(str(found.attrs.get("left_out", "{}")))
    for why in dict.fromkeys(left_out.values()):
        names = ", ".join(name for name, reason in left_out.items() if reason == why)
        sentences.append(f"{names} could not be fitted: {why}.")
    return sentences


def film_cautions(comparison: SceneComparison) -> list[str]:
    """Caution against films that the readings do not decide and that would move the index."""
    films = [name for name in (*comparison.undecided, *comparison.weights) if "film" in name]
    bare = next((name for name in comparison.weights if name not in films), "")
    if not films or not bare:
        return []
    found, answers = comparison.to_dataset(), []
    own = found.sel(scene=bare)
    indices = [str(x) for x in own["parameter"].to_numpy() if x.startswith("refractive_index")]
    for label, film in itertools.product(indices, films):
        low, mean, high = (float(own[end].sel(parameter=label)) for end in ("low", "mean", "high"))
        other = float(found["mean"].sel(scene=film, parameter=label))
        if other < low or other > high:
            answers.append(f"{label} is {other:.3g} by {film}, and {mean:.3g} by {bare}")
    said = f"The readings do not decide a film: {listed(answers)}{whose_index(films)}."
    return [said] if answers else []


def _why_not(scene: xr.Dataset) -> str:
    """Explain why a scene does not remain."""
    name, difference = str(scene["scene"].item()), abs(float(scene["elpd_diff"]))
    error = float(scene["dse"])
    if is_apart(difference, error):
        return f"Not {name}: it predicts worse, by {difference:.1f} ± {error:.1f} nat in all."
    if "priors" in str(scene["criticism"].item()):
        return f"Not {name}: its parameters are in the tails of their priors."
    return f"Not {name}: it adds nothing to the others ({difference:.1f} ± {error:.1f} nat behind)."


def _escaped(found: xr.Dataset, chosen: str) -> Iterator[str]:
    """Return scenes at a bound of the index, which the chosen scene may merely avoid."""
    if "index_bound" not in found or np.isfinite(found["index_bound"].sel(scene=chosen)):
        return
    bound = found["index_bound"].to_series().dropna()
    for value, names in bound.groupby(bound):
        yield (
            f"The index of {listed(names.index)} lies against {value:g}, where its prior ends, so "
            f"that {chosen} may predict better only because its index does not: if the index may "
            "lie beyond, compare again with "
            f"priors={{'refractive_index': TruncatedNormal({value:g}, 0.3, low=1)}}."
        )


def _between(found: xr.Dataset) -> list[str]:
    """State the share of the width of each interval that is between scenes."""
    share = found["between_share"].to_series().dropna()
    much = share[share >= 0.1]  # of its variance
    if much.empty:
        return ["The remaining scenes agree: hardly any of the width is between them."]
    listed = ", ".join(f"{name} {value:.0%}" for name, value in much.items())
    return [f"Variance between the remaining scenes: {listed}; the rest is within each of them."]


def _dataset(result: xr.DataTree | SceneComparison) -> xr.Dataset | None:
    if not isinstance(result, xr.DataTree):
        return result.to_dataset()
    return result["scenes"].to_dataset() if "scenes" in result.children else None
