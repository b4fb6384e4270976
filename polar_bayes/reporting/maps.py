"""Maps as pictures: means and 95% widths (the paper's figure 3), and how far to trust them."""

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure

from polar_bayes.errors import FitError
from polar_bayes.physics.notation import notation
from polar_bayes.pixels.maps import checked_status
from polar_bayes.reporting.map_tables import flag_ranks, flag_words
from polar_bayes.reporting.style import (
    BLUE,
    GREEK,
    GREEN,
    ORANGE,
    PURPLE,
    SKY,
    VERMILLION,
    Drawing,
    styled,
    wrapped,
)

MOST_PIXELS = 800
"""Longest side of a picture; of larger images every second, third, ... pixel is drawn."""

LARGEST_K = 1.0
NO_ANSWER = "#dadada"
APPROACHES = (NO_ANSWER, SKY, BLUE, GREEN, ORANGE, PURPLE)
STATUSES = (BLUE, NO_ANSWER, SKY, VERMILLION, ORANGE, PURPLE)


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
        raise FitError("it holds no maps", where="plot_maps", mend="give what fit_pixels returns")
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
        ((shown["approach"], APPROACHES), (checked_status(shown), STATUSES))
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
            mend=f"give one of {', '.join(f'{each:g}' for each in known)}",
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
