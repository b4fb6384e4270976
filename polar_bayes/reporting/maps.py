"""The report of a map: what became of its pixels, pictures, tables, and coverage where known."""

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure

from polar_bayes.diagnostics.coverage import BLOCK, INTERVALS, map_coverage, map_scalars
from polar_bayes.diagnostics.parameters import Scalar
from polar_bayes.errors import FitError, one_line
from polar_bayes.inference.batch_result import MIN_VIEWS, Status
from polar_bayes.inference.batching import IMAGE
from polar_bayes.inference.psis import MAX_PARETO_K
from polar_bayes.inference.result import provenance_of
from polar_bayes.maps.fit_map import checked_status, cut
from polar_bayes.maps.lazy import ensure_loaded
from polar_bayes.physics.part import notation
from polar_bayes.reporting.page import Picture, fill, picture
from polar_bayes.reporting.style import (
    BLUE,
    GREEK,
    GREEN,
    ORANGE,
    PURPLE,
    SKY,
    VERMILLION,
    Drawing,
    place_of,
    plain,
    styled,
    wrapped,
)
from polar_bayes.reporting.tables import (
    INSTRUMENT,
    MAIN,
    Row,
    Table,
    made_by,
    provenance_groups,
    swapped_sentence,
)
from polar_bayes.reporting.text import DASH, numbers, percent, spoken

# --- What a map says in numbers and sentences: its pixels, its parameters, its coverage -----------


FEW = 0.95
"""Below this share of answers among the pixels that were read, the page warns."""

SLIGHT = 0.01
"""Coverage that is off by less is not worth a warning, however many pixels tell it."""

MOST_NAMED = 6

STATUSES = {
    "good": "an answer that the checks let pass",
    "masked": "no valid reading",
    "too few views": f"fewer than {MIN_VIEWS} valid views",
    "not converged": "no answer was reached; NaN",
    "not trusted": "numbers that no check confirms, by the approach told below",
    "not fitted": "called good without finite numbers, or never written",
}
APPROACHES = {
    "none": "no numbers",
    "laplace": "the normal approximation as it is",
    "importance": "the normal approximation corrected by weights",
    "adapted": "a proposal fitted to its own draws and corrected by weights",
    "nuts": "sampling (NUTS)",
    "tempered": "tempered draws",
}


def count_cases(maps: xr.Dataset) -> pd.DataFrame:
    """Pixels of a map by status (rows) and approach (columns), both in words."""
    rows, columns = (flag_words(maps[name]) for name in ("status", "approach"))
    counts = np.zeros((len(rows), len(columns)), int)
    for place in cut(maps, BLOCK):
        here = maps.isel(place)
        np.add.at(
            counts,
            (flag_ranks(checked_status(here), rows), flag_ranks(here["approach"], columns)),
            1,
        )
    return pd.DataFrame(counts, index=list(rows.values()), columns=list(columns.values()))


def flag_ranks(flags: xr.DataArray, known: Mapping[int, str]) -> np.ndarray:
    """Which of the known flags each pixel has, in the order of the axes of an image."""
    values = flags.transpose(*IMAGE).to_numpy().ravel()
    found = np.full(values.size, -1)
    for rank, value in enumerate(known):
        found[values == value] = rank
    if (found < 0).any():
        raise FitError(
            f"{values[np.argmin(found)]} has no meaning there",
            where=f"maps: {flags.name}",
            hint="copy the store again, or make the map again",
        )
    return found


def flag_words(flags: xr.DataArray) -> dict[int, str]:
    """Words of each flag: those that the map itself knows, whatever became of the code since."""
    words = [word.replace("_", " ") for word in str(flags.attrs["flag_meanings"]).split()]
    values = np.asarray(flags.attrs.get("flag_values", range(len(words))))
    known = dict(zip(map(int, values), words, strict=True))
    if flags.name == "status":  # a map may lose chunks, whether or not its maker knew the word
        known.setdefault(int(Status.NOT_FITTED), "not fitted")
    return known


def headline(cases: pd.DataFrame) -> tuple[str, bool]:
    """How many pixels have an answer, and whether that is enough."""
    good, read = answers(cases)
    if read == 0:
        return "No pixel was read: these maps are empty.", False
    if good == 0:
        return "No pixel has an answer: do not use these maps.", False
    if good == read:
        return "Every pixel that was read has an answer.", True
    if lost := int(cases.sum(axis=1).get("not fitted", 0)):
        every = int(cases.to_numpy().sum())
        return f"{lost:,} of {every:,} pixels are not fitted: this map has holes.", False
    said = f"{good:,} of {read:,} pixels that were read have an answer ({share(good, read)})."
    return said, good >= FEW * read


