"""The optical constants over wavelength: bands where a fit ties colors together, else intervals."""

import dataclasses
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from polar_bayes.diagnostics.parameters import (
    SAMPLE_DIMS,
    Scalar,
    is_hyperparameter,
    method_of,
    posterior_scalars,
    truth_of,
)
from polar_bayes.errors import FitError
from polar_bayes.inference.spectrum import predict_spectrum
from polar_bayes.reporting.style import (
    BLUE,
    GRAY,
    ORANGE,
    grid,
    lighten,
    paper,
    place_of,
    plain,
    quiet_ticks,
    styled,
    title_of,
    wrapped,
)

LEVELS = (0.025, 0.25, 0.5, 0.75, 0.975)
MOST_MEMBERS = 12
MOST_DRAWS = 1000
FINE = 61
BEYOND = 0.05


@dataclasses.dataclass(frozen=True, eq=False)
class Spectrum:
    """One parameter of one member over wavelength."""

    title: str
    words: str
    measured: np.ndarray
    levels: np.ndarray
    true: np.ndarray
    between: np.ndarray
    band: np.ndarray


def spectra(result: xr.DataTree) -> dict[str, list[Spectrum]]:
    """What a fit says of each parameter over wavelength, of at most 12 members."""
    found: dict[str, dict[tuple[str, ...], list[Scalar]]] = {}
    every = posterior_scalars(result)
    names = {scalar.name for scalar in every}
    for scalar in every:
        if "wavelength" in scalar.index and not is_hyperparameter(scalar.name, names):
            member = tuple(
                place_of(dim, label) for dim, label in scalar.labels.items() if dim != "wavelength"
            )
            found.setdefault(scalar.name, {}).setdefault(member, []).append(scalar)
    found = {name: members for name, members in found.items() if _applies(members)}
    if not found or method_of(result) == "point":
        return {}
    measured = result["posterior"].to_dataset()["wavelength"].to_numpy().astype(float)
    between = _fine(measured)
    bands = _bands(result, between)
    posterior = result["posterior"].to_dataset()
    return {
        name: [
            _spectrum(
                result, posterior, member, own, measured, between, bands.get(name, {}).get(at)
            )
            for at, (member, own) in enumerate(list(members.items())[:MOST_MEMBERS])
        ]
        for name, members in found.items()
    }


@styled
def plot_spectrum(
    result: xr.DataTree, name: str, found: dict[str, list[Spectrum]] | None = None
) -> Figure:
    """One parameter over wavelength: median, 50% and 95%, a panel for each member.

    Args:
        result: A tree that `polar_bayes.fit` returned, or one read back from a file.
        name: The parameter, such as refractive_index.
        found: That of `spectra(result)`, where it is there already.

    Returns:
        The figure: bands between and beyond the measured wavelengths where the fit ties colors
        together, and intervals at each of them where it does not.

    Raises:
        FitError: The fit does not have that parameter over wavelength.
    """
    found = spectra(result) if found is None else found
    if name not in found:
        raise FitError(
            f"{name} was not fitted over wavelength",
            where="plot_spectrum",
            hint=f"choose one of {', '.join(found) or 'none'}",
        )
    shown = found[name]
    many = len(shown) > 1
    figure, panels = grid(
        len(shown),
        columns=3 if len(shown) != 4 else 2,
        width=8.2 if many else 6.6,
        panel_height=1.9 if many else 2.9,
        header=0.8,
    )
    for axes, each in zip(panels, shown, strict=True):
        _panel(axes, each)
        axes.set_title(wrapped(each.title, 34) if many else "", loc="left")
    _share(panels)
    quiet_ticks(panels)
    every = _count(result, name)
    part = f" (the first {len(shown)} of {every})" if every > len(shown) else ""
    figure.supxlabel(f"wavelength [nm]{part}", fontsize=9)
    figure.supylabel(shown[0].words, fontsize=9)
    figure.legend(handles=_legend(shown), loc="outside upper left", ncols=5, frameon=False)
    return figure


def _applies(members: dict[tuple[str, ...], list[Scalar]]) -> bool:
    """Two wavelengths, and draws that can be drawn."""
    every = [scalar for own in members.values() for scalar in own]
    several = all(len({s.labels["wavelength"] for s in own}) > 1 for own in members.values())
    return several and all(bool(np.isfinite(scalar.draws).all()) for scalar in every)


def _count(result: xr.DataTree, name: str) -> int:
    variable = result["posterior"][name]
    sizes = [n for dim, n in variable.sizes.items() if dim not in (*SAMPLE_DIMS, "wavelength")]
    return int(np.prod(sizes))


def _fine(measured: np.ndarray) -> np.ndarray:
    """The measured range and a little more on both sides, the measured wavelengths among it."""
    low, high = measured.min(), measured.max()
    beyond = min(BEYOND * (high - low), 0.5 * low)
    return np.union1d(np.linspace(low - beyond, high + beyond, FINE), measured)


