"""Readings against view zenith, with what the fitted model expects of them."""

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from polar_bayes.diagnostics.parameters import SAMPLE_DIMS, scalars
from polar_bayes.errors import FitError
from polar_bayes.inference.files import check_fit
from polar_bayes.inference.result import GEOMETRY, provenance_of
from polar_bayes.reporting.style import (
    BLUE,
    GRAY,
    QUANTITIES,
    SHORT,
    VERMILLION,
    Drawing,
    ink,
    lighten,
    place_of,
    plain,
    quiet_ticks,
    styled,
    wrapped,
)

LEVELS = (0.025, 0.25, 0.5, 0.75, 0.975)
MOST_AZIMUTHS = 4
MOST_ROWS = 6
WRAP = 3


@dataclasses.dataclass(frozen=True, eq=False)
class Curve:
    """One wavelength of one material: readings and predictions, each by view."""

    title: str
    zenith: np.ndarray
    azimuth: np.ndarray
    light_zenith: np.ndarray
    observed: np.ndarray
    fitted: np.ndarray
    saturated: np.ndarray
    levels: np.ndarray
    center: np.ndarray

    def at(self, views: np.ndarray) -> "Curve":
        """The same with some of the views, sorted by zenith."""
        order = np.flatnonzero(views & np.isfinite(self.zenith))
        order = order[np.argsort(self.zenith[order], kind="stable")]
        arrays = {
            field.name: getattr(self, field.name)[..., order]
            for field in dataclasses.fields(self)
            if field.name != "title"
        }
        return Curve(title=self.title, **arrays)

    def minus_center(self) -> "Curve":
        """Readings and predictions as distances from the fitted curve."""
        return dataclasses.replace(
            self,
            observed=self.observed - self.center,
            levels=self.levels - self.center,
            center=np.zeros_like(self.center),
        )

    @property
    def is_smooth(self) -> bool:
        """True where neighbors in zenith belong to one curve: one light, or the light follows."""
        if self.zenith.size < 3:
            return False
        follows = np.allclose(self.light_zenith, self.zenith, atol=1.0)
        return bool(np.ptp(self.light_zenith) < 0.5) or follows


def variables(result: xr.DataTree) -> list[str]:
    """The recorded variables of a result that can be drawn, polarization first."""
    check_fit(result)
    return [name for name in QUANTITIES if not _missing(result, name)]


def _missing(result: xr.DataTree, name: str) -> str:
    """What a result lacks to draw the readings of a variable: a path in the tree, or nothing."""
    drawn = ("observed_data", "noise_free", "posterior_predictive")
    parts = [(group, name) for group in drawn]
    parts += [("constant_data", each) for each in (*GEOMETRY, "valid", "saturated")]
    for group, variable in parts:
        if group not in result.children or variable not in result.children[group].data_vars:
            return f"{group}/{variable}"
    return "" if result["observed_data"].to_dataset()[name].sizes.get("view") else "view"


def curves(result: xr.DataTree, name: str) -> list[Curve]:
    """One recorded variable and its prediction, split by material and wavelength."""
    if name not in variables(result):
        lacks = f", for it has no {_missing(result, name)}" if name in QUANTITIES else ""
        raise FitError(
            f"the result has no readings of {name} to draw{lacks}",
            where="figure",
            hint=f"choose one of {', '.join(variables(result)) or 'none'}",
        )
    return list(_curves(result, name))


@styled
def plot_readings(result: xr.DataTree, name: str) -> Figure:
    """One recorded variable against view zenith, with posterior median and predictive bands.

    With 2 to 4 azimuths between view and light: a row for every material and wavelength (at most
    6), a column for every azimuth. Otherwise one panel for every material and wavelength.

    Args:
        result: A tree that `polar_bayes.fit` returned, or one read back from a file.
        name: dop, q, u or intensity.

    Returns:
        The figure.

    Raises:
        FitError: The result has no such variable.
    """
    return _draw(result, curves(result, name), name, QUANTITIES[name])


@styled
def plot_residuals(result: xr.DataTree, name: str) -> Figure:
    """The same after subtracting the fitted curve: where the model misses, and by how much.

    Args:
        result: A tree that `polar_bayes.fit` returned, or one read back from a file.
        name: dop, q, u or intensity.

    Returns:
        The figure, with the layout of `plot_readings`.

    Raises:
        FitError: The result has no such variable.
    """
    found = [curve.minus_center() for curve in curves(result, name)]
    return _draw(result, found, name, f"{SHORT[name]} minus fit")


