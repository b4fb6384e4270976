"""The report of a calibration: verdict, ranks, coverage, estimates, and what became of the fits."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import xarray as xr
from matplotlib.figure import Figure

from polar_bayes.calibration.compare import compare_calibrations, comparison_sentences
from polar_bayes.calibration.files import is_calibration
from polar_bayes.calibration.prediction import calibration_readings, holds_readings
from polar_bayes.calibration.verdict import (
    calibration_table,
    calibration_verdict,
    how_ranks_stray,
)
from polar_bayes.errors import FitError, one_line
from polar_bayes.inference.result import provenance_of
from polar_bayes.reporting import calibration as figures
from polar_bayes.reporting import calibration_tables as tables
from polar_bayes.reporting.calibration_panels import MOST_SHOWN, Part, Ranked, parts_of
from polar_bayes.reporting.calibration_readings import (
    ReadingRanks,
    ranks_of_readings,
    reading_rows,
)
from polar_bayes.reporting.page import Picture, fill, picture
from polar_bayes.reporting.provenance import made_by
from polar_bayes.reporting.text import spoken

MOST_PANELS = 12
"""Parameters of one figure: more would be too small to read."""

MOST_RIVALS = 4

BROKEN = (
    "What captures were simulated by differs on purpose from what was fitted, in its {}: this "
    "calibration asks whether that mistake is seen."
)
SHAPES = (
    "A hump above zero on the left and a dip below it on the right: the truth lies too often at "
    "both ends, intervals are too narrow; dip first, then hump: too wide. All above zero: truths "
    "stand low among the draws, the posterior is too high; all below: too low."
)


def render_calibration(
    calibration: xr.DataTree, beside: Mapping[str, xr.DataTree] | None = None
) -> str:
    """The page of a calibration as text."""
    rivals = {one_line(str(name)): each for name, each in (beside or {}).items()}
    provenance = provenance_of(calibration)
    method = one_line(str(provenance.get("method", "this calibration")))
    _check_rivals(rivals, method)
    table = calibration_table(calibration)
    parts = parts_of(calibration, table)
    said = tables.verdict_words(calibration_verdict(calibration))
    compared = compare_calibrations({method: calibration, **rivals}) if rivals else None
    words = {label: how_ranks_stray(part.row) for label, part in parts.items() if not part.passes}
    others = {name: parts_of(each) for name, each in rivals.items()}
    has_readings = holds_readings(calibration)
    read = ranks_of_readings(calibration) if has_readings else []
    judged = calibration_readings(calibration) if has_readings else None
    headline, is_good = tables.verdict_head(table, judged)
    content: dict[str, Any] = {
        "kind": "Calibration report",
        "name": _name(provenance),
        "under": [
            f"{next(iter(parts.values())).pit.size:,} simulations. {made_by(provenance, method)}"
        ],
        "headline": headline,
        "is_good": is_good,
        "said": [said[0], *_broken(provenance), *tables.interval_words(table, parts)],
        "found": said[1:],
        "parameters": tables.calibration_rows(table, parts, words),
        "comparison": None
        if compared is None
        else {
            "table": tables.comparison_rows(compared, parts),
            "sentences": comparison_sentences(compared),
        },
        "readings": reading_rows(read) if read else None,
        "statuses": tables.fit_tables(calibration, parts),
        "facts_of_fits": tables.fit_facts(calibration),
        "groups": tables.calibration_groups(provenance),
        "pictures": _pictures(list(parts.values()), others, method)
        | {"readings": list(_readings(read, method))},
    }
    return fill("calibration.html.j2", content)


def _check_rivals(rivals: Mapping[str, xr.DataTree], method: str) -> None:
    for name, each in rivals.items():
        where = f"report: beside {name}"
        if not is_calibration(each):
            raise FitError(
                "it is no calibration", where=where, mend="give what polar_bayes.calibrate returns"
            )
        if name == method:
            raise FitError(
                "the calibration itself is called so", where=where, mend="give it another name"
            )
    if len(rivals) > MOST_RIVALS:
        raise FitError(
            f"{len(rivals)} calibrations are too many for one figure",
            where="report: beside",
            mend=f"give at most {MOST_RIVALS}",
        )


def _name(provenance: Mapping[str, Any]) -> str:
    capture = provenance.get("capture")
    if isinstance(capture, Mapping):
        capture = capture.get("name")
    return one_line(str(capture or "capture"))


def _broken(provenance: Mapping[str, Any]) -> list[str]:
    differing = provenance.get("truth") or {}
    if not differing:
        return []
    return [BROKEN.format(spoken([one_line(str(name)) for name in differing]))]


def _pictures(
    parts: Sequence[Part], others: Mapping[str, Mapping[str, Part]], method: str
) -> dict[str, list[Picture]]:
    """Every figure by the section where it stands."""
    colored = "Black dots mark where it leaves the band, which is narrow at both ends. "
    by_color = (
        f" Band and dots are those of {method}; the others are drawn over it." if others else ""
    )
    return {
        "ecdf": list(
            _paged(
                parts,
                lambda some: figures.ecdf_differences(some, others, method),
                "Distribution of the ranks minus the uniform one",
                "Where the posterior is right, the rank of the truth among its draws is uniform, "
                "and the curve stays in the gray band: curves of all parameters together leave it "
                f"in at most one of twenty right calibrations. {colored}{SHAPES}{by_color}",
            )
        ),
        "histogram": list(
            _paged(
                parts,
                figures.rank_histograms,
                "Histograms of the ranks",
                "The same ranks as histograms. All bars of a uniform one stay in the gray band in "
                "at least 19 of 20 calibrations. High at both ends: intervals too narrow; high in "
                "the middle: too wide; high on the left: the posterior is too high; on the right: "
                "too low.",
            )
        ),
        "coverage": list(
            _paged(
                parts,
                lambda some: figures.interval_coverage(some, others, method),
                "Share of the fits whose 50, 80 and 95% intervals hold the truth",
                "A dot for each interval: the share of all fits, failed ones counted as misses, "
                "whose interval holds the truth; bars are the 95% ranges (Wilson) that so many "
                "simulations allow. Dots belong on the dashed lines at 50, 80 and 95%: left of "
                "them intervals are too narrow or miss their place, right of them too wide.",
            )
        ),
        "estimates": list(
            _paged(
                parts,
                figures.estimates,
                "Posterior means and 80% intervals against the truth",
                f"Of at most {MOST_SHOWN} simulations, evenly chosen, those that failed included. "
                "About one interval in five should miss the truth (orange). Points along the "
                "dashed line: the data say what the parameter is. A flatter cloud: estimates "
                "shrink towards the prior, fully so where it lies level, and intervals are long. A "
                "cloud beside the line: estimates are shifted.",
            )
        ),
    }


def _readings(read: Sequence[ReadingRanks], method: str) -> Iterator[Picture]:
    return _paged(
        read,
        lambda some: figures.ecdf_differences(some, {}, method),
        "Distribution of the ranks of readings minus the uniform one",
        "Where model, links and posterior are right, a reading stands uniformly among what is "
        "predicted of it, and the curve stays in the gray band: curves of all readings together "
        "leave it in at most one of twenty right calibrations. Black dots mark where it leaves "
        "the band. A hump above zero on the left and a dip below it on the right: readings lie "
        "too often at both ends, predictions are too narrow; dip first, then hump: too wide.",
    )


def _paged[T: Ranked](
    parts: Sequence[T],
    draw: Callable[[Sequence[T]], Figure],
    alternative: str,
    caption: str,
) -> Iterator[Picture]:
    """A few parameters at a time; the first caption says how to read them all."""
    for at in range(0, len(parts), MOST_PANELS):
        some = parts[at : at + MOST_PANELS]
        labels = spoken([part.label for part in some])
        said = caption if at == 0 else f"The same of {labels}."
        yield picture(draw(some), f"{alternative}: {labels}", said)
