"""Report of a map: status of its pixels, figures, parameters, and coverage where known."""

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure

from polar_bayes.diagnostics.coverage import INTERVALS, map_coverage, map_scalars
from polar_bayes.diagnostics.parameters import Scalar
from polar_bayes.errors import FitError, one_line
from polar_bayes.inference.batching import IMAGE, Status, cut
from polar_bayes.inference.request import MIN_VIEWS
from polar_bayes.inference.result import provenance_of
from polar_bayes.maps.lazy import (
    CHUNK,
    COPY,
    checked_status,
    count_criticism,
    criticism_sentences,
    ensure_loaded,
    map_parameters,
    setup_sentences,
    shared_cautions,
    shared_parameters,
    start_sentences,
)
from polar_bayes.methods.registry import MAP_DEFAULT
from polar_bayes.physics.part import notation
from polar_bayes.reporting import page, style, text
from polar_bayes.reporting.fit_page import INSTRUMENT_GROUP, provenance_facts
from polar_bayes.reporting.style import BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILLION
from polar_bayes.reporting.text import DASH, METHODS_USED, SLIGHT, count_percent, digits, quarter
from polar_bayes.repr_html import Row, Table

NO_ANSWER = "#dadada"
STATUSES = {
    "good": (BLUE, "an answer that the checks let pass"),
    "masked": (NO_ANSWER, "no valid reading"),
    "too few views": (SKY, f"fewer than {MIN_VIEWS} valid views"),
    "not converged": (VERMILLION, "no answer was reached; NaN"),
    "not trusted": (ORANGE, "numbers that no check confirms, by the method in the next table"),
    "contradicted": (GREEN, "numbers of a good posterior, whose model the readings contradict"),
    "not fitted": (PURPLE, "called good without finite numbers, or never written"),
}
"""Color and meaning of each status of a pixel."""
STATUS_MEANINGS = {status: meaning for status, (_, meaning) in STATUSES.items()}
CHECKS = {
    "priors": "medians in the tails of their priors",
    "noise": "scatter above its prior, or three times the stated errors",
    "residuals": "correlated errors of neighboring views, an outlier, or all above the noise",
    "bounds": "a posterior that lies against a bound",
    "any": "any of these",
}

# --- Figures --------------------------------------------------------------------------------------