def answers(cases: pd.DataFrame) -> tuple[int, int]:
    """Pixels that have an answer, and pixels that were read."""
    by_status = cases.sum(axis=1)
    read = int(by_status.sum() - by_status.get("masked", 0))
    return int(by_status.get("good", 0)), read


def share(count: int, whole: int) -> str:
    """A share that says 0 and 100% only where it is meant."""
    if whole == 0:
        return DASH
    said = percent(count / whole)
    if count < whole and said == "100%":
        return "above 99.5%" if count / whole < 0.9995 else "above 99.9%"
    return "below 0.1%" if count > 0 and said == "0.0%" else said


def verdict(cases: pd.DataFrame) -> list[str]:
    """What became of the pixels, in sentences."""
    count = {str(word): int(number) for word, number in cases.sum(axis=1).items()}
    every = sum(count.values())
    said = []
    if count.get("good"):
        by = {str(way): int(number) for way, number in cases.loc["good"].items() if number}
        ways = [
            f"{'all' if len(by) == 1 else format(number, ',')} by {APPROACHES.get(way, way)}"
            for way, number in by.items()
        ]
        said.append(
            f"Of {every:,} pixels {count['good']:,} are good ({share(count['good'], every)}): "
            f"{spoken(ways)}."
        )
    phrases = {
        "masked": "{} masked: no reading there is valid.",
        "too few views": f"{{}} read in fewer than {MIN_VIEWS} views and not fitted.",
        "not converged": "{} not converged: no start led to an answer, and the maps are NaN there.",
        "not trusted": f"{{}} not trusted: Pareto k is above {MAX_PARETO_K:g}, or draws are "
        "worth too little, and nothing else confirmed them. The maps show its numbers there; do "
        "not quote them.",
        "not fitted": "{} not fitted: they are called good without finite numbers, or were never "
        "written. Copy the store again, or make the map again.",
    }
    for word, phrase in phrases.items():
        if number := count.get(word):
            are = "pixels are" if number > 1 else "pixel is"
            said.append(phrase.format(f"{number:,} {are}"))
    return said


def status_table(cases: pd.DataFrame) -> Table:
    """Pixels by status."""
    caption = "What became of each pixel. Only good ones count in the other tables."
    return _cases_table("status", cases.sum(axis=1), STATUSES, caption)


def approach_table(cases: pd.DataFrame) -> Table:
    """Pixels by approach, and how many of them are good."""
    caption = "How the numbers of each pixel were found, from the cheapest way to the dearest."
    good = cases.loc["good"] if "good" in cases.index else 0 * cases.sum()
    return _cases_table("approach", cases.sum(), APPROACHES, caption, good)


def _cases_table(
    head: str,
    counts: pd.Series,
    meanings: Mapping[str, str],
    caption: str,
    good: pd.Series | None = None,
) -> Table:
    every = int(counts.sum())
    rows = []
    for word, count in counts.items():
        cells = [f"{int(count):,}", share(int(count), every)]
        cells += [] if good is None else [f"{int(good[word]):,}"]
        rows.append(Row(str(word), meanings.get(str(word), str(word)), tuple(cells)))
    heads = (head, "pixels", "share", *([] if good is None else ["good"]))
    behind = pd.DataFrame({"pixels": counts, "share": counts / max(every, 1)})
    behind = behind if good is None else behind.assign(good=good)
    return Table(caption, heads, tuple(rows), behind)


def parameter_table(maps: xr.Dataset, found: Sequence[Scalar]) -> Table:
    """Every parameter over the good pixels: what it is, how it varies, how well it is known."""
    rows, behind = [], {}
    for scalar in found:
        mean = _over_good(maps, scalar, "")
        sd, width = _over_good(maps, scalar, "_sd"), _over_good(maps, scalar, "_quantile")
        middles = [float(np.median(each)) if each.size else math.nan for each in (mean, sd, width)]
        ends = np.quantile(mean, [0.05, 0.95]).tolist() if mean.size else [math.nan] * 2
        scale = middles[1]
        cells = [
            *numbers([middles[0], *ends], scale),
            *numbers([middles[1]], scale),
            *numbers([middles[2]], scale),
        ]
        rows.append(_row(scalar, named(scalar), cells))
        behind[scalar.label] = [middles[0], *ends, *middles[1:]]
    heads = ("parameter", "median", "5% below", "5% above", "typical sd", "95% width")
    frame = pd.DataFrame.from_dict(behind, orient="index", columns=list(heads[1:]))
    caption = (
        "Over the good pixels: median of the posterior means, the values that 5% of them lie "
        "below and above, and medians of the standard deviations and of the widths of the 95% "
        "intervals. Means differ from pixel to pixel because the material does and because each "
        "is uncertain: where the spread is not much larger than the sd, it says little about the "
        "material."
    )
    return Table(caption, heads, tuple(rows), frame)


