"""The tables of the report as text, computed from the saved tree alone."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from polar_bayes.budget.ledger import ledger_rows
from polar_bayes.diagnostics.convergence import LARGEST_K_HAT, laplace_k_hat
from polar_bayes.diagnostics.parameters import Scalar, stats_of, truth_of
from polar_bayes.diagnostics.predictive import PROBABILITIES, Check
from polar_bayes.diagnostics.sensitivity import DETERMINED, PARTLY, SENSITIVE
from polar_bayes.reporting.style import QUANTITIES, title_of
from polar_bayes.reporting.text import DASH, interval, numbers, or_dash, percent


@dataclasses.dataclass(frozen=True)
class Row:
    """One row: a name, what it means, its cells as text, and whether it is about the material."""

    name: str
    words: str
    cells: tuple[str, ...]
    is_main: bool = True


@dataclasses.dataclass(frozen=True)
class Table:
    """A table: `heads` has a name for the first column and one for each cell."""

    caption: str
    heads: tuple[str, ...]
    rows: tuple[Row, ...]


def parameter_table(
    result: xr.DataTree, found: Sequence[Scalar], table: pd.DataFrame, prior: pd.DataFrame
) -> Table:
    """Every parameter with its interval, the truth where it is known, and what the data said."""
    truths = {scalar.label: truth_of(result, scalar) for scalar in found}
    known = any(math.isfinite(truth) for truth in truths.values())
    heads = ["parameter", "mean", "sd", "2.5%", "97.5%", *(["true value"] if known else [])]
    heads += ["prior inside", "by the data"]
    posterior, rows = result["posterior"].to_dataset(), []
    for scalar in found:
        row, gain = table.loc[scalar.label], prior.loc[scalar.label]
        cells = numbers([row["mean"], row["sd"], row["q2.5"], row["q97.5"]], row["sd"])
        cells += [_truth_cell(truths[scalar.label], row)] if known else []
        cells += [percent(gain["prior_inside"]), str(gain["verdict"])]
        rows.append(_row(scalar, posterior, cells))
    caption = (
        "Posterior mean, standard deviation and equal-tailed 95% interval. Prior inside: the "
        "prior's probability of that interval, 95% if the data said nothing; up to "
        f"{DETERMINED:.0%} the parameter counts as determined by the data, up to {PARTLY:.0%} as "
        "partly determined."
    )
    return Table(caption, tuple(heads), tuple(rows))


def estimate_table(result: xr.DataTree, found: Sequence[Scalar], table: pd.DataFrame) -> Table:
    """The estimates of a point fit."""
    truths = {scalar.label: truth_of(result, scalar) for scalar in found}
    known = any(math.isfinite(truth) for truth in truths.values())
    posterior, rows = result["posterior"].to_dataset(), []
    for scalar in found:
        row = table.loc[scalar.label]
        cells = numbers([row["mean"], row["sd"]], row["sd"])
        if not math.isfinite(row["sd"]):
            cells[1] = "not determined"
        cells += numbers([truths[scalar.label]], row["sd"]) if known else []
        rows.append(_row(scalar, posterior, cells))
    heads = ("parameter", "estimate", "standard error", *(["true value"] if known else []))
    caption = "Least squares; standard errors from the curvature and the residuals."
    return Table(caption, tuple(heads), tuple(rows))


def convergence_table(found: Sequence[Scalar], table: pd.DataFrame, posterior: xr.Dataset) -> Table:
    """R-hat, effective sample sizes and Monte Carlo error of every parameter."""
    rows = []
    for scalar in found:
        row = table.loc[scalar.label]
        cells = (
            or_dash(row["r_hat"], "{:.4f}"),
            or_dash(np.floor(row["ess_bulk"]), "{:.0f}"),
            or_dash(np.floor(row["ess_tail"]), "{:.0f}"),
            or_dash(row["mcse_mean"], "{:.2g}"),
        )
        rows.append(_row(scalar, posterior, cells))
    heads = ("parameter", "R-hat", "ESS bulk", "ESS tail", "error of the mean")
    caption = "Wanted: R-hat at most 1.01 and both effective sample sizes (ESS) at least 400."
    return Table(caption, tuple(heads), tuple(rows))


def discrepancy_table(
    result: xr.DataTree, found: Sequence[Scalar], compared: pd.DataFrame, what: str
) -> Table:
    """The fit of the report beside the same fit without a part of the instrument."""
    shown = [scalar for scalar in found if scalar.label in compared.index]
    truths = {scalar.label: truth_of(result, scalar) for scalar in shown}
    known = any(math.isfinite(truth) for truth in truths.values())
    posterior, rows = result["posterior"].to_dataset(), []
    for scalar in shown:
        row = compared.loc[scalar.label]
        width, bare = row["q97.5"] - row["q2.5"], row["q97.5_without"] - row["q2.5_without"]
        scale = min(width, bare) / 4.0
        cells = [*numbers([row["mean"]], scale), interval(row["q2.5"], row["q97.5"], scale)]
        cells += numbers([row["mean_without"]], scale)
        cells += [interval(row["q2.5_without"], row["q97.5_without"], scale)]
        cells += [percent(row["width_ratio"])]
        cells += numbers([truths[scalar.label]], scale) if known else []
        rows.append(_row(scalar, posterior, cells))
    heads = ["parameter", "mean", "95% interval", "mean without", "95% without", "width"]
    heads += ["true value"] if known else []
    caption = (
        f"The fit of this report beside the same fit without {what}. Width: that of the interval "
        "without it over that with it."
    )
    return Table(caption, tuple(heads), tuple(rows))


def sensitivity_table(found: Sequence[Scalar], prior: pd.DataFrame, posterior: xr.Dataset) -> Table:
    """Prior against posterior, and what a bent prior would change."""
    rows = []
    for scalar in found:
        row = prior.loc[scalar.label]
        cells = (
            interval(row["prior_q2.5"], row["prior_q97.5"]),
            interval(row["q2.5"], row["q97.5"]),
            percent(row["width_left"]),
            or_dash(row["prior_sensitivity"], "{:.3f}"),
            or_dash(row["likelihood_sensitivity"], "{:.3f}"),
            str(row["remark"]),
        )
        rows.append(_row(scalar, posterior, cells))
    heads = ["parameter", "prior 95%", "posterior 95%", "width left"]
    heads += ["to the priors", "to the data", "remark"]
    caption = (
        "Width left: the posterior's interval over the prior's. To the priors, to the data: how "
        "fast the posterior moves when all priors, or all data, count a little more; from "
        f"{SENSITIVE} on it matters."
    )
    return Table(caption, tuple(heads), tuple(rows))


def check_table(checks: Mapping[str, Check]) -> Table:
    """Residuals, coverage, and leave-one-out results of every variable."""
    rows = []
    has_draws = any(check.pit.size for check in checks.values())
    for check in checks.values():
        cells = [str(check.count), f"{check.residual_rms:.3g}"]
        cells += _predictive_cells(check) if has_draws else []
        rows.append(Row(check.name, QUANTITIES[check.name], tuple(cells)))
    heads = ["variable", "readings", "residual RMS"]
    caption = "Residual: reading minus the noise-free prediction, in the unit of the reading."
    if has_draws:
        heads += [*(f"inside {p:.0%}" for p in PROBABILITIES), "elpd", "p", "k > 0.7"]
        caption += (
            " Inside: share of the readings in the central predictive interval, and in brackets "
            "how far chance alone moves it. Leave-one-out: elpd is the log density of each reading "
            "given all others, summed; p the effective number of parameters; k > 0.7 counts "
            "readings for which this cannot be trusted. Saturated readings are not compared."
        )
    return Table(caption, tuple(heads), tuple(rows))


def _predictive_cells(check: Check) -> list[str]:
    loo, cells = check.loo, []
    for probability in PROBABILITIES:
        chance = 2.0 * math.sqrt(probability * (1.0 - probability) / check.count)
        share = check.coverage.get(probability, math.nan)
        cells.append(f"{share:.0%} (±{chance:.0%})" if math.isfinite(share) else DASH)
    if loo is None:
        return [*cells, DASH, DASH, DASH]
    error = or_dash(loo.standard_error, "{:.1f}")
    return [*cells, f"{loo.elpd:.1f} ± {error}", f"{loo.p_loo:.1f}", str(loo.unreliable)]


def sampler_facts(result: xr.DataTree, method: str, provenance: Mapping[str, Any]) -> list[Row]:
    """What the sampler or approximation says of itself."""
    stats = stats_of(result)
    facts: dict[str, object] = {}
    if "diverging" in stats:
        facts["divergences"] = int(stats["diverging"].sum())
    if "reached_max_treedepth" in stats:
        deep = stats["reached_max_treedepth"]
        facts["draws at the largest tree depth"] = f"{int(deep.sum())} of {deep.size}"
    if "acceptance_rate" in stats:
        facts["mean acceptance"] = f"{float(stats['acceptance_rate'].mean()):.2f}"
    if "step_size" in stats:
        sizes = stats["step_size"].isel(draw=-1).to_numpy()
        facts["step size of each chain"] = [f"{size:.3g}" for size in sizes]
    if method == "laplace" and "log_weight" in stats:
        k_hat = laplace_k_hat(result)
        facts[f"Pareto k-hat (at most {LARGEST_K_HAT})"] = or_dash(k_hat, "{:.2f}")
    modes = provenance.get("modes") or {}
    if modes.get("weights"):
        facts["weights of the modes found"] = [f"{weight:.3g}" for weight in modes["weights"]]
        facts["climbs towards modes"] = f"{modes.get('starts')}, failed: {modes.get('failures')}"
    return _facts(facts)


def effect_table(ledger: xr.Dataset) -> Table:
    """What each effect of the scene changes and costs, and whether it was kept."""
    paths = map(str, ledger["path"].to_numpy())
    rows = tuple(
        Row(name, path, cells)
        for path, (name, cells) in zip(paths, ledger_rows(ledger).items(), strict=True)
    )
    heads = ("effect", "data", "shift", "sd", "operations", "time", "kept or dropped, and why")
    caption = (
        "What leaving out one effect alone changes. Data: the prediction that moves most, in "
        "standard deviations of its noise. Shift and sd: the posterior that moves most, in its "
        "standard deviations, and the one whose standard deviation changes most, both taken as "
        "normal. Operations and time: the effect's share of one log density with everything on. "
        f"What changes no parameter by more than {ledger.attrs['tolerance']:g} may go."
    )
    return Table(caption, heads, rows)


def provenance_groups(provenance: Mapping[str, Any]) -> list[tuple[str, list[Row]]]:
    """How the fit was made, in titled groups of name and text."""
    keys = ["method", "settings", "model", "scene", "scene_parts", "seed", "precision"]
    keys += ["chain_method", "largest_view_zenith"]
    fit = {key.replace("_", " "): provenance[key] for key in keys if key in provenance}
    fit["swapped by the user"] = provenance.get("swapped") or "nothing: all defaults"
    timings = dict(provenance.get("timings") or {})
    if timings:
        timings["total"] = round(sum(timings.values()), 3)
    versions = {**(provenance.get("versions") or {}), **(provenance.get("machine") or {})}
    groups = {
        "Fit": fit,
        "Readings": _counts(provenance.get("counts") or {}),
        "Capture": provenance.get("capture"),
        "Priors": provenance.get("priors"),
        "Likelihood links": provenance.get("links"),
        "Seconds, compilation included": timings,
        "Versions": versions,
    }
    return [(title, _facts(values)) for title, values in groups.items() if values]


def _counts(counts: Mapping[str, Any]) -> dict[str, Any]:
    said = {"all": counts.get("views"), "fitted": counts.get("used")}
    said |= {"masked (valid=False)": counts.get("masked")}
    if None not in said.values():
        aside = counts["views"] - counts["masked"] - counts["used"]
        said["set aside (beyond the angle limit)"] = aside
    said["saturated"] = counts.get("saturated")
    margin = counts.get("at_margin") or {}
    said |= {f"{name} at the margin of its link": count for name, count in margin.items()}
    return {name: count for name, count in said.items() if count is not None}


def _row(scalar: Scalar, posterior: xr.Dataset, cells: Sequence[str]) -> Row:
    return Row(scalar.label, title_of(scalar, posterior), tuple(cells), scalar.is_material)


def _truth_cell(truth: float, row: pd.Series) -> str:
    text = numbers([truth], row["sd"])[0]
    if not math.isfinite(truth) or not math.isfinite(row["q2.5"]):
        return text
    return text if row["q2.5"] <= truth <= row["q97.5"] else f"{text} (outside)"


def _facts(values: Mapping[str, Any]) -> list[Row]:
    return [Row(str(name), "", (_as_text(value),)) for name, value in values.items()]


def _as_text(value: object) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {item}" for key, item in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(str(item) for item in value)
    return str(value)