@style.styled
def plot_maps(maps: xr.Dataset, *, wavelength: float | None = None) -> Figure:
    """Plot means, widths of 95% intervals, Pareto k, method and status of a map.

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
    names = map_parameters(maps)
    if not names:
        raise FitError("it holds no maps", where="plot_maps", hint="give what fit_pixels returns")
    shown, place = _at_wavelength(maps, wavelength)
    step = _pixel_step(maps)
    shown = shown.isel(y=slice(None, None, step), x=slice(None, None, step))
    columns = max(len(names), 3)
    height = 2.0 * min(max(maps.sizes["y"] / maps.sizes["x"], 0.4), 1.6) + 0.7
    figure = style.NotebookFigure(figsize=(2.6 * columns, 3.0 * height), layout="constrained")

    def panel(row: int, column: int) -> Axes:
        return figure.add_subplot(3, columns, row * columns + column + 1)

    for at, name in enumerate(names):
        symbol, meaning, unit = notation(name)
        meaning = meaning.removesuffix(" relative to scattering")  # too long for a panel
        title = style.quantity_label(meaning, symbol, "1")
        title += f", {place}" if "wavelength" in maps[name].dims else ""
        title += f" [{unit}]" if unit != "1" else ""
        low, high = (shown[f"{name}_quantile"].sel(quantile=q) for q in INTERVALS[95])
        _draw_values(panel(0, at), shown[name], title, "viridis")
        _draw_values(panel(1, at), high - low, "95% width", "cividis")
    _draw_values(panel(2, 0), shown["pareto_k"], "Pareto k", "magma", limits=(0.0, 1.0))
    _draw_flags(panel(2, 1), shown["method"], (NO_ANSWER, SKY, BLUE, GREEN, ORANGE, PURPLE))
    status = checked_status(shown)
    colors = [STATUSES.get(each, (NO_ANSWER,))[0] for each in flag_meanings(status).values()]
    _draw_flags(panel(2, 2), status, colors)
    return figure


def _pixel_step(maps: xr.Dataset, most: int = 800) -> int:
    """Return the step between drawn pixels of a large image."""
    return max(1, -(-max(maps.sizes[dim] for dim in IMAGE) // most))


def _at_wavelength(maps: xr.Dataset, wavelength: float | None) -> tuple[xr.Dataset, str]:
    if "wavelength" not in maps.dims:
        return maps, ""
    known = maps["wavelength"].to_numpy()
    wavelength = float(known[0]) if wavelength is None else wavelength
    if wavelength not in known:
        what = f"there is no wavelength {wavelength:g} nm"
        hint = f"give one of {', '.join(f'{each:g}' for each in known)}"
        raise FitError(what, where="plot_maps", hint=hint)
    return maps.isel(wavelength=int(np.flatnonzero(known == wavelength)[0])), f"{wavelength:g} nm"


def _draw_values(
    axes: Axes,
    values: xr.DataArray,
    title: str,
    colors: str,
    limits: tuple[float, float] | None = None,
) -> None:
    """Draw one map with its scale, which excludes one percent of pixels at each end."""
    pixels = values.transpose(*IMAGE).to_numpy().astype(float)
    pixels = np.where(np.isfinite(pixels), pixels, np.nan)
    known = pixels[np.isfinite(pixels)]
    low, high = limits or (np.quantile(known, [0.01, 0.99]) if known.size else (0.0, 1.0))
    axes.set_facecolor(NO_ANSWER)
    drawn = axes.imshow(pixels, cmap=colors, vmin=low, vmax=high, interpolation="nearest")
    axes.figure.colorbar(drawn, ax=axes, shrink=0.85, extend="neither" if limits else "both")
    _set_frame(axes, title)


def _draw_flags(axes: Axes, flags: xr.DataArray, colors: Sequence[str]) -> None:
    """Draw a map of a few categories with one color each."""
    meanings = flag_meanings(flags)
    count = len(meanings)
    norm = BoundaryNorm(np.arange(count + 1) - 0.5, count)
    pixels = flag_indices(flags, meanings).reshape(flags.sizes["y"], flags.sizes["x"])
    drawn = axes.imshow(
        pixels, cmap=ListedColormap(list(colors)), norm=norm, interpolation="nearest"
    )
    scale = axes.figure.colorbar(drawn, ax=axes, shrink=0.85, ticks=range(count))
    scale.ax.set_yticklabels(list(meanings.values()))
    scale.ax.tick_params(length=0)
    _set_frame(axes, str(flags.name))


def _set_frame(axes: Axes, title: str) -> None:
    axes.set_title(style.wrap(title, 26), loc="left")
    axes.set(xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set_visible(False)


# --- Flags of pixels ------------------------------------------------------------------------------


def flag_meanings(flags: xr.DataArray) -> dict[int, str]:
    """Return the meaning of each flag from the map, which is correct for older maps, too."""
    words = str(flags.attrs["flag_meanings"]).lower().split()
    meanings = [each.replace("_", " ") for each in words]
    values = np.asarray(flags.attrs.get("flag_values", range(len(meanings))))
    known = dict(zip(map(int, values), meanings, strict=True))
    if flags.name == "status":  # a map may lose chunks, whether or not it states that flag
        known.setdefault(int(Status.NOT_FITTED), "not fitted")
    return known


def flag_indices(flags: xr.DataArray, meanings: Mapping[int, str]) -> np.ndarray:
    """Return the index of each pixel's flag among the known flags, (y, x)."""
    values = flags.transpose(*IMAGE).to_numpy().ravel()
    found = np.full(values.size, -1)
    for index, value in enumerate(meanings):
        found[values == value] = index
    if (found < 0).any():
        what, hint = f"{values[np.argmin(found)]} has no meaning there", COPY
        raise FitError(what, where=f"maps: {flags.name}", hint=hint)
    return found


def count_cases(maps: xr.Dataset) -> pd.DataFrame:
    """Count pixels by status (rows) and method (columns)."""
    rows, columns = (flag_meanings(maps[name]) for name in ("status", "method"))
    counts = np.zeros((len(rows), len(columns)), int)
    for place in cut(maps, CHUNK):
        block = maps.isel(place)
        status = flag_indices(checked_status(block), rows)
        np.add.at(counts, (status, flag_indices(block["method"], columns)), 1)
    return pd.DataFrame(counts, index=list(rows.values()), columns=list(columns.values()))