def _over_good(maps: xr.Dataset, scalar: Scalar, ending: str) -> np.ndarray:
    """Values of one map over the good pixels, or widths of its 95% intervals: (pixel,)."""
    values = maps[f"{scalar.name}{ending}"].isel(scalar.index)
    ends = INTERVALS[95]
    found = []
    for place in cut(maps, BLOCK):
        here = values.isel(place).load()
        if "quantile" in here.dims:
            low, high = (here.sel(quantile=level, drop=True) for level in ends)
            here = high - low
        good = (maps["status"].isel(place) == Status.GOOD).load()
        found.append(here.to_numpy()[(good & np.isfinite(here)).transpose(*here.dims).to_numpy()])
    return np.concatenate(found)


def coverage_table(
    found: Sequence[Scalar], coverage: pd.DataFrame, uncorrected: pd.DataFrame | None
) -> Table:
    """How often the intervals hold the truth, beside those of a map that was not corrected."""
    heads = ["parameter", "interval"]
    ways = ["holds the truth"] if uncorrected is None else ["corrected", "uncorrected"]
    heads += [head for way in ways for head in (way, "within", "of all read")]
    rows = []
    for scalar in found:
        if scalar.label not in coverage.index:
            continue
        for claimed in INTERVALS:
            cells = [f"{claimed}%"]
            for table in (coverage, uncorrected):
                if table is not None:
                    cells += _held(table, scalar.label, claimed)
            words = named(scalar) if claimed == min(INTERVALS) else scalar.label
            rows.append(_row(scalar, words, cells))
    caption = (
        "Share of the pixels with an answer whose central interval holds the true value, and the "
        "95% interval within which so many pixels tell that share. Of all read: the same where a "
        "pixel that was read and has no answer counts as a miss. Right intervals hold the truth as "
        "often as they say if the truths are drawn from the priors; of truths that were chosen, "
        "some are held more often and some less. Marked: too few, beyond chance and by more than "
        f"{100 * SLIGHT:g} in 100 pixels."
    )
    behind = coverage
    if uncorrected is not None:
        behind = coverage.join(uncorrected.add_suffix("_uncorrected"))
    return Table(caption, tuple(heads), tuple(rows), behind)


def _held(table: pd.DataFrame, label: str, claimed: int) -> list[str]:
    if label not in table.index:
        return [DASH] * 3
    row = table.loc[label]
    held, low, high, of_read = (
        row[f"held_{claimed}{end}"] for end in ("", "_low", "_high", "_of_read")
    )
    said = _precise(held)
    known = f"{100 * low:.1f}{DASH}{_precise(high)}" if math.isfinite(low) else DASH
    return [f"{said} (too few)" if _off(row, claimed) < 0 else said, known, _precise(of_read)]


def _precise(value: float) -> str:
    return f"{value:.1%}" if math.isfinite(value) else DASH


def _off(row: pd.Series, claimed: int) -> int:
    """-1 where intervals hold the truth too seldom, 1 where too often, 0 where rightly."""
    by = row[f"held_{claimed}"] - claimed / 100
    if by < -SLIGHT and row[f"held_{claimed}_high"] < claimed / 100:
        return -1
    return int(by > SLIGHT and row[f"held_{claimed}_low"] > claimed / 100)


def covered(found: Sequence[Scalar], coverage: pd.DataFrame) -> list[str]:
    """Whether the 95% intervals hold the truth as often as they say, in sentences."""
    groups: dict[int, list[str]] = {}
    for scalar in found:
        if scalar.label in coverage.index and coverage.loc[scalar.label, "answered"]:
            row = coverage.loc[scalar.label]
            said = f"{named(scalar)} ({row['held_95']:.1%})"
            groups.setdefault(_off(row, 95), []).append(said)
    phrases = {
        0: "The 95% intervals hold the truth about as often as they say: {}.",
        1: "The 95% intervals hold the truth more often than they say: {}.",
        -1: "The 95% intervals hold the truth less often than they say: {}.",
    }
    return [phrases[off].format(_few(groups[off])) for off in phrases if off in groups]


