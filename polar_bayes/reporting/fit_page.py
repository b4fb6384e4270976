"""Report of a fit: results for the material, and every check of the fit."""

import math
import operator
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.figure import Figure

from polar_bayes.benchmark.advice import accuracy_sentences, accuracy_view
from polar_bayes.diagnostics import convergence
from polar_bayes.diagnostics.alternatives import alternatives
from polar_bayes.diagnostics.approximation import smoothed_weights
from polar_bayes.diagnostics.budget import (
    DISCREPANCY,
    HALVED,
    budget,
    budget_sentences,
    described,
    has_budget,
    variance_shares,
)
from polar_bayes.diagnostics.compare import WITHOUT, compare_without
from polar_bayes.diagnostics.criticism import QUESTIONS, criticize
from polar_bayes.diagnostics.limits import LIMITS
from polar_bayes.diagnostics.parameters import APPROXIMATIONS, is_hyperparameter
from polar_bayes.diagnostics.population import population_summary, populations, shrinkage
from polar_bayes.diagnostics.predictive import PROBABILITIES, PredictiveCheck, predictive_checks
from polar_bayes.diagnostics.sensitivity import sensitivity
from polar_bayes.diagnostics.view import FitView, Provenance, view_of
from polar_bayes.errors import FitError, one_line
from polar_bayes.inference.checks import CAUTION, PROBLEM
from polar_bayes.inference.files import sentences_of_auto
from polar_bayes.numerics.psis import MAX_PARETO_K
from polar_bayes.priors import short_numbers
from polar_bayes.reporting import page, plots_curves, plots_fit, text
from polar_bayes.reporting.accuracy import accuracy_picture, study_table
from polar_bayes.reporting.page import Section
from polar_bayes.reporting.style import QUANTITIES, parameter_title
from polar_bayes.reporting.text import (
    DASH,
    column,
    digits,
    ends,
    interval,
    number,
    or_dash,
    percent,
    quarter,
    share,
)
from polar_bayes.repr_html import Row, Table
from polar_bayes.results import summary, verdict
from polar_bayes.scenes.sentences import scene_sentences, scene_table

INSTRUMENT_GROUP = "Instrument and noise"
TRUTH = "true value"
"""Column that is omitted if no true value is known."""

MAX_POPULATIONS = 6
PROVENANCE_GROUPS = {
    "model_settings": "Settings of the model",
    "counts": "Readings",
    "capture": "Capture",
    "priors": "Priors",
    "declared": "Priors that stand in the model itself",
    "fixed": "Held fixed, by the model or around it",
    "links": "Likelihood links",
    "timings": "Seconds, compilation included",
    "versions": "Versions",
}
"""Entries of the provenance by the title of their group on the page."""


def fit_table(
    fit: FitView, key: str, cells: page.Cells, data: pd.DataFrame, **options: Any
) -> Table:
    """Return a table with a row for each parameter that has these numbers, in groups."""
    names = set(map(str, fit.posterior.data_vars))
    titles, groups = {}, {}
    for scalar in fit.scalars:
        if scalar.label in data.index:
            titles[scalar.label] = parameter_title(scalar, fit.posterior)
            groups[scalar.label] = "" if scalar.is_material else INSTRUMENT_GROUP
            if is_hyperparameter(scalar.name, names):
                groups[scalar.label] = "Populations and spectra"
    data = data.loc[list(titles)]
    if TRUTH in cells:
        truths = pd.Series({each.label: fit.truth(each) for each in fit.scalars})
        if np.isfinite(truths[data.index]).any():
            data = data.assign(true_value=truths)
        else:
            cells = {title: cell for title, cell in cells.items() if title != TRUTH}
    return page.make_table(key, cells, data, descriptions=titles, groups=groups, **options)


def has_draws(fit: FitView) -> bool:
    """Return whether a fit has finite draws of a parameter that are not all equal."""
    return fit.method != "point" and bool(plots_fit.drawable(fit))