def _bands(result: xr.DataTree, between: np.ndarray) -> dict[str, dict[int, np.ndarray]]:
    """Quantiles between the colors, by parameter and number of the member."""
    posterior = result["posterior"].to_dataset()
    step = max(1, posterior.sizes["chain"] * posterior.sizes["draw"] // MOST_DRAWS)
    keep = {"draw": slice(None, None, step)}
    lead = [str(d) for d in posterior.dims if d in ("patch", "material")]
    if len(lead) == 1:
        keep[lead[0]] = slice(MOST_MEMBERS)
    thin = xr.DataTree.from_dict(
        {
            group: result[group].to_dataset().isel(keep, missing_dims="ignore")
            for group in ("posterior", "unconstrained_posterior")
            if group in result.children
        }
    )
    thin.attrs = dict(result.attrs)
    try:
        predicted = predict_spectrum(thin, between)
    except FitError:
        # Nothing ties the colors together, or what does is known only to the user's own model.
        return {}
    found: dict[str, dict[int, np.ndarray]] = {}
    for name, variable in predicted.data_vars.items():
        lead = [str(d) for d in variable.dims if d not in (*SAMPLE_DIMS, "wavelength")]
        draws = variable.transpose(*SAMPLE_DIMS, *lead, "wavelength").to_numpy()
        draws = draws.reshape(draws.shape[0] * draws.shape[1], -1, between.size)
        found[str(name)] = dict(enumerate(np.quantile(draws, LEVELS, axis=0).transpose(1, 0, 2)))
    return found


def _spectrum(
    result: xr.DataTree,
    posterior: xr.Dataset,
    member: tuple[str, ...],
    own: list[Scalar],
    measured: np.ndarray,
    between: np.ndarray,
    band: np.ndarray | None,
) -> Spectrum:
    order = np.argsort(measured, kind="stable")
    draws = np.stack([scalar.draws.ravel() for scalar in own])[order]
    is_tied = band is not None and bool(np.isfinite(band).all())
    return Spectrum(
        title=plain(", ".join(member)),
        words=title_of(own[0], posterior).partition(", ")[0],
        measured=measured[order],
        levels=np.quantile(draws, LEVELS, axis=1),
        true=np.array([truth_of(result, scalar) for scalar in own])[order],
        between=between if is_tied else np.empty(0),
        band=band if band is not None and is_tied else np.empty((len(LEVELS), 0)),
    )


def _panel(axes: Axes, each: Spectrum) -> None:
    if each.between.size:
        for at in each.measured:
            axes.axvline(at, color=lighten(GRAY, 0.6), lw=0.7, ls=(0, (2, 2)), zorder=3)
        for low, high, share in ((0, 4, 0.75), (1, 3, 0.45)):
            color = lighten(BLUE, share)
            axes.fill_between(each.between, each.band[low], each.band[high], color=color, lw=0)
        axes.plot(each.between, each.band[2], color=BLUE, lw=1.4, zorder=4)
    else:
        axes.vlines(each.measured, each.levels[0], each.levels[4], color=BLUE, lw=1.1)
        axes.vlines(each.measured, each.levels[1], each.levels[3], color=BLUE, lw=3.6)
        ring: dict[str, Any] = {"mfc": paper(), "mec": BLUE, "ms": 4.5}
        axes.plot(each.measured, each.levels[2], "o", ls="", **ring)
        margin = 0.08 * np.ptp(each.measured)
        axes.set_xlim(each.measured.min() - margin, each.measured.max() + margin)
    known = np.isfinite(each.true)
    style: dict[str, Any] = {"mfc": ORANGE, "mec": paper(), "mew": 0.6, "ms": 6.5}
    axes.plot(each.measured[known], each.true[known], "d", ls="", zorder=6, **style)
    if each.between.size:
        axes.set_xlim(each.between[0], each.between[-1])


def _share(panels: list[Axes]) -> None:
    """One scale for all members, so that they can be compared."""
    low = min(axes.get_ylim()[0] for axes in panels)
    high = max(axes.get_ylim()[1] for axes in panels)
    for axes in panels:
        axes.set_ylim(low, high)
        axes.locator_params(axis="x", nbins=5)


def _legend(shown: list[Spectrum]) -> list[Line2D | Patch]:
    handles: list[Line2D | Patch]
    if shown[0].between.size:
        handles = [
            Line2D([], [], color=BLUE, lw=1.4, label="posterior median"),
            Patch(color=lighten(BLUE, 0.45), label="50%"),
            Patch(color=lighten(BLUE, 0.75), label="95%"),
            Line2D([], [], color=lighten(GRAY, 0.6), lw=0.9, ls=(0, (2, 2)), label="measured"),
        ]
    else:
        handles = [
            Line2D([], [], color=BLUE, marker="o", mfc=paper(), ls="", label="posterior median"),
            Line2D([], [], color=BLUE, lw=3.6, label="50%"),
            Line2D([], [], color=BLUE, lw=1.1, label="95%"),
        ]
    if any(np.isfinite(each.true).any() for each in shown):
        label = "true value"
        handles.append(
            Line2D([], [], ls="", marker="d", mfc=ORANGE, mec=paper(), ms=6.5, label=label)
        )
    return handles
