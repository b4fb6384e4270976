"""Curves with bands of 50 and 95%: readings against view zenith, parameters against wavelength."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from polar_bayes.capture.plausibility import azimuth_difference
from polar_bayes.diagnostics.parameters import SAMPLE_DIMS, Scalar, is_hyperparameter, scalars
from polar_bayes.diagnostics.view import FitView, once, view_of
from polar_bayes.errors import FitError
from polar_bayes.inference.spectrum import predict_spectrum
from polar_bayes.observation.data import ANGLES
from polar_bayes.reporting import style
from polar_bayes.reporting.style import BLUE, GRAY, QUANTITIES, SHORT, VERMILLION, lighten

LEVELS = (0.025, 0.25, 0.5, 0.75, 0.975)

# --- Readings against view zenith -----------------------------------------------------------------

MAX_ROWS = 6
COLUMNS = 3


@once
def variables(fit: FitView) -> list[str]:
    """Return the recorded variables of a fit that can be drawn, polarization first."""
    return [name for name in QUANTITIES if not _missing(fit.result, name)]


def _missing(result: xr.DataTree, name: str) -> str:
    """Return the path of what a result lacks for a plot of a variable; empty if nothing."""
    needed = [(group, name) for group in ("observed_data", "noise_free", "posterior_predictive")]
    needed += [("constant_data", each) for each in (*ANGLES, "valid", "saturated")]
    for group, variable in needed:
        if group not in result.children or variable not in result.children[group].data_vars:
            return f"{group}/{variable}"
    return "" if result["observed_data"].to_dataset()[name].sizes.get("view") else "view"


@once
def curves(fit: FitView, name: str) -> list[xr.Dataset]:
    """Return a recorded variable and its prediction by view, for each material and wavelength."""
    result = fit.result
    if name not in variables(fit):
        lacks = f", for it has no {_missing(result, name)}" if name in QUANTITIES else ""
        hint = f"choose one of {', '.join(variables(fit)) or 'none'}"
        what = f"the result has no readings of {name} to draw{lacks}"
        raise FitError(what, where="figure", hint=hint)
    observed = result["observed_data"].to_dataset()[name].astype(float)
    constants = result["constant_data"].to_dataset()
    predicted = result["posterior_predictive"][name].astype(float)
    levels = predicted.quantile(LEVELS, SAMPLE_DIMS, skipna=False)
    if predicted.sizes["chain"] * predicted.sizes["draw"] == 1:
        # A point fit has a single draw, whose quantiles would look like certainty.
        levels = levels * np.nan
    data = xr.Dataset(
        {
            "observed": observed,
            "fitted": constants["valid"].astype(bool),
            "saturated": constants["saturated"].astype(bool),
            "center": result["noise_free"][name].astype(float).median(SAMPLE_DIMS, skipna=False),
            "levels": levels,
            "zenith": constants["view_zenith"],
            "light_zenith": constants["light_zenith"],
            "azimuth": azimuth_difference(constants),
        }
    ).map(lambda variable: variable.broadcast_like(observed))
    lead = [str(dim) for dim in observed.dims if dim != "view"]
    found = []
    for scalar in scalars(xr.Dataset({"x": observed.isel(view=0).expand_dims(SAMPLE_DIMS)})):
        title = ", ".join(style.coordinate_label(dim, scalar.labels[dim]) for dim in lead)
        curve = data.isel(scalar.index).transpose(..., "view")
        found.append(curve.assign_attrs(title=title))
    return found


def minus_center(curve: xr.Dataset) -> xr.Dataset:
    """Return readings and predictions minus the fitted curve."""
    return curve.assign(
        {name: curve[name] - curve["center"] for name in ("observed", "levels", "center")}
    )


def _at(curve: xr.Dataset, views: np.ndarray) -> xr.Dataset:
    """Select views, and sort them by zenith."""
    chosen = curve.isel(view=np.flatnonzero(views & np.isfinite(curve["zenith"].to_numpy())))
    return chosen.isel(view=np.argsort(chosen["zenith"].to_numpy(), kind="stable"))


def _is_smooth(curve: xr.Dataset) -> bool:
    """Return whether neighbors in zenith form one curve: the light is fixed or follows."""
    zenith, light = curve["zenith"].to_numpy(), curve["light_zenith"].to_numpy()
    if zenith.size < 3:
        return False
    return bool(np.ptp(light) < 0.5 or np.allclose(light, zenith, atol=1.0))


@style.styled
def plot_readings(result: xr.DataTree | FitView, name: str) -> Figure:
    """Plot a variable against view zenith, with posterior median and predictive bands.

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
    fit = view_of(result)
    figure = _draw_readings(fit, curves(fit, name), QUANTITIES[name], SHORT[name])
    if name == "dop":
        bottom, top = figure.axes[0].get_ylim()
        figure.axes[0].set_ylim(max(bottom, -0.03), min(top, 1.03))
    return figure


