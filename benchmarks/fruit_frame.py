"""The fruit frame: light of surfaces, light from below, and the polarization of the lamp.

    python benchmarks/fruit_frame.py FRAME [--map fruit.zarr] [--picture fruit.png]

Regions are told by place alone (tests/fruit.py). With --map, what a map of the same spheres says
there.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

import polar_bayes as pb
from polar_bayes.importers.detector import read_frame

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from fruit import APPLE, ORANGE, SPOTS, mean_stokes, regions


def fruit_capture(frame: Path, bin_: int = 16, window: int = 1) -> xr.Dataset:
    """The frame as a capture of two spheres."""
    spheres = (APPLE, ORANGE)
    light = pb.importers.Surroundings()
    return pb.from_mosaic(frame, shape=spheres, light=light, bin=bin_, window=window, name="fruit")


def of_the_lamp(frame: Path, row: float, column: float, reach: int) -> tuple[float, float]:
    """Polarization of the light that a highlight adds to the skin around it.

    Brightness of glints changes over few pixels, that of the body over many: the Stokes parameters
    are regressed on brightness beside a smooth surface of second order.
    """
    raw, _ = read_frame(frame, "frame")
    four = raw[0::2, 0::2], raw[0::2, 1::2], raw[1::2, 0::2], raw[1::2, 1::2]  # 90, 45, 135, 0
    row, column = int(row) // 8, int(column) // 8
    cut = []
    for each in four:
        rows, columns = (n // 4 * 4 for n in each.shape)
        mean = each[:rows, :columns].reshape(rows // 4, 4, columns // 4, 4).mean((1, 3))
        cut.append(mean[row - reach : row + reach, column - reach : column + reach].ravel())
    S0, Q, U = sum(cut) / 2.0, cut[3] - cut[0], cut[1] - cut[2]
    y, x = (axis.ravel() for axis in np.mgrid[-1 : 1 : 2j * reach, -1 : 1 : 2j * reach])
    design = np.stack([S0, np.ones_like(x), x, y, x * x, y * y, x * y], axis=-1)
    q, u = (float(np.linalg.lstsq(design, each)[0][0]) for each in (Q, U))
    return float(np.hypot(q, u)), float(np.rad2deg(np.arctan2(u, q)) / 2.0)


def fresnel_dop(degrees: float, index: float) -> float:
    """Degree of polarization of unpolarized light after a mirror."""
    c = np.cos(np.deg2rad(degrees))
    inside = np.sqrt(1.0 - (1.0 - c**2) / index**2)
    s, p = (c - index * inside) / (c + index * inside), (index * c - inside) / (index * c + inside)
    return float((s**2 - p**2) / (s**2 + p**2))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("frame", type=Path)
    parser.add_argument("--map", type=Path)
    parser.add_argument("--picture", type=Path)
    asked = parser.parse_args()
    capture = fruit_capture(asked.frame)
    print(f"{'region':<20} {'q':>7} {'u':>7} {'error':>6} readings")
    for name, where in regions(capture).items():
        q, u, error, count = mean_stokes(capture, where)
        print(f"{name:<20} {q:7.3f} {u:7.3f} {error:6.3f} {count}")
    print(f"median misfit {capture.attrs['median_misfit']:.1f} (1: noise as stated)")
    for name, spot in SPOTS.items():
        ball = APPLE if name == "apple" else ORANGE
        tilt = np.hypot(spot[0] - ball.row, spot[1] - ball.column) / ball.radius
        incidence = float(np.rad2deg(np.arcsin(tilt)))
        dop, angle = of_the_lamp(asked.frame, *spot, 8)
        bound = fresnel_dop(incidence, 1.6)
        print(
            f"highlight of the {name}: incidence {incidence:.0f} degrees, DoP {dop:.2f} at "
            f"{angle:.0f} degrees from horizontal; unpolarized light would have {bound:.2f}"
        )
    maps = None if asked.map is None else pb.maps.open_map(asked.map)
    if maps is not None:
        print(pb.maps.count_pixels(maps))
        for name, where in regions(maps).items():
            share, factor = (
                maps[each].values[where] for each in ("subsurface_fraction", "stokes_error_factor")
            )
            print(
                f"{name:<20} subsurface_fraction {np.nanmedian(share):.2f}, stokes_error_factor "
                f"{np.nanmedian(factor):.0f} (medians of {np.isfinite(share).sum()} pixels)"
            )
    if asked.picture is not None:
        draw(capture, maps, asked.picture)


def draw(capture: xr.Dataset, maps: xr.Dataset | None, path: Path) -> None:
    """Brightness, q and u of the spheres, and the map."""
    shown = capture.where(capture["valid"]).isel(view=0)
    panels = [
        (shown["intensity"], "brightness [counts]", "gray", (0.0, 120.0)),
        (shown["q"], "q: surface > 0, body < 0", "RdBu", (-0.2, 0.2)),
        (shown["u"], "u", "RdBu", (-0.2, 0.2)),
    ]
    if maps is not None:
        fraction = maps["subsurface_fraction"]
        panels.append((fraction, "subsurface fraction", "viridis", (0.0, 1.0)))
    bottom = APPLE.row + APPLE.radius
    figure = Figure(figsize=(3.2 * len(panels), 2.2), layout="constrained")
    for at, (values, title, colors, ends) in enumerate(panels):
        axes = figure.add_subplot(1, len(panels), at + 1)
        axes.set_facecolor("0.85")
        upper = values.isel(y=values["y"] < bottom)  # below it is no sphere
        drawn = axes.imshow(upper, cmap=colors, vmin=ends[0], vmax=ends[1])
        figure.colorbar(drawn, ax=axes, shrink=0.8)
        axes.set(xticks=[], yticks=[])
        axes.set_title(title, fontsize=9)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