def _draw(result: xr.DataTree, found: list[Curve], name: str, quantity: str) -> Figure:
    azimuths = _azimuths(found)
    apart = len(azimuths) > 1
    limit = float(provenance_of(result).get("largest_view_zenith", 90.0))
    place = _draw_by_azimuth if apart else _draw_wrapped
    figure, shown, drawn = place(found, azimuths, quantity, limit)
    for axes in figure.axes:
        quiet_ticks(axes)
    _limits(figure.axes[0], found, is_share=quantity == QUANTITIES["dop"])
    where = f", {_azimuth_title(azimuths[0])}" if len(azimuths) == 1 else ""
    # Not as a title: there it would lie under the legend.
    part = f" (the first {shown} of {len(found)})" if len(found) > shown else ""
    figure.supxlabel(f"view zenith [degree]{where}{part}", fontsize=9)
    handles = [handle for key, handle in _legend().items() if key in drawn]
    wide = figure.get_figwidth() > 7.0
    figure.legend(handles=handles, loc="outside upper left", ncols=4 if wide else 3, frameon=False)
    return figure


def _draw_by_azimuth(
    found: list[Curve], azimuths: list[float], quantity: str, limit: float
) -> tuple[Figure, int, set[str]]:
    """A row for each curve, a column for each azimuth."""
    shown = found[:MOST_ROWS]
    figure = Drawing(figsize=(8.2, 1.75 * len(shown) + 0.9), layout="constrained")
    panels = figure.subplots(len(shown), len(azimuths), sharex=True, sharey=True, squeeze=False)
    drawn: set[str] = set()
    shorter = {words: SHORT[name] for name, words in QUANTITIES.items()}
    for row, curve in zip(panels, shown, strict=True):
        short = shorter.get(quantity, quantity)
        row[0].set_ylabel("\n".join(plain(line, 24) for line in (short, curve.title) if line))
        for axes, azimuth in zip(row, azimuths, strict=True):
            drawn |= _panel(axes, curve.at(np.round(curve.azimuth) == azimuth), limit)
    for axes, azimuth in zip(panels[0], azimuths, strict=True):
        axes.set_title(_azimuth_title(azimuth))
    return figure, len(shown), drawn