@style.styled
def readings_at_a_glance(fit: FitView) -> Figure:
    """Plot the first variable of the first material and color in a small panel."""
    name = variables(fit)[0]
    curve = curves(fit, name)[0]
    azimuths = _azimuths([curve])
    title = _azimuth_title(azimuths[0]) if azimuths else ""
    chosen = np.ones(curve.sizes["view"], bool)
    if azimuths:
        chosen = np.round(curve["azimuth"].to_numpy()) == azimuths[0]
    figure = style.NotebookFigure(figsize=(4.6, 3.3), layout="constrained")
    axes = figure.subplots()
    limit = float(fit.provenance.get("largest_view_zenith", 90.0))
    _draw_curve(axes, _at(curve, chosen), limit)
    shown = [style.label_text(part) for part in (curve.attrs["title"], title) if part]
    axes.set(xlabel="view zenith [degree]", ylabel=SHORT[name], xlim=_zenith_limits([curve]))
    axes.set_title(style.wrap(", ".join(shown), 44))
    style.add_legend(figure, columns=2)
    return figure


@style.styled
def plot_residuals(result: xr.DataTree | FitView, name: str) -> Figure:
    """Plot readings minus the fitted curve against view zenith, with predictive bands.

    Args:
        result: A tree that `polar_bayes.fit` returned, or one read back from a file.
        name: dop, q, u or intensity.

    Returns:
        The figure, with the layout of `plot_readings`.

    Raises:
        FitError: The result has no such variable.
    """
    fit = view_of(result)
    residuals = [minus_center(curve) for curve in curves(fit, name)]
    label = f"{SHORT[name]} minus fit"
    return _draw_readings(fit, residuals, label, label)


