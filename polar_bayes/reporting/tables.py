"""The tables of the report as text, computed from the saved tree alone."""

import dataclasses
import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from polar_bayes.diagnostics.convergence import LARGEST_K_HAT, laplace_k_hat
from polar_bayes.diagnostics.parameters import (
    APPROXIMATIONS,
    Scalar,
    is_hyperparameter,
    stats_of,
    truth_of,
)
from polar_bayes.diagnostics.population import Population
from polar_bayes.diagnostics.predictive import PROBABILITIES, PredictiveCheck
from polar_bayes.diagnostics.sensitivity import DETERMINED, PARTLY, SENSITIVE
from polar_bayes.effects.choose import ledger_table
from polar_bayes.errors import one_line
from polar_bayes.reporting.page import csv_link
from polar_bayes.reporting.style import QUANTITIES, title_of
from polar_bayes.reporting.text import DASH, interval, numbers, or_dash, percent, spoken

MAIN = ""
BETWEEN = "Populations and spectra"
INSTRUMENT = "Instrument and noise"
SCALES = {
    "log": "on the scale of its logarithm",
    "log odds": "on the scale of its log odds",
    "plain": "on its own scale",
}
LONG = 40
"""Tables with more rows scroll in a box of their own."""


@dataclasses.dataclass(frozen=True)
class Row:
    """One row: a name, what it means, its cells as text, and the block of rows it belongs to."""

    name: str
    words: str
    cells: tuple[str, ...]
    block: str = MAIN


@dataclasses.dataclass(frozen=True, eq=False)
class Table:
    """A table of a page, and the numbers behind it."""

    caption: str
    heads: tuple[str, ...]
    rows: tuple[Row, ...]
    numbers: pd.DataFrame | None = None

    @property
    def download(self) -> str:
        """A link that holds the table as a CSV file."""
        texts = pd.DataFrame.from_records(
            [row.cells for row in self.rows], columns=list(self.heads[1:])
        )
        texts.index = pd.Index([row.name for row in self.rows])
        return csv_link(texts if self.numbers is None else self.numbers, self.heads[0])

    @property
    def blocks(self) -> list[tuple[str, list[Row]]]:
        """Rows by the title of their block, in order; the main one has none."""
        found: dict[str, list[Row]] = {}
        for row in self.rows:
            found.setdefault(row.block, []).append(row)
        return list(found.items())

    @property
    def is_long(self) -> bool:
        """True where a page would be mostly this table."""
        return len(self.rows) > LONG


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
    shown = [scalar.label for scalar in found]
    behind = table.loc[shown].join(prior[["prior_inside", "verdict"]])
    behind = behind.assign(true_value=pd.Series(truths)) if known else behind
    caption = (
        "Posterior mean, standard deviation and equal-tailed 95% interval. Prior inside: the "
        "prior's probability of that interval, 95% if the data said nothing; up to "
        f"{DETERMINED:.0%} the parameter counts as determined by the data, up to {PARTLY:.0%} as "
        "partly determined."
    )
    return Table(caption, tuple(heads), tuple(rows), behind)


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
    behind = table[["mean", "sd"]].set_axis(["estimate", "standard_error"], axis="columns")
    behind = behind.assign(true_value=pd.Series(truths)) if known else behind
    caption = "Least squares; standard errors from the curvature and the residuals."
    return Table(caption, tuple(heads), tuple(rows), behind)


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
    behind = table[["r_hat", "ess_bulk", "ess_tail", "mcse_mean"]]
    return Table(caption, tuple(heads), tuple(rows), behind)


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
    return Table(caption, tuple(heads), tuple(rows), compared)


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
    return Table(caption, tuple(heads), tuple(rows), prior)


def population_table(summary: pd.DataFrame, found: Sequence[Population]) -> Table:
    """Location, spread and the range of a new member, for every pooled parameter."""
    rows = []
    for each in found:
        row = summary.loc[each.label]
        cells = []
        for part in ("location", "spread"):
            low, high = row[f"{part}_q2.5"], row[f"{part}_q97.5"]
            scale = (high - low) / 2.0
            cells.append(f"{numbers([row[part]], scale)[0]} {interval(low, high, scale)}")
        cells += [str(row["meaning"]).removeprefix("members differ by ") or DASH]
        cells += [interval(row["new_q2.5"], row["new_q97.5"]), or_dash(row["pooling"], "{:.2f}")]
        words = f"{row['members']} members, {SCALES[each.scale]}"
        rows.append(Row(each.label, words, tuple(cells)))
    heads = ("parameter", "location", "spread", "members differ by")
    caption = (
        "Location: the median of the population, in the unit of the parameter. Spread: the "
        "standard deviation between members on the scale named under the parameter; what it means "
        "in the unit of the parameter stands beside it. Brackets: 95% intervals. A new member: "
        "where one that was not measured would lie with 95%, the uncertainty of location and "
        "spread included. Pooling factor (Gelman and Pardoe 2006): 0 where each member stands "
        "alone, 1 where all share one value; above 0.5 the population says more than the readings "
        "of a member."
    )
    return Table(caption, (*heads, "a new member", "pooling factor"), tuple(rows), summary)


