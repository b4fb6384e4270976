"""Readings of one detector channel over angle: read, scaled, and put on another grid of angles."""

import dataclasses
import math
import os
from decimal import Decimal
from typing import Any

import numpy as np
from scipy.interpolate import PchipInterpolator

from polar_bayes.capture.contract import ZENITH
from polar_bayes.capture.tables import Table, read_table
from polar_bayes.errors import CaptureError

ANGLE_DECIMALS = 6  # angles that agree to this many decimals are one angle
AT_ZERO = 3.0  # so many errors below the dark level a reading still is no light
LARGEST_REFLECTANCE = 1.2  # noise may carry a reflectance past one, not this far
SMALLEST_ERROR = 1e-30
LARGEST_READING = 1e30


@dataclasses.dataclass(frozen=True, eq=False)
class Channel:
    """What one channel read, sorted by angle."""

    name: str
    angle: np.ndarray
    light: np.ndarray
    error: np.ndarray
    places: tuple[str, ...]


def channel_from_table(name: str, table: Table, angle: str, reading: str) -> Channel:
    """A channel from two columns of a table; its errors are the resolution of the print."""
    places = [f"{table.source}: line {line}" for line in table.lines]
    return _sorted(name, table.columns[angle], table.columns[reading], table.steps[reading], places)


def channel_from_file(name: str, path: str | os.PathLike[str]) -> Channel:
    """A channel from a table of two columns, angle and reading."""
    table = read_table(path)
    if len(table.names) != 2:
        raise CaptureError(
            f"it has {len(table.names)} columns, not two",
            where=table.source,
            mend="give angle and reading, or use table= and name the columns angle=, s= and p=",
        )
    return channel_from_table(name, table, *table.names)


def channel_from_arrays(name: str, pair: Any) -> Channel:
    """A channel from a pair of arrays; its resolution is the finest decimal among the readings."""
    try:
        angle, reading = (np.asarray(part) for part in pair)
    except (TypeError, ValueError):
        mend = "give a path or a pair (angles, readings)"
        raise CaptureError("it is neither table nor pair", where=name, mend=mend) from None
    for part in (angle, reading):
        if part.dtype.kind not in "iuf" or part.ndim != 1 or not np.isfinite(part).all():
            mend = "give one finite number for each reading"
            raise CaptureError("it holds more than a list of numbers", where=name, mend=mend)
    if not 0 < angle.size == reading.size:
        what = f"{angle.size} angles and {reading.size} readings are no pair"
        raise CaptureError(what, where=name, mend="give one angle for each reading, at least one")
    step = min(
        map(_printed_step, reading if reading.dtype.kind == "f" else reading.astype(np.float64))
    )
    places = [f"{name}[row={row}]" for row in range(angle.size)]
    steps = np.full(angle.shape, step)
    return _sorted(name, angle.astype(np.float64), reading.astype(np.float64), steps, places)


def scaled(
    channel: Channel, dark_level: float, incident: float | None, error: float | None
) -> Channel:
    """The light above the dark level, over the incident light where that is known."""
    # A reading below the dark level by at most three errors is kept as zero light.
    errors = channel.error if error is None else np.full_like(channel.error, error)
    light = channel.light - dark_level
    _refuse(
        channel,
        light < -AT_ZERO * errors,
        f"the reading lies below the dark level {dark_level:g}",
        f"give the right dark_level, or the noise without light as {channel.name}_error",
    )
    light = np.maximum(light, 0.0)
    if incident is None:
        return dataclasses.replace(channel, light=light, error=errors)
    full = incident - dark_level
    _refuse(
        channel,
        light > LARGEST_REFLECTANCE * full,
        "more light comes back than went in",
        f"check the incident levels: {channel.name}_incident is {incident:g}",
    )
    return dataclasses.replace(channel, light=light / full, error=errors / full)


def on_grid(
    channel: Channel, grid: np.ndarray, relative_error: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The channel at the angles of a grid, interpolated where it has no reading."""
    light, error = np.full((2, grid.size), np.nan)
    read = np.isin(grid, channel.angle)
    light[read], error[read] = channel.light, channel.error
    between = ~read & (grid > channel.angle[0]) & (grid < channel.angle[-1])
    if between.any():
        right = np.searchsorted(channel.angle, grid[between])
        # A logarithm needs light: a reading of zero stands for at most its error.
        logs = np.log(np.maximum(channel.light, channel.error))
        light[between] = np.exp(PchipInterpolator(channel.angle, logs)(grid[between]))
        neighbors = np.maximum(channel.error[right - 1], channel.error[right])
        spread = light[between] * _interpolation_error(channel.angle, logs)[right - 1]
        error[between] = np.hypot(neighbors, spread)
    return light, np.hypot(error, relative_error * light), between


def _interpolation_error(angle: np.ndarray, logs: np.ndarray) -> np.ndarray:
    """Standard deviation of the interpolated logarithm in each gap. Shape (row - 1,)."""
    if angle.size < 3:  # nothing to leave out: anywhere between the two
        return np.abs(np.diff(logs)) / math.sqrt(12.0)
    residual = np.full(angle.shape, np.nan)
    for k in range(1, angle.size - 1):
        near = [j for j in range(max(k - 2, 0), min(k + 3, angle.size)) if j != k]
        residual[k] = abs(PchipInterpolator(angle[near], logs[near])(angle[k]) - logs[k])
    return np.fmax(residual[:-1], residual[1:]) / 4.0


def _sorted(
    name: str, angle: np.ndarray, reading: np.ndarray, step: np.ndarray, places: list[str]
) -> Channel:
    angle = np.round(angle, ANGLE_DECIMALS)
    order = np.argsort(angle, kind="stable")
    resolution = np.maximum(step / math.sqrt(12.0), SMALLEST_ERROR)
    channel = Channel(
        name, angle[order], reading[order], resolution[order], tuple(places[k] for k in order)
    )
    _refuse(
        channel,
        ~ZENITH.contains(channel.angle),
        f"the angle is outside {ZENITH}",
        "give degrees from the surface normal",
    )
    _refuse(
        channel,
        np.diff(channel.angle, prepend=-1.0) == 0.0,
        f"{name} was read at this angle before",
        "average the repeats or keep one",
    )
    _refuse(
        channel,
        np.abs(channel.light) >= LARGEST_READING,
        "the reading is too large",
        f"give readings below {LARGEST_READING:g}",
    )
    return channel


def _refuse(channel: Channel, wrong: np.ndarray, what: str, mend: str) -> None:
    """Raise for the first row that is wrong."""
    if wrong.any():
        row = int(np.argmax(wrong))
        values = f"(angle {channel.angle[row]:g}, {channel.name} {channel.light[row]:g})"
        raise CaptureError(f"{what} {values}", where=channel.places[row], mend=mend)


def _printed_step(reading: np.floating) -> float:
    """Value of the last digit that a number needs in print, in its own precision."""
    digits = np.format_float_positional(reading, trim="-")
    return float(f"1e{Decimal(digits).as_tuple().exponent}")