# --- The page -------------------------------------------------------------------------------------

TRUST = ("pareto_k", "method", "status")
UNCHECKED = "laplace"
"""Method of a map whose draws are not checked."""


def map_card(result: xr.Dataset) -> page.Card:
    """Return the card of a map."""
    table = parameter_table(result, parameter_titles(map_scalars(result)))
    counts = count_cases(result)
    headline, passed = text.map_headline(counts)
    sentences = [headline, *text.pixel_sentences(counts), *criticism_sentences(result)]
    return sentences, table, passed


def map_page(
    maps: xr.Dataset,
    truth: xr.Dataset | None = None,
    uncorrected: xr.Dataset | None = None,
    capture: xr.Dataset | None = None,
) -> page.Page:
    """The page of a map; the readings of its capture are on the one to point at."""
    del capture
    titles = parameter_titles(map_scalars(maps))
    if any(name not in maps for name in TRUST):
        raise FitError("it holds no maps", where="report", hint="give what fit_pixels returns")
    if uncorrected is not None:
        _check_uncorrected(maps, truth, uncorrected)
    maps, provenance = ensure_loaded(maps), provenance_of(maps)
    counts = count_cases(maps)
    headline, passed = text.map_headline(counts)
    method = str(provenance.get("method", MAP_DEFAULT))
    size = " x ".join(f"{maps.sizes[dim]:,}" for dim in IMAGE)
    sentences = [
        *text.pixel_sentences(counts),
        *criticism_sentences(maps),
        *start_sentences(maps),
        *setup_sentences(maps),
    ]
    coverage: list[page.Block] = []
    if truth is not None:
        conclusions, coverage = _coverage(maps, titles, truth, uncorrected)
        sentences += conclusions
    shared = shared_parameters(maps)
    tables: list[page.Block | None] = [
        parameter_table(maps, titles),
        page.caption("map.regions"),
        None if shared.empty else shared_table(shared),
    ]
    explorer = text.no_explorer()
    if page.has_explorer():
        explorer = page.block("link", "The same map to point at, pixel by pixel.", page.EXPLORER)
    sections = [
        page.Section("maps", "Maps", [explorer, *_pictures(maps, list(titles))]),
        page.Section("pixels", "Pixels", [*_pixel_tables(counts), *_criticism_table(maps)]),
        page.Section("parameters", "Parameters", tables),
        page.Section("coverage", "Coverage", coverage),
        page.Section("provenance", "Provenance", provenance_facts(provenance)),
    ]
    return page.Page(
        kind="Map report",
        name=map_name(maps, truth),
        subtitles=[
            f"{size} pixels. {text.made_by(provenance, text.method_label(method))}",
            text.swapped_sentence(provenance),
        ],
        headline=headline,
        passed=passed,
        sentences=sentences,
        cautions=[
            *([page.caption("map.unchecked")] if method == UNCHECKED else []),
            *shared_cautions(maps),
        ],
        sections=sections,
        footer="Computed from the maps of every pixel, which stay where they are.",
    )


def _check_uncorrected(maps: xr.Dataset, truth: xr.Dataset | None, uncorrected: xr.Dataset) -> None:
    where = "report: uncorrected"
    if truth is None:
        hint = "give truth=capture as well"
        raise FitError("it is compared with the truth only", where=where, hint=hint)
    map_scalars(uncorrected)
    if any(uncorrected.sizes[dim] != maps.sizes[dim] for dim in IMAGE):
        raise FitError("it is of another image", where=where, hint="map the same capture")
    if provenance_of(uncorrected).get("method") != UNCHECKED:
        hint = "make it with method='laplace'"
        raise FitError("it was corrected as well", where=where, hint=hint)


def map_name(maps: xr.Dataset, truth: xr.Dataset | None = None) -> str:
    """The name of the capture, or of the file of the map."""
    file = Path(str(maps.encoding.get("source", "map"))).stem
    names = [text.capture_name(provenance_of(maps), ""), maps.attrs.get("name")]
    names += [None if truth is None else truth.attrs.get("name"), file]
    return one_line(str(next(filter(None, names))))