def member_table(result: xr.DataTree, members: pd.DataFrame, found: Sequence[Population]) -> Table:
    """Every member of every population, with and without it."""
    posterior, rows = result["posterior"].to_dataset(), []
    for scalar in (scalar for each in found for scalar in each.members):
        row = members.loc[scalar.label]
        scale = (row["q97.5"] - row["q2.5"]) / 4.0
        cells = [*numbers([row["mean"]], scale), interval(row["q2.5"], row["q97.5"])]
        cells += numbers([row["unpooled"]], scale)
        cells += [interval(row["unpooled_q2.5"], row["unpooled_q97.5"], scale)]
        cells.append(percent(row["shrinkage"]))
        rows.append(Row(scalar.label, title_of(scalar, posterior), tuple(cells)))
    caption = (
        "Alone: about where the readings of a member would put it without the population, taken "
        "out of the draws as if both were normal; a dash where they say nothing. Leaning: the "
        "population's share in the precision of the estimate."
    )
    heads = ("parameter", "mean", "95% interval", "alone", "95% alone", "leaning")
    return Table(caption, heads, tuple(rows), members)


def check_table(checks: Mapping[str, PredictiveCheck]) -> Table:
    """Residuals, coverage, and leave-one-out results of every variable."""
    rows = []
    has_draws = any(check.pit.size for check in checks.values())
    for check in checks.values():
        cells = [str(check.count), f"{check.residual_rms:.3g}"]
        cells += _predictive_cells(check) if has_draws else []
        rows.append(Row(check.name, QUANTITIES.get(check.name, check.name), tuple(cells)))
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
    behind = pd.DataFrame.from_dict({c.name: _check_numbers(c) for c in checks.values()}, "index")
    return Table(caption, tuple(heads), tuple(rows), behind)


def _check_numbers(check: PredictiveCheck) -> dict[str, float]:
    found = {"readings": check.count, "residual_rms": check.residual_rms}
    found |= {f"inside_{probability:g}": share for probability, share in check.coverage.items()}
    if check.loo:
        found |= {"elpd": check.loo.elpd, "elpd_error": check.loo.standard_error}
        found |= {"p_loo": check.loo.p_loo, "unreliable": check.loo.unreliable}
    return found


def _predictive_cells(check: PredictiveCheck) -> list[str]:
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
    facts |= _weight_facts(result, method, provenance)
    modes = provenance.get("modes") or {}
    if modes.get("weights"):
        facts["weights of the modes found"] = [f"{weight:.3g}" for weight in modes["weights"]]
        facts["climbs towards modes"] = f"{modes.get('starts')}, failed: {modes.get('failures')}"
    return fact_rows(facts)


def _weight_facts(
    result: xr.DataTree, method: str, provenance: Mapping[str, Any]
) -> dict[str, object]:
    """How far the draws of an approximation, or weighted ones, can be trusted."""
    k_hat = provenance.get("k_hat")
    if method in APPROXIMATIONS and "log_weight" in stats_of(result):
        k_hat = laplace_k_hat(result)
    worth = provenance.get("effective_draws")
    facts: dict[str, object] = {}
    if k_hat is not None:
        facts[f"Pareto k-hat (at most {LARGEST_K_HAT})"] = or_dash(k_hat, "{:.2f}")
    if worth is not None:
        facts["independent draws that they are worth"] = f"{worth:.0f}"
    return facts


def effect_table(ledger: xr.Dataset) -> Table:
    """What each effect of the scene changes and costs, and whether it was kept."""
    paths = map(str, ledger["path"].to_numpy())
    rows = tuple(
        Row(name, path, tuple(cells))
        for path, (name, *cells) in zip(paths, ledger_table(ledger).itertuples(), strict=True)
    )
    heads = ("effect", "data", "shift", "sd", "operations", "time", "kept or dropped, and why")
    caption = (
        "What leaving out one effect alone changes. Data: the prediction that moves most, in "
        "standard deviations of its noise. Shift and sd: the posterior that moves most, in its "
        "standard deviations, and the one whose standard deviation changes most, both taken as "
        "normal. Operations and time: the effect's share of one log density with everything on. "
        f"What changes no parameter by more than {ledger.attrs['tolerance']:g} may go."
    )
    single = [name for name in ledger.data_vars if ledger[name].dims == ("effect",)]
    return Table(caption, heads, rows, ledger[single].to_dataframe())


