"""The picture on the landing page and in the README: the results of a fit.

    python benchmarks/overview.py [--out docs/figures/overview.png]

Readings of a plate of glass on a goniometer are simulated and fitted with the default settings. The
words are those of the report's first screen.
"""

import argparse
import textwrap
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import polar_bayes as pb
from polar_bayes.diagnostics.view import FitView, view_of
from polar_bayes.reporting import text
from polar_bayes.reporting.plots_curves import curves
from polar_bayes.reporting.style import BLUE, VERMILLION, lighten

FIGURES = Path(__file__).parents[1] / "docs" / "figures"


INDEX = 1.52
"""Refractive index of the simulated plate."""


def fitted_plate() -> xr.DataTree:
    """A fit by NUTS of s and p readings of glass; the angle scale is off by 0.3 degrees."""
    angle = np.arange(12.0, 79.0, 3.0)
    mirror = pb.Geometry.from_degrees(
        view_zenith=angle + 0.3, view_azimuth=180.0, light_zenith=angle + 0.3, light_azimuth=0.0
    )
    plate = pb.Scene(surface=pb.SmoothSurface())
    stokes = np.asarray(plate.stokes({"refractive_index": INDEX}, mirror), float)
    noise = 1.0 + 0.02 * np.random.default_rng(1).normal(size=(2, angle.size))
    s = 1000.0 * (stokes[:, 0] + stokes[:, 1]) * noise[0]
    p = 1000.0 * (stokes[:, 0] - stokes[:, 1]) * noise[1]
    capture = pb.from_goniometer(
        (angle, s.round(1)), (angle, p.round(1)), relative_error=0.02, name="glass"
    )
    return pb.fit(capture, seed=0)


def draw_readings(axes: Axes, fit: FitView) -> None:
    curve = curves(fit, "q")[0]
    zenith, levels = curve["zenith"], curve["levels"].to_numpy()
    axes.fill_between(zenith, levels[0], levels[-1], color=lighten(BLUE, 0.7), lw=0)
    axes.plot(zenith, curve["center"], color=BLUE, lw=1.5, label="fit, 95% of new readings")
    axes.plot(zenith, curve["observed"], "o", ms=4.0, color="black", label="readings")
    axes.set(xlabel="angle of incidence (degree)", ylabel="signed polarization q")
    axes.legend(frameon=False, loc=(0.4, 0.06))


def draw_index(axes: Axes, fit: FitView) -> None:
    draws = fit.posterior["refractive_index"].to_numpy().ravel()
    low, high = np.quantile(draws, [0.025, 0.975])
    heights, edges = np.histogram(draws, bins=40, density=True)
    inside = (edges[:-1] >= low) & (edges[1:] <= high)
    colors = [BLUE if each else lighten(BLUE, 0.7) for each in inside]
    axes.bar(edges[:-1], heights, np.diff(edges), align="edge", color=colors)
    axes.axvline(INDEX, color=VERMILLION, lw=1.5, label="true value")
    axes.set(xlabel="refractive index n, 95% interval dark", yticks=[])
    axes.set_ylim(top=1.2 * heights.max())
    axes.legend(frameon=False, loc="upper left")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=FIGURES / "overview.png")
    out = parser.parse_args().out
    fit = view_of(fitted_plate())
    figure = Figure(figsize=(7.6, 4.4), layout="constrained")
    readings, index, words = figure.subplot_mosaic(
        [["readings", "index"], ["words", "words"]], height_ratios=[3.0, 1.3], width_ratios=[3, 2]
    ).values()
    draw_readings(readings, fit)
    draw_index(index, fit)
    for axes in (readings, index):
        axes.spines[["top", "right"]].set_color("none")
    words.axis("off")
    said = [text.fit_headline(fit), *text.index_sentences(fit), text.trust(fit)]
    lines = [line for sentence in said for line in textwrap.wrap(sentence, 98)]
    words.text(0.0, 1.0, "\n".join(lines), va="top", fontsize=10, color="black")
    figure.savefig(out, dpi=150)
    print("\n".join(said))


if __name__ == "__main__":
    main()