def fit_page(result: xr.DataTree | FitView) -> page.Page:
    """Return the page of a fit."""
    fit = view_of(result)
    judged = convergence.verdict(fit)
    answers: list[str] = []
    sentences: list[str] = []
    if judged.passed:
        further = " ".join(text.next_sentences(fit))
        answers = [" ".join(text.index_sentences(fit)), text.trust(fit), further]
        sentences = [*text.determined(fit), *text.between_members(fit)]
    approximation = "Convergence" if fit.method == "nuts" else "Approximation"
    code = str(fit.provenance.get("model_source") or "")
    source = page.block("details", "Source of the model", code=code) if code else ""
    sections = [
        Section("parameters", "Parameters", [parameter_table(fit)]),
        Section("scenes", "Which scene", _scenes(fit.result)),
        Section("population", "Population", _population(fit)),
        Section("spectrum", "Spectrum", _spectrum(fit)),
        Section("without", "Without a term for smooth errors", _without(fit), "Instrument"),
        Section("setup", "Uncertainty budget of the set-up", _setup(fit), "Set-up"),
        Section("readings", "Readings and fit", _readings(fit)),
        Section("pairs", "Material parameters together", _pairs(fit)),
        Section("prior", "Prior and data", _prior(fit), "Prior and data"),
        Section("convergence", approximation, _convergence(fit), approximation),
        Section(
            "criticism",
            "What the readings say against the model",
            _criticism(fit),
            "Model criticism",
        ),
        Section("checks", "Predictive checks", _checks(fit)),
        Section("effects", "Effects", _effects(fit.result)),
        Section("accuracy", "Accuracy against time", _accuracy(fit.result)),
        Section("provenance", "Provenance", [*provenance_facts(fit.provenance), source]),
    ]
    return page.Page(
        kind="Fit report",
        name=text.capture_name(fit.provenance),
        subtitles=[
            text.made_by(fit.provenance, text.method_label(fit.method)),
            text.swapped_sentence(fit.provenance),
        ],
        headline=text.fit_headline(fit),
        passed=judged.passed,
        problems=judged.problems,
        answers=tuple(zip(text.QUESTIONS, answers, strict=False)),
        sentences=[*sentences, *text.notes(judged)],
        cautions=judged.cautions,
        beside=_glance(fit) if plots_curves.variables(fit) else "",
        sections=sections,
        footer="Computed from result.nc, which lies in the same folder and holds every draw.",
    )


def fit_card(result: xr.DataTree | FitView) -> page.Card:
    """Return the card of a fit."""
    fit = view_of(result)
    judged = convergence.verdict(fit)
    sentences = [
        text.fit_headline(fit),
        *judged.problems,
        *text.determined(fit),
        judged.nothing_against,
        *text.notes(judged),
        *(f"Caution: {caution}" for caution in judged.cautions),
        text.swapped_sentence(fit.provenance),
    ]
    return sentences, parameter_table(fit, with_setup=True), judged.passed


def plot_fit(result: xr.DataTree | FitView) -> Figure:
    """Plot prior and posterior of a fit, or the readings of a point fit, which has no draws."""
    fit = view_of(result)
    if fit.method == "point":
        return plots_curves.plot_readings(fit, plots_curves.variables(fit)[0])
    return plots_fit.plot_prior_posterior(fit)


# --- Parameters -----------------------------------------------------------------------------------


def parameter_table(fit: FitView, *, with_setup: bool = False) -> Table:
    """Return a table of parameters: interval, known truth, and what determines each.

    The set-up's column is the share of the variance that a set-up known perfectly would take away.
    """
    if fit.method == "point":
        return _estimate_table(fit)
    cells: page.Cells = {
        "mean": digits("mean"),
        "sd": digits("sd"),
        "2.5%": digits("q2.5"),
        "97.5%": digits("q97.5"),
        TRUTH: _truth_cell,
        "prior inside": share("prior_inside"),
        "by the data": lambda row: str(row["verdict"]),
    }
    data = convergence.summary(fit).join(sensitivity(fit)[["prior_inside", "verdict"]])
    if with_setup and has_budget(fit):
        table = budget(fit)
        data["of_setup"] = 1.0 - (table["perfect"] / table["sd"]) ** 2
        cells = {**cells, "of the set-up": share("of_setup")}
    limits = {"determined": LIMITS.determined, "partly": LIMITS.partly}
    return fit_table(fit, "fit.parameter", cells, data, **limits)