def _row(scalar: Scalar, posterior: xr.Dataset, cells: Sequence[str]) -> Row:
    block = MAIN if scalar.is_material else INSTRUMENT
    if is_hyperparameter(scalar.name, set(map(str, posterior.data_vars))):
        block = BETWEEN
    return Row(scalar.label, title_of(scalar, posterior), tuple(cells), block)


def _truth_cell(truth: float, row: pd.Series) -> str:
    text = numbers([truth], row["sd"])[0]
    if not math.isfinite(truth) or not math.isfinite(row["q2.5"]):
        return text
    return text if row["q2.5"] <= truth <= row["q97.5"] else f"{text} (outside)"


def fact_rows(values: Mapping[str, Any], marked: Collection[str] = (), mark: str = "") -> list[Row]:
    """Names and texts; `mark` stands behind those whose names are marked."""
    return [
        Row(str(name), mark if name in marked else "", (_as_text(value),))
        for name, value in values.items()
    ]


def _as_text(value: object) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_as_text(item)}" for key, item in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(_as_text(item) for item in value) or "none"
    return str(value)


# --- How a fit was made: what was chosen, what was swapped, and what was believed before ----------


HELD = " held fixed"
PRIOR = "prior of "
MARK = "swapped"
MOST_NAMED = 6


def made_by(provenance: Mapping[str, Any], method: str) -> str:
    """Scene, model, method and seed in one line."""
    said = {
        key: f"{key} {one_line(str(provenance[key]))}"
        for key in ("scene", "model", "seed")
        if provenance.get(key) is not None
    }
    parts = [said.get("scene", ""), said.get("model", ""), method, said.get("seed", "")]
    text = ", ".join(filter(None, parts))
    return f"{text[:1].upper()}{text[1:]}."


def swapped_sentence(provenance: Mapping[str, Any]) -> str:
    """What the user replaced, in one sentence."""
    if "swapped" not in provenance:
        return ""
    swapped = [str(name) for name in provenance["swapped"]]
    priors = [name.removeprefix(PRIOR) for name in swapped if name.startswith(PRIOR)]
    held = [name.removesuffix(HELD) for name in swapped if name.endswith(HELD)]
    parts = [f"the {n}" for n in swapped if not n.startswith(PRIOR) and not n.endswith(HELD)]
    if priors:
        parts.append(f"the prior{'s' if len(priors) > 1 else ''} of {_few(priors)}")
    said = [f"Swapped by the user: {spoken(parts)}." if parts else ""]
    said += [f"Held fixed: {_few(held)}." if held else ""]
    return (
        " ".join(filter(None, said)) or "Nothing was swapped: all parts and priors are as shipped."
    )


def provenance_groups(provenance: Mapping[str, Any]) -> list[tuple[str, list[Row]]]:
    """How the fit was made, in titled groups of name and text; what was swapped is marked."""
    keys = ["method", "settings", "model", "scene", "scene_parts", "seed", "precision"]
    keys += ["chain_method", "largest_view_zenith"]
    fit = {key.replace("_", " "): provenance[key] for key in keys if key in provenance}
    swapped = [str(name) for name in provenance.get("swapped") or ()]
    fit["swapped by the user"] = swapped or "nothing: all defaults"
    priors, links = provenance.get("priors") or {}, provenance.get("links") or {}
    timings = dict(provenance.get("timings") or {})
    if timings:
        timings["total"] = round(sum(timings.values()), 3)
    versions = {**(provenance.get("versions") or {}), **(provenance.get("machine") or {})}
    groups = {
        "Fit": fact_rows(fit, {"model", "scene"} & set(swapped), MARK),
        "Settings of the model": fact_rows(provenance.get("model_settings") or {}),
        "Readings": fact_rows(_counts(provenance.get("counts") or {})),
        "Capture": fact_rows(provenance.get("capture") or {}),
        "Priors": fact_rows(priors, {n for n in priors if f"{PRIOR}{n}" in swapped}, MARK),
        "Priors that stand in the model itself": fact_rows(provenance.get("declared") or {}),
        "Held fixed, by the model or around it": fact_rows(provenance.get("fixed") or {}),
        "Likelihood links": fact_rows(links, set(links) if "links" in swapped else (), MARK),
        "Seconds, compilation included": fact_rows(timings),
        "Versions": fact_rows(versions),
    }
    return [(title, rows) for title, rows in groups.items() if rows]


def _few(names: Sequence[str]) -> str:
    more = len(names) - MOST_NAMED
    return spoken([*names[:MOST_NAMED], *([f"{more} more"] if more > 0 else [])])


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