def with_counter(coverage: pd.DataFrame) -> list[str]:
    """Which pixels the coverage counts, and which it leaves out."""
    said = []
    for counts, rows in coverage.groupby(["unknown", "masked", "unanswered", "answered"]):
        *others, answered = (int(count) for count in counts)
        reasons = ("of unknown truth", "masked", "read without an answer")
        aside = [f"{n:,} {why}" for n, why in zip(others, reasons, strict=True) if n]
        whose = "" if len(rows) == len(coverage) else f"{_few(list(rows.index))}: "
        left = f" Left out: {spoken(aside)}." if aside else " None is left out."
        said.append(f"{whose}{answered:,} pixels with an answer are counted.{left}")
    return said


def named(scalar: Scalar) -> str:
    """A parameter in words, with its unit and place."""
    symbol, meaning, unit = notation(scalar.name)
    words = f"{meaning} {GREEK.get(symbol, symbol)}".strip() + (f" [{unit}]" if unit != "1" else "")
    return plain(", ".join([words, *(place_of(d, x) for d, x in scalar.labels.items())]))


def _row(scalar: Scalar, words: str, cells: Sequence[str]) -> Row:
    return Row(scalar.label, words, tuple(cells), MAIN if scalar.is_material else INSTRUMENT)


def _few(names: Sequence[str]) -> str:
    more = len(names) - MOST_NAMED
    return spoken([*names[:MOST_NAMED], *([f"{more} more"] if more > 0 else [])])


# --- Maps as pictures: means and 95% widths (the paper's figure 3), and how far to trust them -----


MOST_PIXELS = 800
"""Longest side of a picture; of larger images every second, third, ... pixel is drawn."""

LARGEST_K = 1.0
NO_ANSWER = "#dadada"
APPROACH_COLORS = (NO_ANSWER, SKY, BLUE, GREEN, ORANGE, PURPLE)
STATUS_COLORS = (BLUE, NO_ANSWER, SKY, VERMILLION, ORANGE, PURPLE)