def _truth_cell(row: pd.Series) -> str:
    truth = number(row["true_value"], row["sd"])
    is_outside = row["true_value"] < row["q2.5"] or row["true_value"] > row["q97.5"]
    return f"{truth} (outside)" if is_outside else truth


def _estimate_table(fit: FitView) -> Table:
    error = digits("standard_error", "standard_error")
    cells: page.Cells = {
        "estimate": digits("estimate", "standard_error"),
        "standard error": lambda row: error(row).replace(DASH, "not determined"),
        TRUTH: digits("true_value", "standard_error"),
    }
    data = convergence.summary(fit)[["mean", "sd"]]
    data = data.set_axis(["estimate", "standard_error"], axis="columns")
    return fit_table(fit, "fit.estimate", cells, data, name="parameter")


def sensitivity_table(fit: FitView) -> Table:
    """Return a table of prior against posterior, with power-scaling sensitivities."""
    cells: page.Cells = {
        "prior 95%": ends("prior_q2.5", "prior_q97.5"),
        "posterior 95%": ends(),
        "width left": share("width_left"),
        **text.SENSITIVITY_CELLS,
    }
    options = {"prose": ["remark"], "sensitive": LIMITS.sensitive}
    return fit_table(fit, "fit.sensitivity", cells, sensitivity(fit), **options)


def _pairs(fit: FitView) -> Iterator[str]:
    if has_draws(fit) and len(plots_fit.drawable(fit, material=True)) > 1:
        yield page.picture(plots_fit.plot_pairs(fit), "fit.figure_pairs")


def _prior(fit: FitView) -> Iterator[page.Block]:
    if fit.method == "point":
        return
    if has_draws(fit) and "prior" in fit.result.children:
        yield page.picture(plots_fit.plot_prior_posterior(fit), "fit.figure_prior")
    yield sensitivity_table(fit)


def _scenes(result: xr.DataTree) -> Iterator[page.Block]:
    """Return blocks on the compared scenes, if the fit has selected its scene."""
    table = scene_table(result)
    if table.empty:
        return
    yield " ".join(scene_sentences(result))
    numbers = ["elpd", "se", "elpd_diff", "dse", "weight", "unreliable", "criticism", "seconds"]
    texts = [name for name in table.columns if name not in numbers]
    cells: page.Cells = {
        "elpd": column("elpd", ".1f"),
        "difference": text.elpd_difference,
        "weight": share("weight"),
        **{name: operator.itemgetter(name) for name in texts},
        "criticism": lambda row: row["criticism"] or DASH,
    }
    yield page.make_table("fit.scene", cells, table, label="scene", prose=["criticism"])


def _criticism(fit: FitView) -> Iterator[page.Block]:
    """Return blocks on the checks of the model, unless there is nothing to check."""
    if fit.method == "point":
        return
    cells: page.Cells = {
        "outcome": lambda row: (
            f"{row['level']} (fails)" if row["level"] == "problem" else row["level"]
        ),
        "p": column("p_value", ".2g"),
        "what it says": lambda row: row["sentence"] or DASH,
    }
    yield page.make_table(
        *("fit.criticism", cells, criticize(fit)),
        label="check",
        descriptions=QUESTIONS,
        prose=["what it says"],
        caution=CAUTION,
        problem=PROBLEM,
    )
    yield from _alternatives(fit)


