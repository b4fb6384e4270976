"""The standard report: one page that stands alone, with the result beside it."""

import functools
import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import xarray as xr
from matplotlib.figure import Figure

from polar_bayes.benchmark.accuracy import is_accuracy
from polar_bayes.calibration.files import is_calibration
from polar_bayes.diagnostics.compare import WITHOUT, compare_without
from polar_bayes.diagnostics.convergence import summary, verdict
from polar_bayes.diagnostics.parameters import Scalar, method_of, posterior_scalars
from polar_bayes.diagnostics.population import population_summary, populations, shrinkage
from polar_bayes.diagnostics.predictive import PredictiveCheck, predictive_checks
from polar_bayes.diagnostics.sensitivity import sensitivity
from polar_bayes.effects.choose import ledger_sentences
from polar_bayes.errors import FitError, one_line
from polar_bayes.inference.auto import auto_sentences
from polar_bayes.inference.files import save_result
from polar_bayes.inference.result import provenance_of
from polar_bayes.paths import as_path
from polar_bayes.reporting import plots_fit, tables, text
from polar_bayes.reporting.accuracy import accuracy_section, render_accuracy
from polar_bayes.reporting.calibration_page import render_calibration
from polar_bayes.reporting.comparison import render_comparison
from polar_bayes.reporting.maps import render_map
from polar_bayes.reporting.page import Picture, fill, picture, write_page
from polar_bayes.reporting.plots_fit import plot_shrinkage
from polar_bayes.reporting.plots_observations import plot_readings, plot_residuals, variables
from polar_bayes.reporting.plots_spectrum import plot_spectrum, spectra
from polar_bayes.reporting.style import QUANTITIES, in_house_style
from polar_bayes.reporting.tables import made_by, provenance_groups, swapped_sentence

RESULT = "result.nc"
CALIBRATION = "calibration.nc"
ACCURACY = "accuracy.nc"
MENDS = {
    "truth": "leave it out: a fit carries the truth of its capture",
    "uncorrected": "leave it out: a fit carries the truth of its capture",
    "beside": "leave it out, or give what polar_bayes.calibrate returns",
}
MOST_POPULATIONS = 6
METHODS = {
    "nuts": "NUTS",
    "laplace": "Laplace approximation",
    "importance": "Laplace approximation, its draws weighed",
    "tempered": "tempered draws",
    "variational": "variational guide",
    "point": "least squares",
}


@in_house_style
def report(
    result: xr.DataTree | xr.Dataset | Mapping[str, xr.DataTree],
    directory: str | os.PathLike[str],
    *,
    truth: xr.Dataset | None = None,
    uncorrected: xr.Dataset | None = None,
    beside: Mapping[str, xr.DataTree] | None = None,
) -> Path:
    """Write the standard report of any result, or of several fits side by side: one `index.html`.

    The page needs no network, no script and no other file. Everything on it is computed from the
    result, so a report of a file read back is the same report. Beside the page of a fit lies
    `result.nc`, beside that of a calibration `calibration.nc`, of an accuracy study
    `accuracy.nc`; a map, which may be large, stays where it is. A fit whose tree has a group
    `accuracy` (`result["accuracy"] = study["accuracy"]`) shows it.

    Args:
        result: A tree that `polar_bayes.fit`, `polar_bayes.calibrate` or `polar_bayes.accuracy`
            returned, or maps of `polar_bayes.fit_pixels`; or one of them read back from a file. Or
            several fits of one capture by name, which are compared.
        directory: The folder; made if it is not there. An older report in it is replaced.
        truth: Of maps: the simulated capture, whose `true_<parameter>` the intervals are checked
            against.
        uncorrected: Of maps, with `truth`: those of the same image by
            `PixelLaplace(weighted=False)`, whose coverage is put beside.
        beside: Of a calibration: others of the same layout, by a name such as their method
            ("laplace"), with which it is compared.

    Returns:
        The path of the page.

    Raises:
        CaptureError: The directory is no path, or `truth` does not fit the maps.
        FitError: It holds no posterior and no maps, fits are not of one capture, or an argument
            does not apply.
        OutputError: The folder cannot be written, or holds a file of such a name that is no part
            of a report.
    """
    folder = as_path(directory, "report")
    of_calibration = is_calibration(result)
    _refuse({"truth": truth, "uncorrected": uncorrected}, isinstance(result, xr.Dataset), "maps")
    _refuse({"beside": beside}, of_calibration, "calibrations")
    if isinstance(result, Mapping) and not isinstance(result, xr.Dataset | xr.DataTree):
        return write_page(folder, render_comparison(result))
    if isinstance(result, xr.Dataset):
        return write_page(folder, render_map(result, truth, uncorrected))
    if is_accuracy(result):
        beside_it = {ACCURACY: functools.partial(save_result, result)}
        return write_page(folder, render_accuracy(result), beside_it)
    page = render_calibration(result, beside) if of_calibration else render(result)
    name = CALIBRATION if of_calibration else RESULT
    return write_page(folder, page, {name: functools.partial(save_result, result)})