def parameter_titles(scalars: Sequence[Scalar]) -> dict[Scalar, str]:
    """Return a title with symbol, unit and coordinates for every parameter."""
    titles = {}
    for scalar in scalars:
        symbol, meaning, unit = notation(scalar.name)
        names = [style.quantity_label(meaning, symbol, unit), *style.coordinate_labels(scalar)]
        titles[scalar] = style.label_text(", ".join(names))
    return titles


def _pictures(maps: xr.Dataset, scalars: Sequence[Scalar]) -> Iterator[str]:
    """Yield figures of means, widths and diagnostics, a few parameters each."""
    dims = {scalar.name: set(scalar.index) for scalar in scalars}
    names = [name for name in dims if dims[name] <= {"wavelength"}]
    step = _pixel_step(maps)
    thinned = f" Of every {step} x {step} pixels one is drawn." if step > 1 else ""
    for at in range(0, len(names), 4):  # more columns would be too small to read
        some = names[at : at + 4]
        spectral = [name for name in some if "wavelength" in dims[name]]
        for turn, wavelength in enumerate(shown_wavelengths(maps) if spectral else [None]):
            shown = some if turn == 0 else spectral
            variables = [f"{name}{ending}" for name in shown for ending in ("", "_quantile")]
            place = "" if wavelength is None else f" at {wavelength:g} nm"
            drawn = f"{text.join(shown)}{place}"
            caption = f"The same of {drawn.replace('_', ' ')}." if at + turn else ""
            more = "" if caption else thinned
            figure = plot_maps(maps[[*variables, *TRUST]], wavelength=wavelength)
            yield page.picture(figure, "map.figure_maps", instead=caption, more=more, names=drawn)