def _alternatives(fit: FitView) -> Iterator[page.Block]:
    """Return blocks on alternatives to parts of the scene, if there are any."""
    try:
        table = alternatives(fit)
    except FitError:  # the check says why
        return
    if table.empty:
        return
    cells: page.Cells = {
        "part": operator.itemgetter("part"),
        "instead": operator.itemgetter("alternative"),
        "log Bayes factor": column("log_bayes_factor", ".1f"),
        "mean": column("mean", ".4g"),
        "would be": column("other", ".4g"),
        "shift (sd)": lambda row: "redefined" if row["redefined"] else f"{row['shift']:+.1f}",
    }
    better = -math.log(CAUTION)
    yield page.make_table("fit.alternative", cells, table, better=better, refuted=LIMITS.refuted)


# --- Populations and spectra ----------------------------------------------------------------------


def _population(fit: FitView) -> list[page.Block]:
    """Return blocks on populations and their members, if any parameter is pooled."""
    summary, pooled = population_summary(fit), populations(fit)
    if not pooled:
        return []
    drawn = [each.label for each in pooled if math.isfinite(summary.loc[each.label, "pooling"])]
    pictures: list[page.Block] = []
    for label in drawn[:MAX_POPULATIONS]:
        figure = plots_fit.plot_shrinkage(fit, label)
        instead = "The same." if pictures else ""
        pictures.append(page.picture(figure, "fit.figure_shrinkage", instead=instead, label=label))
    more = len(drawn) - MAX_POPULATIONS
    return [
        *(text.pooling(fit) if convergence.verdict(fit).passed else []),
        population_table(fit),
        *pictures,
        *([f"{more} more populations are in the table only."] if more > 0 else []),
        page.block("details", "Every member in numbers", items=[member_table(fit)]),
    ]


def population_table(fit: FitView) -> Table:
    """Return a table of pooled parameters: location, spread and range of a new member."""
    summary = population_summary(fit)

    def with_interval(row: pd.Series, part: str) -> str:
        low, high = row[f"{part}_q2.5"], row[f"{part}_q97.5"]
        scale = (high - low) / 2.0
        return f"{number(row[part], scale)} {interval(low, high, scale)}"

    cells: page.Cells = {
        "location": lambda row: with_interval(row, "location"),
        "spread": lambda row: with_interval(row, "spread"),
        "members differ by": lambda row: (
            str(row["meaning"]).removeprefix("members differ by ") or DASH
        ),
        "a new member": ends("new_q2.5", "new_q97.5"),
        "pooling factor": column("pooling", ".2f"),
    }
    scales = {"log": "the scale of its logarithm", "log odds": "the scale of its log odds"}
    members = {
        each.label: f"{summary.loc[each.label, 'members']} members, "
        f"on {scales.get(each.scale, 'its own scale')}"
        for each in populations(fit)
    }
    return page.make_table("fit.population", cells, summary, descriptions=members)


def member_table(fit: FitView) -> Table:
    """Return a table of members of every population, pooled and unpooled."""
    titles = {
        scalar.label: parameter_title(scalar, fit.posterior)
        for each in populations(fit)
        for scalar in each.members
    }

    cells: page.Cells = {
        "mean": digits("mean", quarter),
        "95% interval": ends(),
        "alone": digits("unpooled", quarter),
        "95% alone": ends("unpooled_q2.5", "unpooled_q97.5", quarter),
        "pooled share": share("shrinkage"),
    }
    data = shrinkage(fit).loc[list(titles)]
    return page.make_table("fit.member", cells, data, descriptions=titles)


def _spectrum(fit: FitView) -> Iterator[page.Block]:
    spectra = plots_curves.spectra(fit) if has_draws(fit) else {}
    for name, members in spectra.items():
        key = f"fit.figure_spectrum_{'bands' if members[0].is_band else 'intervals'}"
        figure = plots_curves.plot_spectrum(fit, name)
        yield page.picture(figure, key, name=name.replace("_", " ").capitalize())


# --- The instrument -------------------------------------------------------------------------------