def _refuse(given: Mapping[str, object], fitting: bool, what: str) -> None:
    """Arguments that go with another kind of result."""
    for name, value in given.items():
        if value is not None and not fitting:
            raise FitError(f"it goes with {what} only", where=f"report: {name}", hint=MENDS[name])


def render(result: xr.DataTree) -> str:
    """The page as text."""
    found, table = posterior_scalars(result), summary(result)
    prior, checks = sensitivity(result), predictive_checks(result)
    method, provenance = method_of(result), provenance_of(result)
    posterior = result["posterior"].to_dataset()
    judged = verdict(result, table)
    is_point = method == "point"
    population = None if is_point else _population(result, posterior)
    name = one_line(str((provenance.get("capture") or {}).get("name", "capture")))
    content: dict[str, Any] = {
        "kind": "Fit report",
        "name": name,
        "under": [
            made_by(provenance, METHODS.get(method, one_line(method))),
            *filter(None, [swapped_sentence(provenance)]),
        ],
        "verdict": judged,
        "headline": text.headline(method, judged.converged, judged.cautions),
        # What a failed fit says about the material is not worth a sentence.
        "said": [
            *text.determined(found, prior, posterior),
            *(population["said"] if population else []),
            *text.expected(checks),
            text.trust(method, judged.cautions, checks),
        ]
        if judged.converged
        else [],
        "population": population,
        "parameters": tables.estimate_table(result, found, table)
        if is_point
        else tables.parameter_table(result, found, table, prior),
        "without": [] if is_point else _without(result, found, posterior),
        "sensitivity": None if is_point else tables.sensitivity_table(found, prior, posterior),
        "convergence": tables.convergence_table(found, table, posterior)
        if method == "nuts"
        else None,
        "sampler": tables.sampler_facts(result, method, provenance),
        "checks": tables.check_table(checks) if checks else None,
        "effects": _effects(result),
        "accuracy": accuracy_section(result) if "accuracy" in result.children else None,
        "auto": auto_sentences(result),
        "groups": provenance_groups(provenance),
        "model_source": str(provenance.get("model_source") or ""),
        "pictures": _pictures(result, checks, method),
    }
    return fill("report.html.j2", content)


def _without(
    result: xr.DataTree, found: list[Scalar], posterior: xr.Dataset
) -> list[dict[str, Any]]:
    """Each fit that stands beside the main one, with what to make of it."""
    compared = {what: compare_without(result, part) for part, what in WITHOUT.items()}
    return [
        {
            "what": what,
            "table": tables.discrepancy_table(result, found, table, what),
            "sentences": text.overconfidence(table, found, posterior, what),
        }
        for what, table in compared.items()
        if not table.empty
    ] + [
        {
            "what": WITHOUT.get(part.removeprefix("without_"), one_line(part)),
            "table": None,
            "sentences": [f"This comparison failed, so nothing is said of it: {one_line(why)}."],
        }
        for part, why in (provenance_of(result).get("comparisons_failed") or {}).items()
    ]


def _population(result: xr.DataTree, posterior: xr.Dataset) -> dict[str, Any] | None:
    """What the members of each population have in common, where anything is pooled."""
    found = populations(result)
    if not found:
        return None
    summary, members = population_summary(result), shrinkage(result)
    drawn = [each.label for each in found if math.isfinite(summary.loc[each.label, "pooling"])]
    caption = (
        "Each member twice: above, hollow, about where its own readings alone would put it; "
        "below, filled, its estimate in this fit, which leans on the others. The less a member's "
        "readings say, the closer it is drawn to the population. Dark gray: the population's "
        "location; light gray: where a new member would lie; both 95%. An arrowhead stands for an "
        "estimate beyond the axis."
    )
    return {
        "said": text.varied(summary, found, posterior),
        "leaning": text.leaning(summary, found, posterior),
        "table": tables.population_table(summary, found),
        "members": tables.member_table(result, members, found),
        "left_out": max(len(drawn) - MOST_POPULATIONS, 0),
        "pictures": [
            picture(
                plot_shrinkage(result, label, summary, members),
                f"Shrinkage of {label}: each member alone and pooled",
                caption if at == 0 else "The same.",
            )
            for at, label in enumerate(drawn[:MOST_POPULATIONS])
        ],
    }