def shown_wavelengths(maps: xr.Dataset) -> list[float]:
    """The first, the middle and the last: a map may have hundreds."""
    known = maps["wavelength"].to_numpy().astype(float).tolist()
    return list(dict.fromkeys([known[0], known[len(known) // 2], known[-1]]))


# --- Tables ---------------------------------------------------------------------------------------


def _pixel_tables(counts: pd.DataFrame) -> Iterator[Table]:
    """Return tables of pixels by status, and by method with the share that is good."""
    yield count_table("map.status", counts.sum(axis=1).to_frame("pixels"), STATUS_MEANINGS)
    good = counts.loc["good"] if "good" in counts.index else 0 * counts.sum()
    data = pd.DataFrame({"pixels": counts.sum(), "good": good})
    yield count_table("map.method", data, METHODS_USED)


def _criticism_table(maps: xr.Dataset) -> Iterator[Table]:
    """Return a table of pixels by check; None for maps without checks."""
    data = count_criticism(maps)
    if not data.empty:
        yield page.make_table(
            "map.criticism",
            {str(level): text.column(str(level), ",.0f") for level in data.columns},
            data,
            label="check",
            descriptions=CHECKS,
            prose=["check"],
        )


def count_table(key: str, data: pd.DataFrame, meanings: Mapping[str, str]) -> Table:
    """Return a table of counts by flag: number, share, and number that meet a condition."""
    what, *others = map(str, data.columns)
    total = int(data[what].sum())
    cells: page.Cells = {
        what: text.column(what, ",.0f"),
        "share": lambda row: count_percent(int(row[what]), total),
        **{each: text.column(each, ",.0f") for each in others},
    }
    data = data.copy()
    data.insert(1, "share", data[what] / max(total, 1))
    label = key.partition(".")[2]
    return page.make_table(key, cells, data, label=label, descriptions=meanings, prose=[label])


def parameter_table(maps: xr.Dataset, titles: Mapping[Scalar, str]) -> Table:
    """Return a table over good pixels: value, variation and uncertainty of parameters."""
    data = {}
    for scalar in titles:
        mean, sd, width = (_over_good(maps, scalar, end) for end in ("", "_sd", "_quantile"))
        median, *medians = (
            float(np.median(each)) if each.size else math.nan for each in (mean, sd, width)
        )
        ends = np.quantile(mean, [0.05, 0.95]).tolist() if mean.size else [math.nan] * 2
        data[scalar.label] = [median, *ends, *medians]
    columns = ["median", "5% below", "5% above", "typical sd", "95% width"]
    return page.make_table(
        "map.parameter",
        {column: digits(column, "typical sd") for column in columns},
        pd.DataFrame.from_dict(data, orient="index", columns=columns),
        descriptions={scalar.label: title for scalar, title in titles.items()},
        groups={scalar.label: _group(scalar) for scalar in titles},
    )


def shared_table(shared: pd.DataFrame) -> Table:
    """Return a table of the parameters that all pixels share."""
    return page.make_table(
        "map.shared",
        {
            **{column: digits(column, quarter) for column in ("q2.5", "q50", "q97.5")},
            "pixels": text.column("pixels", ",.0f"),
            "disagreement": text.column("disagreement", ".1f"),
        },
        shared,
        descriptions={name: notation(name).meaning for name in shared.index},
    )


def _group(scalar: Scalar) -> str:
    return "" if scalar.is_material else INSTRUMENT_GROUP


def _over_good(maps: xr.Dataset, scalar: Scalar, ending: str) -> np.ndarray:
    """Return values of a map over the good pixels, or widths of its intervals, (pixel,)."""
    values = maps[f"{scalar.name}{ending}"].isel(scalar.index)
    found = []
    for place in cut(maps, CHUNK):
        block = values.isel(place).load()
        if "quantile" in block.dims:
            low, high = (block.sel(quantile=level, drop=True) for level in INTERVALS[95])
            block = high - low
        good = (maps["status"].isel(place) == Status.GOOD).load()
        is_shown = (good & np.isfinite(block)).transpose(*block.dims)
        found.append(block.to_numpy()[is_shown.to_numpy()])
    return np.concatenate(found)


# --- Coverage -------------------------------------------------------------------------------------


def _coverage(
    maps: xr.Dataset,
    titles: Mapping[Scalar, str],
    truth: xr.Dataset,
    uncorrected: xr.Dataset | None,
) -> tuple[list[str], list[page.Block]]:
    """Return conclusions on the coverage of maps, corrected and uncorrected, and blocks."""
    by_label = {scalar.label: title for scalar, title in titles.items()}
    own = map_coverage(maps, truth)
    conclusions, tables = text.coverage_sentences(by_label, own), {"": own}
    if uncorrected is not None:
        other = map_coverage(uncorrected, truth)
        tables = {"Corrected: ": own, "Uncorrected: ": other}
        if bare := " ".join(text.coverage_sentences(by_label, other)):
            conclusions += [f"Without the correction: {bare[0].lower()}{bare[1:]}"]
    counted = [
        f"{prefix}{each}" for prefix, table in tables.items() for each in text.counted_pixels(table)
    ]
    return conclusions, [coverage_table(titles, list(tables.values())), *counted]


def coverage_table(titles: Mapping[Scalar, str], tables: Sequence[pd.DataFrame]) -> Table:
    """Return a table of coverage, next to that of uncorrected maps."""
    ways = ["holds the truth"] if len(tables) == 1 else ["corrected", "uncorrected"]
    columns = [column for way in ways for column in (way, "within", "of all read")]
    rows = []
    for scalar, title in titles.items():
        for claimed in INTERVALS if scalar.label in tables[0].index else ():
            cells = [f"{claimed}%"]
            for table in tables:
                cells += _coverage_cells(table, scalar.label, claimed)
            description = title if claimed == min(INTERVALS) else scalar.label
            rows.append(Row(scalar.label, tuple(cells), description, _group(scalar)))
    caption = page.caption("map.coverage", slight=100 * SLIGHT)
    data = tables[0]
    for other in tables[1:]:
        data = data.join(other.add_suffix("_uncorrected"))
    columns = ["parameter", "interval", *columns]
    return Table(tuple(columns), tuple(rows), (), "coverage", caption, data)


def _coverage_cells(table: pd.DataFrame, label: str, claimed: int) -> list[str]:
    if label not in table.index:
        return [DASH] * 3
    row = table.loc[label]
    held, low, high, of_read = (
        text.or_dash(row[f"held_{claimed}{end}"], ".1%")
        for end in ("", "_low", "_high", "_of_read")
    )
    known = f"{low.removesuffix('%')}{DASH}{high}" if low != DASH else DASH
    is_low = text.coverage_error(row, claimed) < 0
    return [f"{held} (too few)" if is_low else held, known, of_read]


REPORT = page.Report(map_page, map_card, plot_maps, ("truth", "uncorrected", "capture"))