def _without(fit: FitView) -> Iterator[page.Block]:
    """Return blocks that compare fits without a part of the instrument with the main fit."""
    if fit.method == "point":
        return
    for at, (key, part) in enumerate(WITHOUT.items(), start=1):
        compared = compare_without(fit, key)
        if compared.empty:
            continue
        yield page.block("heading", f"Without {part}")
        yield discrepancy_table(fit, compared, part, f"without-{at}")
        yield from text.overconfidence(fit, compared, part)
    for key, reason in (fit.provenance.get("comparisons_failed") or {}).items():
        part = WITHOUT.get(key.removeprefix("without_"), one_line(key))
        yield page.block("heading", f"Without {part}")
        yield f"This comparison failed, so nothing is said of it: {one_line(reason)}."


def discrepancy_table(fit: FitView, compared: pd.DataFrame, part: str, name: str) -> Table:
    """Return a table of the fit next to a fit without a part of the instrument."""

    def scale(row: pd.Series) -> float:
        return min(quarter(row), (row["q97.5_without"] - row["q2.5_without"]) / 4.0)

    cells: page.Cells = {
        "mean": digits("mean", scale),
        "95% interval": ends(scale=scale),
        "mean without": digits("mean_without", scale),
        "95% without": ends("q2.5_without", "q97.5_without", scale),
        "width": share("width_ratio"),
        TRUTH: digits("true_value", scale),
    }
    return fit_table(fit, "fit.without", cells, compared, name=name, part=part)


def _setup(fit: FitView) -> Iterator[page.Block]:
    """Return blocks on the uncertainty budget, if the set-up has input quantities."""
    if has_budget(fit):
        yield budget_table(fit)
        yield from budget_sentences(fit)


def budget_table(fit: FitView) -> Table:
    """Return a table of variance contributions to each parameter of the material."""
    found = budget(fit)
    data = variance_shares(found).T
    descriptions = {"sd": "of the posterior", "perfect": "in a set-up that is known perfectly"}
    descriptions |= {"noise": "of the readings", "prior": "of the other parameters"}
    descriptions[DISCREPANCY] = "smooth errors over angle of unknown shape"
    for quantity, u in found.attrs["known"].items():
        descriptions[quantity] = ", ± ".join(described(fit, quantity, u))

    # Beside its share of each variance stands what the sd would be.
    labels, is_halved = list(data), data.index.str.endswith(HALVED)
    halved = data[is_halved].rename(index=lambda name: name.removesuffix(HALVED))
    data = data[~is_halved].join(halved.add_suffix(HALVED))

    def cell(label: str) -> Callable[[pd.Series], str]:
        def of_row(row: pd.Series) -> str:
            if row.name in ("sd", "perfect"):
                return number(row[label], row[label])
            better = row[f"{label}{HALVED}"]
            return percent(row[label]) + (f" → {number(better, better)}" if better > 0.0 else "")

        return of_row

    cells = {label: cell(label) for label in labels}
    return page.make_table("fit.budget", cells, data, label="source", descriptions=descriptions)


# --- Readings and checks --------------------------------------------------------------------------


def _glance(fit: FitView) -> str:
    """Return small figures of readings and fit, which are shown next to the verdict."""
    quantity = QUANTITIES[plots_curves.variables(fit)[0]]
    figure = plots_curves.readings_at_a_glance(fit)
    return page.picture(figure, "fit.figure_glance", quantity=quantity)


def _readings(fit: FitView) -> Iterator[str]:
    key = "fit.figure_readings" if has_draws(fit) else "fit.figure_point_readings"
    for name in plots_curves.variables(fit):
        quantity = QUANTITIES[name]
        yield page.picture(plots_curves.plot_readings(fit, name), key, quantity=quantity)
        if name != "intensity":
            figure = plots_curves.plot_residuals(fit, name)
            yield page.picture(figure, "fit.figure_residuals", quantity=quantity)


def _checks(fit: FitView) -> Iterator[page.Block]:
    checks = predictive_checks(fit)
    if fit.method != "point":
        yield from text.predictive_sentences(fit)
    if checks:
        yield check_table(checks)
    if any(check.pit.size > 1 for check in checks.values()):
        yield page.picture(plots_fit.plot_pit(fit), "fit.figure_pit")


