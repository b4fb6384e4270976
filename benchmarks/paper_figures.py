"""Three figures: readings and predictions, grazing views, calibration by method."""

from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Picture
from paper_methods import LeastSquares, compared
from paper_study import (
    CLASSES,
    GRAZING,
    INDEX,
    NAMES,
    PAPER,
    SCENE,
    Population,
    Study,
    header,
    layout,
    mean_of,
    row,
    scores,
    share_of,
)
from scipy.stats import binomtest, norm

import polar_bayes as pb
from polar_bayes.calibration.scores import FALSE_ALARMS, ecdf_band
from polar_bayes.reporting.style import (
    BLUE,
    GRAY,
    GREEN,
    ORANGE,
    VERMILLION,
    grid,
    lighten,
    styled,
)

FOLDER = Path(__file__).parents[1] / "docs" / "figures"
RINGS = {180.0: ("mirror side", BLUE), 60.0: ("60 degrees off the light", ORANGE)}
LIMITS = (45.0, 55.0, 65.0, 75.0, 80.0, 85.0)
COLORS = {"least squares": GRAY, "laplace": ORANGE, "importance": BLUE, "nuts": GREEN}
LABELS = {"roughness": "r", "subsurface_fraction": "β", "absorption": "a", "refractive_index": "n"}


def figures(study: Study) -> None:
    """Draw all three, and print the numbers of the last two."""
    FOLDER.mkdir(exist_ok=True)
    for name, draw in (("dop", dop), ("grazing", grazing), ("calibration", calibration)):
        draw(study).savefig(FOLDER / f"paper_{name}.png", dpi=110)
        print(f"\ndocs/figures/paper_{name}.png", flush=True)


@styled
def dop(study: Study) -> Picture:
    """Degree of polarization of one capture of each class, with posterior predictive bands."""
    picture, panels = grid(len(CLASSES), columns=3, width=8.0, panel_height=2.2, header=0.35)
    for at, (axes, name) in enumerate(zip(panels, CLASSES, strict=True)):
        capture = pb.simulate(
            name,
            scene=SCENE,
            protocol=pb.simulation.Protocol(wavelengths=()),
            seed=study.seed + at,
        )
        result = pb.fit(capture, method="laplace", scene=PAPER, seed=study.seed)
        told = result["posterior_predictive"]["dop"].stack(all=("chain", "draw"))
        low, high = told.quantile([0.025, 0.975], "all").to_numpy()
        zenith, azimuth = (capture[f"view_{angle}"].to_numpy() for angle in ("zenith", "azimuth"))
        for ring, (label, color) in RINGS.items():
            on = azimuth == ring
            axes.fill_between(zenith[on], low[on], high[on], color=lighten(color, 0.65), lw=0)
            axes.plot(
                zenith[on], capture["dop"].to_numpy()[on], "o", color=color, ms=3, label=label
            )
        axes.axvline(GRAZING, color=GRAY, lw=0.8, ls="--")
        axes.set(title=name, ylim=(0, 1), xlim=(0, 90), xticks=[0, 30, 60, 90])
    picture.supxlabel("view zenith [degree]", fontsize=9)
    picture.supylabel("degree of polarization", fontsize=9)
    handles, labels = panels[0].get_legend_handles_labels()
    picture.legend(handles, labels, loc="outside upper center", ncols=2, frameon=False)
    return picture


@styled
def grazing(study: Study) -> Picture:
    """Width and coverage of the interval of n by the largest view zenith, of 40 views each."""
    widths, shares = [], []
    header("largest view zenith", "mean width of n", "95% holds", "MAE of n")
    for limit in LIMITS:
        tree = study.calibrate(layout(limit), truth={"model": Population()})
        own = scores(tree, INDEX)
        widths.append(mean_of(own.width))
        found = binomtest(int(own.held.sum()), own.held.size)
        shares.append((found.statistic, *found.proportion_ci(0.95, method="wilson")))
        row(f"{limit:g}", widths[-1], share_of(own.held), mean_of(own.error))
    picture, (left, right) = grid(2, columns=2, width=7.5, panel_height=2.9)
    value, error = np.array(widths).T
    left.errorbar(LIMITS, value, error, fmt="o-", color=BLUE, ms=4, lw=1.2)
    left.set(ylabel="mean width of 95% intervals", ylim=(0, None))
    held, low, high = np.array(shares).T
    right.errorbar(LIMITS, held, (held - low, high - held), fmt="o", color=BLUE, ms=4, lw=1.2)
    right.axhline(0.95, color=GRAY, lw=0.9, ls="--")
    right.set(ylabel="share that holds the truth", ylim=(min(0.8, low.min() - 0.02), 1.01))
    for axes in (left, right):
        axes.axvline(GRAZING, color=GRAY, lw=0.8, ls="--")
        axes.set(
            xlabel="largest view zenith [degree]",
            title="refractive index n",
            xticks=[45, 55, 65, 75, 85],
        )
    return picture


@styled
def calibration(study: Study) -> Picture:
    """Ranks of truths that were drawn from the priors, by method."""
    capture = layout()
    found = LeastSquares(capture, None, study)
    squares = found()
    ranks: dict[str, dict[str, np.ndarray]] = {"least squares": {}}
    for name in NAMES:
        with np.errstate(divide="ignore", invalid="ignore"):
            away = (found.drawn.truth[name] - squares.value[name]) / squares.error[name]
        sound = squares.converged & np.isfinite(squares.error[name]) & (squares.error[name] > 0.0)
        ranks["least squares"][name] = np.where(sound, norm.cdf(away), np.nan)
    header("method", "parameter", "answered", "p of uniform ranks", "50% holds", "95% holds")
    for method in compared(study):
        tree = study.calibrate(capture, method=method)
        ranks[method] = {name: tree["prior_sbc"][name].to_numpy() for name in NAMES}
        _say(method, tree)
    picture, panels = grid(len(NAMES), columns=2, width=7.5, panel_height=2.3, header=0.35)
    for axes, name in zip(panels, NAMES, strict=True):
        band = ecdf_band(study.simulations, FALSE_ALARMS / len(NAMES))
        axes.fill_between(band.at, band.lower, band.upper, color=lighten(GRAY, 0.75), lw=0)
        for method, own in ranks.items():
            _ecdf(axes, own[name][np.isfinite(own[name])], method)
        axes.set(title=f"{name.replace('_', ' ')} {LABELS[name]}", xlim=(0, 1), xticks=[0, 0.5, 1])
    picture.supxlabel("rank of the truth in the posterior", fontsize=9)
    picture.supylabel("share of ranks below, minus that of uniform ranks", fontsize=9)
    handles, labels = panels[0].get_legend_handles_labels()
    picture.legend(handles, labels, loc="outside upper center", ncols=5, frameon=False)
    return picture


def _say(method: str, tree: xr.DataTree) -> None:
    table = pb.summary(tree)
    for name in NAMES:
        told = table.loc[name]
        shares = (
            f"{told[f'held_{at}']:.3f} "
            f"[{told[f'held_{at}_low']:.2f}, {told[f'held_{at}_high']:.2f}]"
            for at in (50, 95)
        )
        row(method, name, int(told["answered"]), f"{told['p_value']:.3f}", *shares)


def _ecdf(axes: Axes, ranks: np.ndarray, method: str) -> None:
    at = np.linspace(0.0, 1.0, 501)
    share = np.searchsorted(np.sort(ranks), at, side="right") / ranks.size
    axes.plot(at, share - at, color=COLORS.get(method, VERMILLION), lw=1.2, label=method)
