"""Where on the fruit frame light comes from the surface, and where from below.

Regions are told by place alone. The highlights are the lamp's. Low on each fruit the skin mirrors
the white table, at more than 40 degrees from the normal. The shoulders would mirror the dark room:
what comes from there has been inside. The lamp is polarized, nearly along the rows; what its light
adds to q goes with the cosine of twice the angle from the top, of which the mean over the shoulders
is zero.
"""

import numpy as np
import xarray as xr

import polar_bayes as pb

APPLE, ORANGE = pb.importers.Sphere(632.0, 732.0, 552.0), pb.importers.Sphere(536.0, 1804.0, 400.0)
SPOTS = {"apple": (456.0, 744.0), "orange": (400.0, 1820.0)}
"""Row and column of the brightest polarized light of each fruit."""


def regions(image: xr.Dataset) -> dict[str, np.ndarray]:
    """Places (y, x) of each region, from rows and columns of the frame."""
    rows, columns = np.meshgrid(image["y"], image["x"], indexing="ij")
    found = {}
    for name, ball in (("apple", APPLE), ("orange", ORANGE)):
        x, y = (columns - ball.column) / ball.radius, (ball.row - rows) / ball.radius
        zenith = np.rad2deg(np.arcsin(np.minimum(np.hypot(x, y), 1.0)))
        from_top = np.abs(np.rad2deg(np.arctan2(x, y)))
        row, column = SPOTS[name]
        spot = np.hypot(rows - row, columns - column) < 0.15 * ball.radius
        found[f"{name}: highlight"] = spot
        found[f"{name}: underside"] = (zenith > 40.0) & (zenith < 65.0) & (from_top > 150.0)
        shoulder = (from_top > 25.0) & (from_top < 65.0)
        found[f"{name}: shoulders"] = (zenith > 55.0) & (zenith < 72.0) & shoulder
    return found


def mean_stokes(capture: xr.Dataset, where: np.ndarray) -> tuple[float, float, float, int]:
    """Brightness-weighted q, u, their common error, and the number of readings of a region."""
    weight = capture["intensity"].where(capture["valid"]).isel(view=0).values
    weight = np.where(where & np.isfinite(weight), weight, 0.0)
    q, u = (
        float(np.nansum(weight * capture[name].isel(view=0).values) / weight.sum())
        for name in ("q", "u")
    )
    error = float(np.nanmean(capture["q_error"].isel(view=0).values[weight > 0.0]))
    return q, u, error, int((weight > 0.0).sum())