def check_table(checks: Mapping[str, PredictiveCheck]) -> Table:
    """Return a table of residuals, coverage and leave-one-out results of every variable."""
    data = pd.DataFrame.from_dict({n: _check_numbers(x) for n, x in checks.items()}, "index")
    data = data.rename(columns={"standard_error": "elpd_error"})
    cells: dict[str, Callable[[pd.Series], str]] = {
        "readings": column("readings", ".0f"),
        "residual RMS": column("residual_rms", ".3g"),
    }
    key = "fit.residual"
    if any(check.pit.size for check in checks.values()):
        cells |= {f"inside {p:.0%}": _coverage_cell(p) for p in PROBABILITIES}
        cells |= {
            "elpd": text.elpd("elpd_error"),
            "p": column("p_loo", ".1f"),
            "k > 0.7": column("unreliable", ".0f"),
        }
        key = "fit.predictive_check"
    return page.make_table(
        key, cells, data, name="check", label="variable", descriptions=QUANTITIES
    )


def _check_numbers(check: PredictiveCheck) -> dict[str, float]:
    numbers = {"readings": check.count, "residual_rms": check.residual_rms}
    numbers |= {f"inside_{probability:g}": share for probability, share in check.coverage.items()}
    if check.pit.size:
        names = ("elpd", "standard_error", "p_loo", "unreliable")
        numbers |= {name: getattr(check.loo, name, math.nan) for name in names}
    return numbers


def _coverage_cell(probability: float) -> Callable[[pd.Series], str]:
    """Format the share of readings in an interval with its standard error."""

    def cell(row: pd.Series) -> str:
        share = row[f"inside_{probability:g}"]
        chance = 2.0 * math.sqrt(probability * (1.0 - probability) / row["readings"])
        return f"{share:.0%} (±{chance:.0%})" if math.isfinite(share) else DASH

    return cell


# --- The method -----------------------------------------------------------------------------------


def _convergence(fit: FitView) -> Iterator[page.Block]:
    if fit.method == "nuts":
        yield convergence_table(fit)
    if "auto" in fit.provenance:
        yield page.block("bullets", sentences=sentences_of_auto(fit.provenance))
    yield page.facts(_sampler_facts(fit))
    if fit.method == "nuts" and has_draws(fit):
        yield page.picture(plots_fit.plot_ranks(fit), "fit.figure_ranks")


def convergence_table(fit: FitView) -> Table:
    """Return a table of R-hat, effective sample sizes and Monte Carlo errors."""
    cells: page.Cells = {
        "R-hat": column("r_hat", ".4f"),
        "ESS bulk": lambda row: or_dash(np.floor(row["ess_bulk"]), ".0f"),
        "ESS tail": lambda row: or_dash(np.floor(row["ess_tail"]), ".0f"),
        "error of the mean": column("mcse_mean", ".2g"),
    }
    data = convergence.summary(fit)[["r_hat", "ess_bulk", "ess_tail", "mcse_mean"]]
    return fit_table(fit, "fit.convergence", cells, data)


def _sampler_facts(fit: FitView) -> dict[str, object]:
    """Return what the sampler or approximation reports about its run."""
    stats, modes = fit.stats, fit.provenance.get("modes") or {}
    told: Mapping[str, tuple[str, Callable[[xr.DataArray], object]]] = {
        "diverging": ("divergences", lambda x: int(x.sum())),
        "reached_max_treedepth": (
            "draws at the largest tree depth",
            lambda x: f"{int(x.sum())} of {x.size}",
        ),
        "acceptance_rate": ("mean acceptance", lambda x: f"{float(x.mean()):.2f}"),
        "step_size": (
            "step size of each chain",
            lambda x: [f"{size:.3g}" for size in x.isel(draw=-1).to_numpy()],
        ),
    }
    facts = {title: tell(stats[name]) for name, (title, tell) in told.items() if name in stats}
    pareto_k = fit.provenance.get("pareto_k")
    if fit.method in APPROXIMATIONS and "log_weight" in stats:
        _, pareto_k = smoothed_weights(fit)
    if pareto_k is not None:
        facts[f"Pareto k (at most {MAX_PARETO_K})"] = or_dash(pareto_k, ".2f")
    if (effective := fit.provenance.get("ess")) is not None:
        facts["effective sample size of the draws"] = f"{effective:.0f}"
    if modes.get("weights"):
        facts["weights of the modes found"] = [f"{weight:.3g}" for weight in modes["weights"]]
        facts["mode searches"] = f"{modes.get('starts')}, failed: {modes.get('failures')}"
    return facts