@styled
def plot_maps(maps: xr.Dataset, *, wavelength: float | None = None) -> Figure:
    """Means, widths of the 95% intervals, Pareto k, approach and status of a map.

    Args:
        maps: Of `polar_bayes.fit_pixels`, or opened from a store.
        wavelength: Which one is drawn of parameters that have several; by default the first. Unit
            nm.

    Returns:
        The figure: a column for each parameter, means above widths, and the maps of trust below.
        Gray is a pixel without an answer. Colors go from dark to bright for every reader.

    Raises:
        FitError: It holds no maps, or not that wavelength.
    """
    names = [str(name) for name in maps.data_vars if f"{name}_quantile" in maps]
    if not names:
        raise FitError("it holds no maps", where="plot_maps", hint="give what fit_pixels returns")
    shown, place = _one_wavelength(maps, wavelength)
    step = max(1, -(-max(maps.sizes["y"], maps.sizes["x"]) // MOST_PIXELS))
    shown = shown.isel(y=slice(None, None, step), x=slice(None, None, step))
    columns = max(len(names), 3)
    tall = 2.0 * min(max(maps.sizes["y"] / maps.sizes["x"], 0.4), 1.6) + 0.7
    figure = Drawing(figsize=(2.6 * columns, 3.0 * tall), layout="constrained")
    for at, name in enumerate(names):
        symbol, meaning, unit = notation(name)
        meaning = meaning.removesuffix(" relative to scattering")  # too long for a panel
        words = f"{meaning} {GREEK.get(symbol, symbol)}".strip()
        words += f", {place}" if "wavelength" in maps[name].dims else ""
        words += f" [{unit}]" if unit != "1" else ""
        ends = shown[f"{name}_quantile"].sel(quantile=[0.025, 0.975])
        width = ends.isel(quantile=1) - ends.isel(quantile=0)
        _picture(figure.add_subplot(3, columns, at + 1), shown[name], words, "viridis")
        _picture(figure.add_subplot(3, columns, columns + at + 1), width, "95% width", "cividis")
    axes = figure.add_subplot(3, columns, 2 * columns + 1)
    _picture(axes, shown["pareto_k"], "Pareto k", "magma", ends=(0.0, LARGEST_K))
    for at, (flags, colors) in enumerate(
        ((shown["approach"], APPROACH_COLORS), (checked_status(shown), STATUS_COLORS))
    ):
        _flags(figure.add_subplot(3, columns, 2 * columns + 2 + at), flags, colors)
    return figure


def _one_wavelength(maps: xr.Dataset, wavelength: float | None) -> tuple[xr.Dataset, str]:
    if "wavelength" not in maps.dims:
        return maps, ""
    known = maps["wavelength"].to_numpy()
    if wavelength is None:
        wavelength = float(known[0])
    if wavelength not in known:
        raise FitError(
            f"there is no wavelength {wavelength:g} nm",
            where="plot_maps",
            hint=f"give one of {', '.join(f'{each:g}' for each in known)}",
        )
    return maps.isel(wavelength=int(np.flatnonzero(known == wavelength)[0])), f"{wavelength:g} nm"


def _picture(
    axes: Axes,
    values: xr.DataArray,
    title: str,
    colors: str,
    ends: tuple[float, float] | None = None,
) -> None:
    """One map with its scale; without given ends it leaves one pixel in a hundred beyond each."""
    pixels = values.transpose("y", "x").to_numpy().astype(float)
    pixels = np.where(np.isfinite(pixels), pixels, np.nan)
    known = pixels[np.isfinite(pixels)]
    low, high = ends or (np.quantile(known, [0.01, 0.99]) if known.size else (0.0, 1.0))
    axes.set_facecolor(NO_ANSWER)
    drawn = axes.imshow(pixels, cmap=colors, vmin=low, vmax=high, interpolation="nearest")
    axes.figure.colorbar(drawn, ax=axes, shrink=0.85, extend="neither" if ends else "both")
    _frame(axes, title)


def _flags(axes: Axes, flags: xr.DataArray, colors: tuple) -> None:
    """A map of a few cases, each with a color of its own."""
    known = flag_words(flags)
    words = list(known.values())
    norm = BoundaryNorm(np.arange(len(words) + 1) - 0.5, len(words))
    pixels = flag_ranks(flags, known).reshape(flags.sizes["y"], flags.sizes["x"])
    drawn = axes.imshow(pixels, cmap=ListedColormap(colors), norm=norm, interpolation="nearest")
    scale = axes.figure.colorbar(drawn, ax=axes, shrink=0.85, ticks=range(len(words)))
    scale.ax.set_yticklabels(words)
    scale.ax.tick_params(length=0)
    _frame(axes, str(flags.name))


def _frame(axes: Axes, title: str) -> None:
    axes.set_title(wrapped(title, 26), loc="left")
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)


# --- The report of a map: what became of its pixels, pictures, tables, and coverage where known ---


TRUST = ("pareto_k", "approach", "status")
COLUMNS = 4
"""Parameters of one picture: more would be too small to read."""

BARE = "bare normal approximation of each pixel"
FITTED_BY = {
    "PixelLaplace": "normal approximation of each pixel, checked and corrected",
    "PixelSMC": "tempered draws of each pixel",
    "PixelNuts": "chains in each pixel",
}
UNCHECKED = (
    "The approximation was taken as it is (weighted=False): good means that the climb to the mode "
    "converged, and nothing says how far the numbers can be trusted."
)


def render_map(
    maps: xr.Dataset, truth: xr.Dataset | None = None, uncorrected: xr.Dataset | None = None
) -> str:
    """The page of a map as text."""
    found = map_scalars(maps)
    if any(name not in maps for name in TRUST):
        raise FitError("it holds no maps", where="report", hint="give what fit_pixels returns")
    _check_uncorrected(maps, truth, uncorrected)
    maps, provenance = ensure_loaded(maps), _provenance(maps)
    cases = count_cases(maps)
    said, is_enough = headline(cases)
    is_bare, fitted_by = _is_bare(provenance), provenance.get("fitted_by", "PixelLaplace")
    size = " x ".join(f"{maps.sizes[dim]:,}" for dim in IMAGE)
    coverage = None if truth is None else _coverage(maps, found, truth, uncorrected)
    content: dict[str, Any] = {
        "kind": "Map report",
        "name": _name(maps, provenance, truth),
        "under": [
            f"{size} pixels. {made_by(provenance, BARE if is_bare else FITTED_BY[fitted_by])}",
            *filter(None, [swapped_sentence(provenance)]),
        ],
        "headline": said,
        "is_enough": is_enough,
        "said": [*verdict(cases), *(coverage["said"] if coverage else [])],
        "cautions": [UNCHECKED] if is_bare else [],
        "pictures": list(_pictures(maps, found)),
        "status": status_table(cases),
        "approach": approach_table(cases),
        "parameters": parameter_table(maps, found),
        "coverage": coverage,
        "groups": provenance_groups(provenance),
    }
    return fill("map.html.j2", content)


def _check_uncorrected(
    maps: xr.Dataset, truth: xr.Dataset | None, uncorrected: xr.Dataset | None
) -> None:
    if uncorrected is None:
        return
    where = "report: uncorrected"
    if truth is None:
        raise FitError(
            "it is compared with the truth only", where=where, hint="give truth=capture as well"
        )
    map_scalars(uncorrected)
    if any(uncorrected.sizes[dim] != maps.sizes[dim] for dim in IMAGE):
        raise FitError("it is of another image", where=where, hint="map the same capture")
    if not _is_bare(_provenance(uncorrected), otherwise=True):
        raise FitError(
            "it was corrected as well",
            where=where,
            hint="make it with PixelLaplace(weighted=False)",
        )


def _is_bare(provenance: Mapping[str, Any], *, otherwise: bool = False) -> bool:
    """Whether the approximation was taken as it is."""
    settings = provenance.get("settings") or {}
    return not settings["weighted"] if "weighted" in settings else otherwise


def _provenance(maps: xr.Dataset) -> dict[str, Any]:
    return provenance_of(maps)


def _name(maps: xr.Dataset, provenance: Mapping[str, Any], truth: xr.Dataset | None) -> str:
    """What the capture is called, or the file of the map."""
    file = Path(str(maps.encoding.get("source", "map"))).stem
    known = [(provenance.get("capture") or {}).get("name"), maps.attrs.get("name")]
    known += [None if truth is None else truth.attrs.get("name"), file]
    return one_line(str(next(filter(None, known))))


def _coverage(
    maps: xr.Dataset, found: Sequence[Scalar], truth: xr.Dataset, uncorrected: xr.Dataset | None
) -> dict[str, Any]:
    """Coverage of the maps, and of those that were not corrected, in words and numbers."""
    own = map_coverage(maps, truth)
    other = None if uncorrected is None else map_coverage(uncorrected, truth)
    counts = {"": own} if other is None else {"Corrected: ": own, "Uncorrected: ": other}
    said = covered(found, own)
    if other is not None:
        bare = " ".join(covered(found, other))
        said += [f"Without the correction: {bare[0].lower()}{bare[1:]}"] if bare else []
    return {
        "table": coverage_table(found, own, other),
        "sentences": [
            f"{way}{each}" for way, table in counts.items() for each in with_counter(table)
        ],
        "said": said,
    }


def _pictures(maps: xr.Dataset, found: Sequence[Scalar]) -> Iterator[Picture]:
    """Means, widths and trust, a few parameters and one wavelength at a time."""
    own = {scalar.name: set(scalar.index) for scalar in found}
    names = [name for name, dims in own.items() if dims <= {"wavelength"}]
    step = max(1, -(-max(maps.sizes[dim] for dim in IMAGE) // MOST_PIXELS))
    caption = (
        "Posterior means above, widths of their 95% intervals below them, and how far each pixel "
        "can be trusted. Gray: no answer. One pixel in a hundred lies beyond each end of a scale."
    )
    caption += f" Of every {step} x {step} pixels one is drawn." if step > 1 else ""
    for at in range(0, len(names), COLUMNS):
        some = names[at : at + COLUMNS]
        colored = [name for name in some if "wavelength" in own[name]]
        for turn, wavelength in enumerate(_wavelengths(maps) if colored else [None]):
            shown = some if turn == 0 else colored
            wanted = [f"{name}{ending}" for name in shown for ending in ("", "_quantile")]
            place = "" if wavelength is None else f" at {wavelength:g} nm"
            yield picture(
                plot_maps(maps[[*wanted, *TRUST]], wavelength=wavelength),
                f"Maps of {spoken(shown)}{place}, with Pareto k, approach and status",
                caption if at + turn == 0 else f"The same of {_words(shown)}{place}.",
            )


def _wavelengths(maps: xr.Dataset) -> list[float]:
    """The first, the middle and the last: a map may have hundreds."""
    known = maps["wavelength"].to_numpy().astype(float).tolist()
    return list(dict.fromkeys([known[0], known[len(known) // 2], known[-1]]))


def _words(names: Sequence[str]) -> str:
    return spoken([name.replace("_", " ") for name in names])
