"""Coverage of a map: how often its intervals contain the truth."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
import scipy.stats
import xarray as xr

from polar_bayes.diagnostics.parameters import Scalar, scalars
from polar_bayes.errors import CaptureError, FitError
from polar_bayes.inference.batching import IMAGE, Status, cut
from polar_bayes.maps.lazy import CHUNK, ensure_loaded, map_parameters

INTERVALS = {50: (0.25, 0.75), 80: (0.1, 0.9), 95: (0.025, 0.975)}
"""Intervals by percent, with the quantile levels of both ends."""

CASES = ("unknown", "masked", "unanswered", "answered")


def coverage_columns(held: Mapping[int, int], count: int) -> dict[str, float]:
    """Return coverage by percent among `count` intervals, with its 95% interval."""
    # Source: Wilson (1927), JASA 22(158), 209-212.
    columns: dict[str, float] = {}
    for percent, hits in held.items():
        share = low = high = math.nan
        if count:
            share = hits / count
            low, high = scipy.stats.binomtest(hits, count).proportion_ci(0.95, method="wilson")
        name = f"held_{percent}"
        columns |= {name: share, f"{name}_low": float(low), f"{name}_high": float(high)}
    return columns


def map_coverage(maps: xr.Dataset, truth: xr.Dataset) -> pd.DataFrame:
    """Count how often the intervals of a map contain the truth.

    A pixel has an answer where its status is good. Of those whose truth is known, the share is
    counted whose central 50, 80 and 95% interval holds it, ends included, in the precision of the
    maps. What has no answer cannot be right or wrong: `held_50_of_read` counts it as a miss, so
    that no map looks better for the pixels on which it gave up.

    Truths that were drawn from the priors should be held by a share of pixels as large as the
    intervals say. Of truths that were chosen, only their mean over the priors should.

    Args:
        maps: Of `polar_bayes.fit_pixels`, or opened from a store.
        truth: The simulated capture: `true_<parameter>`, one number or over axes of the map.

    Returns:
        A row for each parameter whose truth is known (and wavelength, where it has several), with
        pixels whose truth is `unknown` (NaN), that are `masked` (never read), `unanswered` (read,
        without an answer, or not fitted) and `answered`: counts that add up to the image. For each
        interval, as for 50%: `held_50`, share of those answered; `held_50_low` and `held_50_high`,
        its 95% interval (Wilson's, as if pixels were independent); `held_50_of_read`, share of
        those answered and unanswered. NaN where there are none.

    Raises:
        CaptureError: It knows no parameter of the map, or is of another image.
        FitError: It holds no maps, or they are in chunks and too large for memory.

    Source:
        Wilson (1927), JASA 22(158), 209-212: the interval of a share.
    """
    found = map_scalars(maps)
    names = {scalar.name for scalar in found}
    known = {name: true for name in names if (true := _truth_of(maps, truth, name)) is not None}
    if not known:
        raise CaptureError(
            "it states the truth of no parameter of the map",
            where=_name_of(truth),
            hint=f"give a simulated capture, with one of {', '.join(sorted(names))} as `true_...`",
        )
    maps = ensure_loaded(maps)
    counts: dict[str, np.ndarray] = {}
    for place in cut(maps, CHUNK):
        for name, true in known.items():
            here = true.isel({dim: part for dim, part in place.items() if dim in true.dims})
            bounds = maps[f"{name}_quantile"].isel(place)
            added = _count(maps["status"].isel(place).load(), bounds.load(), here.load())
            counts[name] = counts.get(name, 0) + added
    shown = [scalar for scalar in found if scalar.name in known]
    rows = [
        _row([int(case[tuple(each.index.values())]) for case in counts[each.name]])
        for each in shown
    ]
    return pd.DataFrame(rows, index=pd.Index([each.label for each in shown], dtype=object))


def map_scalars(maps: xr.Dataset) -> list[Scalar]:
    """Return the scalars that each pixel of a map has, in the order of a fit."""
    names = map_parameters(maps)
    if not names or "status" not in maps:
        raise FitError("it holds no maps", where="maps", hint="give what fit_pixels returns")
    # One pixel of zeros has the axes and labels of all, and nothing is read from a store.
    return scalars(xr.zeros_like(maps[names].isel({dim: slice(1) for dim in IMAGE})), IMAGE)


def _truth_of(maps: xr.Dataset, truth: xr.Dataset, name: str) -> xr.DataArray | None:
    """Return the truth of a parameter, which may have fewer axes than the parameter."""
    true, mean = truth.get(f"true_{name}"), maps[name]
    if true is None or not set(true.dims) <= set(mean.dims):
        return None
    try:
        xr.align(true, mean, join="exact")
    except ValueError as error:
        sizes = " and ".join(
            " x ".join(f"{dim} {each.sizes[dim]}" for dim in true.dims) for each in (true, mean)
        )
        raise CaptureError(
            f"true_{name} and the map have different axes ({sizes})",
            where=_name_of(truth),
            hint="give the capture of which the map was made",
        ) from error
    return true


def _name_of(truth: xr.Dataset) -> str:
    return str(truth.attrs.get("name", "truth"))


def _count(status: xr.DataArray, bounds: xr.DataArray, true: xr.DataArray) -> np.ndarray:
    """Count the pixels of a block by case, then those that each interval contains."""
    own = [dim for dim in bounds.dims if dim not in ("quantile", *IMAGE)]
    true = true.astype(bounds.dtype)
    is_known, is_masked = true.notnull(), status == Status.MASKED
    has_answer = is_known & (status == Status.GOOD) & (abs(bounds) < np.inf).all("quantile")
    cases = [~is_known, is_known & is_masked, is_known & ~is_masked & ~has_answer, has_answer]
    for levels in INTERVALS.values():
        low, high = (bounds.sel(quantile=level, drop=True) for level in levels)
        cases.append(has_answer & (low <= true) & (true <= high))
    whole = bounds.isel(quantile=0, drop=True)
    return np.stack(
        [case.broadcast_like(whole).sum(IMAGE).transpose(*own).to_numpy() for case in cases]
    )


def _row(counts: Sequence[int]) -> dict[str, float]:
    row: dict[str, float] = dict(zip(CASES, counts, strict=False))
    answered, read = row["answered"], row["answered"] + row["unanswered"]
    for percent, held in zip(INTERVALS, counts[len(CASES) :], strict=True):
        row |= coverage_columns({percent: held}, int(answered))
        row[f"held_{percent}_of_read"] = held / read if read else math.nan
    return row