# --- Effects, accuracy and provenance -------------------------------------------------------------


def _effects(result: xr.DataTree) -> Iterator[page.Block]:
    """Return blocks on the choice of effects, if there was one."""
    if "effects" not in result.children:
        return
    ledger = result["effects"].to_dataset()
    yield from verdict(ledger).findings
    paths = map(str, ledger["path"].to_numpy())
    rows = tuple(
        Row(str(name), tuple(row), path)
        for path, (name, row) in zip(paths, summary(ledger).iterrows(), strict=True)
    )
    reason = "kept or dropped, and why"
    columns = ("effect", "data", "shift", "sd", "operations", "time", reason)
    caption = page.caption("fit.effect", tolerance=ledger.attrs["tolerance"])
    single = [name for name in ledger.data_vars if ledger[name].dims == ("effect",)]
    yield Table(columns, rows, [reason], "effect", caption, ledger[single].to_dataframe())


def _accuracy(result: xr.DataTree) -> Iterator[page.Block]:
    """Return blocks on an accuracy study of the capture, if the result holds one."""
    if "accuracy" in result.children:
        study = accuracy_view(result["accuracy"].to_dataset())
        yield " ".join([*accuracy_sentences(study), text.reference_sentence(study)])
        yield accuracy_picture(study)
        yield study_table(study)


def provenance_facts(provenance: Provenance) -> list[str]:
    """Return the provenance in titled groups; what the user replaced is marked."""
    keys = ["method", "settings", "model", "scene", "scene_parts", "seed", "precision"]
    keys += ["chain_method", "step_size_halvings", "largest_view_zenith"]
    fit = {key.replace("_", " "): provenance[key] for key in keys if key in provenance}
    swapped = [str(name) for name in provenance.get("swapped") or ()]
    fit["replaced by the user"] = swapped or "nothing: all defaults"
    groups = {name: provenance.get(name) or {} for name in PROVENANCE_GROUPS}
    groups["priors"] = {n: short_numbers(str(x)) for n, x in groups["priors"].items()}
    if timings := groups["timings"]:
        groups["timings"] = {**timings, "total": round(sum(timings.values()), 3)}
    groups["versions"] = {**groups["versions"], **(provenance.get("machine") or {})}
    groups["counts"] = _counts(groups["counts"])
    marked = {
        "fit": {"model", "scene"} & set(swapped),
        "priors": {
            name.removeprefix(text.PRIOR) for name in swapped if name.startswith(text.PRIOR)
        },
        "links": set(groups["links"]) if "links" in swapped else set(),
    }
    return [
        page.facts(
            values,
            PROVENANCE_GROUPS.get(name, "Fit"),
            marked=marked.get(name, ()),
            mark="replaced",
        )
        for name, values in {"fit": fit, **groups}.items()
    ]


def _counts(counts: Provenance) -> dict[str, Any]:
    """Return numbers of readings that were fitted, masked or set aside."""
    found = {"all": counts.get("views"), "fitted": counts.get("used")}
    found |= {"masked (valid=False)": counts.get("masked")}
    if None not in found.values():
        aside = counts["views"] - counts["masked"] - counts["used"]
        found["set aside (beyond the angle limit, or full frames)"] = aside
    found["saturated (polarization not fitted)"] = counts.get("saturated")
    margin = counts.get("at_margin") or {}
    found |= {f"{name} at the margin of its link": count for name, count in margin.items()}
    return {name: count for name, count in found.items() if count is not None}


REPORT = page.Report(fit_page, fit_card, plot_fit, file="result.nc")