def _spectrum_pictures(result: xr.DataTree) -> list[Picture]:
    found = spectra(result)
    tied = (
        "Median, 50% and 95% of the posterior at every wavelength; between and beyond the measured "
        "ones (dashed lines) the fit knows it only from its assumption about how colors hang "
        "together. Orange: true values, where known."
    )
    free = (
        "Median, 50% and 95% of the posterior at each measured wavelength. Nothing in this fit "
        "ties the colors together, so it says nothing in between. Orange: true values, where known."
    )
    return [
        picture(
            plot_spectrum(result, name, found),
            f"{name.replace('_', ' ').capitalize()} against wavelength",
            tied if found[name][0].between.size else free,
        )
        for name in found
    ]


def _effects(result: xr.DataTree) -> dict[str, Any] | None:
    """How the scene was chosen, where it was."""
    if "effects" not in result.children:
        return None
    ledger = result["effects"].to_dataset()
    return {"table": tables.effect_table(ledger), "sentence": " ".join(ledger_sentences(ledger))}


def _pictures(
    result: xr.DataTree, checks: dict[str, PredictiveCheck], method: str
) -> dict[str, list[Picture]]:
    """Every figure that applies, by the section where it stands."""
    has_draws = method != "point" and bool(plots_fit.drawable(result))
    has_prior = has_draws and "prior" in result.children
    return {
        "spectrum": _spectrum_pictures(result) if has_draws else [],
        "readings": _reading_pictures(result, has_draws),
        "pairs": _optional(
            has_draws and len(plots_fit.drawable(result, material=True)) > 1,
            lambda: plots_fit.plot_pairs(result),
            "Pair plot of the material parameters",
            "Each dot is a joint draw. A long narrow cloud means that the data fix a combination "
            "of the two better than either; numbers above the diagonal are correlations. Orange "
            "dashes: true values, where known. Crosses: draws that diverged.",
        ),
        "prior": _optional(
            has_prior,
            lambda: plots_fit.plot_prior_posterior(result),
            "Prior and posterior of each parameter",
            "Curves are scaled to equal height. Where blue covers gray, the data said nothing "
            "about this parameter.",
        ),
        "ranks": _optional(
            method == "nuts" and has_draws,
            lambda: plots_fit.plot_ranks(result),
            "Rank plot of each chain",
            "Each line is one chain. Lines that are flat and overlap mean that all chains "
            "describe one distribution; a chain that leans or piles up saw another part of it.",
        ),
        "pit": _optional(
            any(check.pit.size > 1 for check in checks.values()),
            lambda: plots_fit.plot_pit(result, checks),
            "PIT and leave-one-out PIT of each variable",
            "For a model that expects its readings the curve stays in the gray band in 95 of 100 "
            "captures. Up, then down: readings scatter more than the model says; down, then up: "
            "less; all on one side: the prediction is shifted. Red lines leave the band. The "
            "leave-one-out panel predicts each reading from the others and is the stricter one.",
        ),
    }


def _reading_pictures(result: xr.DataTree, has_draws: bool) -> list[Picture]:
    pictures = []
    bands = (
        " (posterior median). Of new readings of the same material half should fall in the dark "
        "band and 95% in the light one."
    )
    for name in variables(result):
        quantity = QUANTITIES[name]
        pictures.append(
            picture(
                plot_readings(result, name),
                f"Readings of {quantity} and the fitted curve against view zenith",
                f"Readings of {quantity} with the fitted curve{bands if has_draws else '.'}",
            )
        )
        if name != "intensity":
            pictures.append(
                picture(
                    plot_residuals(result, name),
                    f"Readings of {quantity} minus the fitted curve against view zenith",
                    "The same after subtracting the fitted curve. A wave that many neighbors "
                    "share is a smooth error of the instrument or of the model.",
                )
            )
    return pictures


def _optional(
    applies: bool, draw: Callable[[], Figure], alternative: str, caption: str
) -> list[Picture]:
    return [picture(draw(), alternative, caption)] if applies else []