def _draw_readings(fit: FitView, found: list[xr.Dataset], label: str, short_label: str) -> Figure:
    azimuths = _azimuths(found)
    if len(azimuths) > 1:
        shown = found[:MAX_ROWS]
        figure, panels = _panels_by_azimuth(shown, azimuths, short_label)
    else:
        shown = found[: MAX_ROWS // 2 * COLUMNS]
        figure, panels = _panels_by_curve(shown, label)
    limit = float(fit.provenance.get("largest_view_zenith", 90.0))
    for axes, curve in panels:
        _draw_curve(axes, curve, limit)
    figure.axes[0].set_xlim(*_zenith_limits(found))
    where = f", {_azimuth_title(azimuths[0])}" if len(azimuths) == 1 else ""
    # Not as a title: there the legend would cover it.
    part = f" (the first {len(shown)} of {len(found)})" if len(found) > len(shown) else ""
    figure.supxlabel(f"view zenith [degree]{where}{part}")
    style.add_legend(figure, columns=4 if figure.get_figwidth() > 7.0 else 3)
    return figure


def _zenith_limits(found: list[xr.Dataset]) -> tuple[float, float]:
    zenith = np.concatenate([curve["zenith"] for curve in found])
    zenith = zenith[np.isfinite(zenith)]
    low, high = (float(zenith.min()), float(zenith.max())) if zenith.size else (0.0, 90.0)
    margin = max(0.03 * (high - low), 1.0)
    return max(low - margin, -1.0), min(high + margin, 91.0)


type Panels = list[tuple[Axes, xr.Dataset]]


def _panels_by_azimuth(
    shown: list[xr.Dataset], azimuths: list[float], label: str
) -> tuple[Figure, Panels]:
    """Draw a row for each curve, and a column for each azimuth."""
    figure = style.NotebookFigure(figsize=(8.2, 1.75 * len(shown) + 0.9), layout="constrained")
    axes = figure.subplots(len(shown), len(azimuths), sharex=True, sharey=True, squeeze=False)
    panels: Panels = []
    for row, curve in zip(axes, shown, strict=True):
        lines = [style.label_text(line, 24) for line in (label, curve.attrs["title"]) if line]
        row[0].set_ylabel("\n".join(lines))
        for each, azimuth in zip(row, azimuths, strict=True):
            panels.append((each, _at(curve, np.round(curve["azimuth"].to_numpy()) == azimuth)))
    for each, azimuth in zip(axes[0], azimuths, strict=True):
        each.set_title(_azimuth_title(azimuth))
    return figure, panels


def _panels_by_curve(shown: list[xr.Dataset], label: str) -> tuple[Figure, Panels]:
    """Draw one panel for each curve, with all its azimuths."""
    columns = {1: 1, 2: 2, 4: 2}.get(len(shown), COLUMNS)
    rows = -(-len(shown) // columns)
    size = (8.2, 2.1 * rows + 0.9) if columns > 1 else (6.6, 3.9)
    figure = style.NotebookFigure(figsize=size, layout="constrained")
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    panels: Panels = []
    for each, curve in zip(axes.flat, shown, strict=False):
        panels.append((each, _at(curve, np.ones(curve.sizes["view"], bool))))
        each.set_title(style.wrap(style.label_text(curve.attrs["title"]), 34))
    for row in axes:
        row[0].set_ylabel(label)
    for each in axes.flat[len(shown) :]:
        each.set_axis_off()
    for each in axes.flat[max(len(shown) - columns, 0) : len(shown)]:
        each.tick_params(labelbottom=True)
    return figure, panels


def _azimuths(found: list[xr.Dataset], most: int = 4) -> list[float]:
    """Return distinct azimuths between view and light, to the degree; none if too many."""
    azimuths = np.concatenate([curve["azimuth"] for curve in found])
    distinct = sorted(set(np.round(azimuths[np.isfinite(azimuths)])), reverse=True)
    return [float(each) for each in distinct] if len(distinct) <= most else []


def _azimuth_title(azimuth: float) -> str:
    side = {180.0: " (mirror side)", 0.0: " (light's side)"}.get(azimuth, "")
    return f"azimuth {azimuth:g}°{side}"


def _draw_curve(axes: Axes, curve: xr.Dataset, limit: float) -> None:
    """Draw one panel."""
    zenith, readings = curve["zenith"].to_numpy(), curve["observed"].to_numpy()
    if zenith.size:
        _draw_prediction(axes, curve, zenith)
    observed, saturated = np.isfinite(readings), curve["saturated"].to_numpy()
    ink = style.text_color()
    dot: style.Look = {"marker": "o", "ms": 3.4, "color": ink, "label": "reading"}
    full: style.Look = {"marker": "^", "ms": 5.5, "color": VERMILLION, "label": "saturated"}
    full |= {"mec": ink, "mew": 0.5}
    for chosen, look in ((observed & ~saturated, dot), (observed & saturated, full)):
        if chosen.any():
            axes.plot(zenith[chosen], readings[chosen], ls="none", zorder=5, **look)
    masked = zenith[~observed]
    if masked.size:
        cross: style.Look = {"ms": 4.5, "color": GRAY, "mew": 1.1, "label": "masked: not fitted"}
        cross |= {"transform": axes.get_xaxis_transform(), "clip_on": False}
        axes.plot(masked, np.full(masked.size, 0.03), "x", **cross)
    if limit < 90.0:
        aside: style.Look = {"lw": 0, "zorder": 0, "label": "set aside: beyond the angle limit"}
        axes.axvspan(limit, 90.0, color=lighten(GRAY, 0.9), **aside)


def _draw_prediction(axes: Axes, curve: xr.Dataset, zenith: np.ndarray) -> None:
    levels, is_smooth = curve["levels"].to_numpy(), _is_smooth(curve)
    line: style.Look = {"marker": "_", "ms": 7, "mew": 1.4, "ls": ""}
    line = {"lw": 1.4} if is_smooth else line
    center = curve["center"].to_numpy()
    axes.plot(zenith, center, color=BLUE, zorder=3, label="fitted curve", **line)
    # Where a reading is missing, so may be its error: the scatter there is not known.
    known = curve["fitted"].to_numpy() & np.isfinite(levels).all(axis=0)
    zenith, levels = zenith[known], levels[:, known]
    for inner, share, width in ((0, 0.78, 2.0), (1, 0.5, 4.5)) if known.any() else ():
        low, high = levels[inner], levels[-1 - inner]
        look: style.Look = {"color": lighten(BLUE, share)}
        look["label"] = f"{'50%' if inner else '95%'} of new readings"
        if is_smooth:
            axes.fill_between(zenith, low, high, lw=0, **look)
        else:
            axes.vlines(zenith, low, high, lw=width, **look)


# --- Parameters against wavelength ----------------------------------------------------------------

MAX_MEMBERS = 12
FINE = 61


@dataclasses.dataclass(frozen=True, eq=False)
class Spectrum:
    """A parameter of one member, with quantiles `at` measured or intermediate wavelengths."""

    title: str
    label: str
    measured: np.ndarray
    true: np.ndarray
    at: np.ndarray
    levels: np.ndarray

    @property
    def is_band(self) -> bool:
        """True if the parameter is known between the measured wavelengths."""
        return self.at is not self.measured


@once
def spectra(fit: FitView) -> dict[str, list[Spectrum]]:
    """Return each parameter of a fit over wavelength, for at most 12 members."""
    names = {scalar.name for scalar in fit.scalars}
    found: dict[str, dict[str, list[Scalar]]] = {}
    for scalar in fit.scalars:
        if "wavelength" in scalar.index and not is_hyperparameter(scalar.name, names):
            labels = {dim: at for dim, at in scalar.labels.items() if dim != "wavelength"}
            member = ", ".join(style.coordinate_label(dim, at) for dim, at in labels.items())
            found.setdefault(scalar.name, {}).setdefault(member, []).append(scalar)
    found = {name: members for name, members in found.items() if _can_be_drawn(members)}
    if not found or fit.method == "point":
        return {}
    wavelengths = fit.posterior["wavelength"].to_numpy().astype(float)
    low, high = wavelengths.min(), wavelengths.max()
    beyond = min(0.05 * (high - low), 0.5 * low)
    between = np.union1d(np.linspace(low - beyond, high + beyond, FINE), wavelengths)
    bands = _bands(fit, between)
    return {
        name: [
            _spectrum(fit, title, own, between, bands.get(name, {}).get(at))
            for at, (title, own) in enumerate(list(members.items())[:MAX_MEMBERS])
        ]
        for name, members in found.items()
    }


def _can_be_drawn(members: Mapping[str, Sequence[Scalar]]) -> bool:
    """Return whether there are two wavelengths, and all draws are finite."""
    return all(
        len({scalar.labels["wavelength"] for scalar in own}) > 1
        and all(bool(np.isfinite(scalar.draws).all()) for scalar in own)
        for own in members.values()
    )


def _bands(fit: FitView, between: np.ndarray) -> dict[str, dict[int, np.ndarray]]:
    """Return quantiles between measured wavelengths, by parameter and number of the member."""
    result, posterior = fit.result, fit.posterior
    step = max(1, posterior.sizes["chain"] * posterior.sizes["draw"] // 1000)
    chosen = {"draw": slice(None, None, step)}
    lead = [str(d) for d in posterior.dims if d in ("patch", "material")]
    if len(lead) == 1:
        chosen[lead[0]] = slice(MAX_MEMBERS)
    thin = xr.DataTree.from_dict(
        {
            group: result[group].to_dataset().isel(chosen, missing_dims="ignore")
            for group in ("posterior", "unconstrained_posterior")
            if group in result.children
        }
    )
    thin.attrs = dict(result.attrs)
    try:
        predicted = predict_spectrum(thin, between)
    except FitError:
        # Nothing ties the wavelengths together, or only the user's own model knows what does.
        return {}
    found: dict[str, dict[int, np.ndarray]] = {}
    for name, variable in predicted.data_vars.items():
        lead = [str(d) for d in variable.dims if d not in (*SAMPLE_DIMS, "wavelength")]
        draws = variable.transpose(*SAMPLE_DIMS, *lead, "wavelength").to_numpy()
        draws = draws.reshape(draws.shape[0] * draws.shape[1], -1, between.size)
        found[str(name)] = dict(enumerate(np.quantile(draws, LEVELS, axis=0).transpose(1, 0, 2)))
    return found


def _spectrum(
    fit: FitView,
    title: str,
    own: Sequence[Scalar],
    between: np.ndarray,
    band: np.ndarray | None,
) -> Spectrum:
    measured = fit.posterior["wavelength"].to_numpy().astype(float)
    order = np.argsort(measured, kind="stable")
    measured, own = measured[order], [own[i] for i in order]
    at, levels = between, band
    if levels is None or not np.isfinite(levels).all():
        draws = np.stack([scalar.draws.ravel() for scalar in own])
        at, levels = measured, np.quantile(draws, LEVELS, axis=1)
    label = style.short_title(own[0], fit.posterior)
    true = np.array([fit.truth(scalar) for scalar in own])
    return Spectrum(style.label_text(title), label, measured, true, at, levels)


@style.styled
def plot_spectrum(result: xr.DataTree | FitView, name: str) -> Figure:
    """Plot a parameter over wavelength: median, 50% and 95%, one panel per member.

    Args:
        result: A tree that `polar_bayes.fit` returned, or one read back from a file.
        name: The parameter, such as refractive_index.

    Returns:
        The figure: bands between and beyond the measured wavelengths where the fit ties colors
        together, and intervals at each of them where it does not.

    Raises:
        FitError: The fit does not have that parameter over wavelength.
    """
    fit = view_of(result)
    found = spectra(fit)
    if name not in found:
        hint = f"choose one of {', '.join(found) or 'none'}"
        what = f"{name} was not fitted over wavelength"
        raise FitError(what, where="plot_spectrum", hint=hint)
    shown = found[name]
    several = len(shown) > 1
    width, height = (8.2, 1.9) if several else (6.6, 2.9)
    columns = 3 if len(shown) != 4 else 2
    size: style.Look = {"width": width, "panel_height": height, "header": 0.8}
    figure, panels = style.grid(len(shown), columns=columns, **size)
    for axes, each in zip(panels, shown, strict=True):
        _draw_spectrum(axes, each)
        axes.set_title(style.wrap(each.title, 34) if several else "", loc="left")
    # One scale for all members, so that they can be compared.
    low, high = (end([axes.get_ylim() for axes in panels]) for end in (np.min, np.max))
    for axes in panels:
        axes.set_ylim(low, high)
        axes.locator_params(axis="x", nbins=5)
    sizes = fit.posterior[name].sizes
    total = np.prod([sizes[dim] for dim in sizes if dim not in (*SAMPLE_DIMS, "wavelength")])
    part = f" (the first {len(shown)} of {int(total)})" if total > len(shown) else ""
    figure.supxlabel(f"wavelength [nm]{part}")
    figure.supylabel(shown[0].label)
    style.add_legend(figure, columns=5)
    return figure


def _draw_spectrum(axes: Axes, each: Spectrum) -> None:
    middle: style.Look = {"color": BLUE, "zorder": 4, "label": "posterior median"}
    if each.is_band:
        axes.plot(each.at, each.levels[2], lw=1.4, **middle)
        limits = each.at[[0, -1]]
    else:
        ring: style.Look = {"mfc": style.background(), "ms": 4.5}
        axes.plot(each.measured, each.levels[2], "o", **middle, **ring)
        margin = 0.08 * np.ptp(each.measured)
        limits = each.measured[[0, -1]] + [-margin, margin]
    for inner, share, width in ((0, 0.75, 1.1), (1, 0.45, 3.6)):
        low, high, label = each.levels[inner], each.levels[-1 - inner], ("95%", "50%")[inner]
        if each.is_band:
            axes.fill_between(each.at, low, high, color=lighten(BLUE, share), lw=0, label=label)
        else:
            axes.vlines(each.measured, low, high, color=BLUE, lw=width, label=label)
    for at in each.measured if each.is_band else ():
        dashes: style.Look = {"ls": (0, (2, 2)), "zorder": 3, "label": "measured"}
        axes.axvline(at, color=lighten(GRAY, 0.6), lw=0.7, **dashes)
    known = np.isfinite(each.true)
    if known.any():
        truth = {**style.true_value_style(), "mew": 0.6}
        axes.plot(each.measured[known], each.true[known], zorder=6, **truth)
    axes.set_xlim(*limits)