def _draw_wrapped(
    found: list[Curve], azimuths: list[float], quantity: str, limit: float
) -> tuple[Figure, int, set[str]]:
    """One panel for each curve, whatever its azimuths, three in a row."""
    shown = found[: MOST_ROWS // 2 * WRAP]
    columns = {1: 1, 2: 2, 4: 2}.get(len(shown), WRAP)
    rows = -(-len(shown) // columns)
    size = (8.2, 2.1 * rows + 0.9) if columns > 1 else (6.6, 3.9)
    figure = Drawing(figsize=size, layout="constrained")
    panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    drawn: set[str] = set()
    for axes, curve in zip(panels.flat, shown, strict=False):
        drawn |= _panel(axes, curve.at(np.ones(curve.zenith.shape, bool)), limit)
        axes.set_title(wrapped(plain(curve.title), 34))
    for row in panels:
        row[0].set_ylabel(quantity)
    for axes in panels.flat[len(shown) :]:
        axes.set_axis_off()
    for axes in panels.flat[max(len(shown) - columns, 0) : len(shown)]:
        axes.tick_params(labelbottom=True)
    return figure, len(shown), drawn


def _curves(result: xr.DataTree, name: str) -> Iterator[Curve]:
    observed = result["observed_data"].to_dataset()[name]
    lead = [str(dim) for dim in observed.dims if dim != "view"]
    values = observed.transpose(*lead, "view").to_numpy().astype(float)
    order = (*SAMPLE_DIMS, *lead, "view")
    center, draws = (
        result[group][name].transpose(*order).to_numpy().astype(float).reshape(-1, *values.shape)
        for group in ("noise_free", "posterior_predictive")
    )
    center = np.median(center, axis=0)
    # A point fit has a single draw, whose quantiles would look like certainty.
    levels = np.full((len(LEVELS), *center.shape), np.nan)
    if len(draws) > 1:
        levels = np.quantile(draws, LEVELS, axis=0)
    constants = result["constant_data"].to_dataset()
    angles = {
        key: constants[key].broadcast_like(observed).transpose(*lead, "view").to_numpy()
        for key in GEOMETRY
    }
    fitted, saturated = (
        constants[flag].broadcast_like(observed).transpose(*lead, "view").to_numpy().astype(bool)
        for flag in ("valid", "saturated")
    )
    titles = _titles(observed, lead)
    turn = np.abs((angles["view_azimuth"] - angles["light_azimuth"] + 180.0) % 360.0 - 180.0)
    for place in np.ndindex(values.shape[:-1]):
        yield Curve(
            title=titles[place],
            zenith=angles["view_zenith"][place],
            azimuth=turn[place],
            light_zenith=angles["light_zenith"][place],
            observed=values[place],
            fitted=fitted[place],
            saturated=saturated[place],
            levels=levels[(slice(None), *place)],
            center=center[place],
        )


def _titles(observed: xr.DataArray, lead: list[str]) -> Mapping[tuple[int, ...], str]:
    marker = xr.Dataset({"x": observed.isel(view=0, drop=True).expand_dims(SAMPLE_DIMS)})
    return {
        tuple(scalar.index[dim] for dim in lead): ", ".join(
            place_of(dim, scalar.labels[dim]) for dim in lead
        )
        for scalar in scalars(marker)
    }


def _azimuths(found: list[Curve]) -> list[float]:
    """The distinct azimuths between view and light, to the degree; none if there are many."""
    turns = np.concatenate([curve.azimuth for curve in found])
    distinct = sorted(set(np.round(turns[np.isfinite(turns)])), reverse=True)
    return [float(turn) for turn in distinct] if len(distinct) <= MOST_AZIMUTHS else []


def _azimuth_title(azimuth: float) -> str:
    side = {180.0: " (mirror side)", 0.0: " (light's side)"}.get(azimuth, "")
    return f"azimuth {azimuth:g}°{side}"


def _panel(axes: Axes, curve: Curve, limit: float) -> set[str]:
    """Draw one panel; returns the keys of the legend entries that it uses."""
    drawn = _prediction(axes, curve)
    seen = np.isfinite(curve.observed)
    marks = {"reading": seen & ~curve.saturated, "saturated": seen & curve.saturated}
    for key, chosen in marks.items():
        if chosen.any():
            _mark(axes, key, curve.zenith[chosen], curve.observed[chosen])
            drawn.add(key)
    if (~seen).any():
        drawn.add("masked")
        axes.plot(
            curve.zenith[~seen],
            np.full(int(np.sum(~seen)), 0.03),
            transform=axes.get_xaxis_transform(),
            clip_on=False,
            **_masked_style(),
        )
    if limit < 90.0:
        axes.axvspan(limit, 90.0, color=lighten(GRAY, 0.9), lw=0, zorder=0)
        drawn.add("aside")
    return drawn


def _prediction(axes: Axes, curve: Curve) -> set[str]:
    if not curve.zenith.size:
        return set()
    style: dict[str, Any] = {"color": BLUE, "zorder": 3}
    if curve.is_smooth:
        axes.plot(curve.zenith, curve.center, lw=1.4, **style)
    else:
        axes.plot(curve.zenith, curve.center, "_", ms=7, mew=1.4, **style)
    # Where a reading is missing, so may be its error: the scatter there is not known.
    known = curve.fitted & np.isfinite(curve.levels).all(axis=0)
    if not known.any():
        return {"median"}
    zenith, levels = curve.zenith[known], curve.levels[:, known]
    for inner, share, width in ((0, 0.78, 2.0), (1, 0.5, 4.5)):
        low, high = levels[inner], levels[-1 - inner]
        color = lighten(BLUE, share)
        if curve.is_smooth:
            axes.fill_between(zenith, low, high, color=color, lw=0)
        else:
            axes.vlines(zenith, low, high, color=color, lw=width)
    return {"median", "half", "most"}


def _limits(axes: Axes, found: list[Curve], *, is_share: bool) -> None:
    zenith = np.concatenate([curve.zenith for curve in found])
    zenith = zenith[np.isfinite(zenith)]
    low, high = (float(zenith.min()), float(zenith.max())) if zenith.size else (0.0, 90.0)
    margin = max(0.03 * (high - low), 1.0)
    axes.set_xlim(max(low - margin, -1.0), min(high + margin, 91.0))
    if is_share:
        bottom, top = axes.get_ylim()
        axes.set_ylim(max(bottom, -0.03), min(top, 1.03))


def _mark(axes: Axes, key: str, x: np.ndarray, y: np.ndarray) -> None:
    style: dict[str, Any] = {
        "reading": {"marker": "o", "ms": 3.4, "color": ink()},
        "saturated": {"marker": "^", "ms": 5.5, "color": VERMILLION, "mec": ink(), "mew": 0.5},
    }[key]
    axes.plot(x, y, ls="none", zorder=5, **style)


def _masked_style() -> dict[str, Any]:
    return {"ls": "none", "marker": "x", "ms": 4.5, "color": GRAY, "mew": 1.1}


def _legend() -> dict[str, Line2D | Patch]:
    none: dict[str, Any] = {"ls": "none"}
    return {
        "reading": Line2D([], [], marker="o", ms=3.4, color=ink(), label="reading", **none),
        "saturated": Line2D(
            [], [], marker="^", ms=5.5, color=VERMILLION, mec=ink(), label="saturated", **none
        ),
        "masked": Line2D([], [], label="masked: not fitted", **_masked_style()),
        "aside": Patch(color=lighten(GRAY, 0.9), label="set aside: beyond the angle limit"),
        "median": Line2D([], [], color=BLUE, lw=1.4, label="fitted curve"),
        "half": Patch(color=lighten(BLUE, 0.5), label="50% of new readings"),
        "most": Patch(color=lighten(BLUE, 0.78), label="95% of new readings"),
    }
