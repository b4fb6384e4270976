"""Goniometer readings, s and p light apart, as a capture.

Light falls in at the angle of a row and the detector sits at the mirror angle, once for s and once
for p light. With S and P the readings less the dark level, over the incident levels,

    q = (S - P) / (S + P),    dop = |q|,    intensity = (S + P) / 2,

one view for each angle at which either channel was read.

Errors: a reading R has the standard deviation sqrt((relative_error R)^2 + e^2), where e is the
error given for its channel, or else the resolution of the printed number (last digit / sqrt(12)).

Angles at which one channel alone was read: between readings of the other, the logarithm of that
one is interpolated (PCHIP: no overshoot) and the view flagged `interpolated`. Its error grows by a
quarter of the larger leave-one-out residual of the two neighbors: leaving one out doubles the gap,
and the error of a smooth curve falls at least with the square of the gap. Outside the range of the
other channel nothing is made up: the view stays, with valid=False.

Readings below the dark level: by at most three errors they are noise around no light. Such a
reading is kept as zero light with its error, and counted in the attribute `readings_at_zero`
(masking it would keep the upward fluctuations alone). One further below is refused. A view in
which neither channel saw light has no q: valid=False.
"""

import dataclasses
import math
import os
from decimal import Decimal
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.interpolate import PchipInterpolator

from polar_bayes.capture.schema import POSITIVE, ZENITH, Interval, validate
from polar_bayes.capture.table_reader import Table, read_table
from polar_bayes.errors import CaptureError

# --- Readings of one detector channel over angle: read, scaled, and put on another grid of angles


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
            hint="give angle and reading, or use table= and name the columns angle=, s= and p=",
        )
    return channel_from_table(name, table, *table.names)


def channel_from_arrays(name: str, pair: Any) -> Channel:
    """A channel from a pair of arrays; its resolution is the finest decimal among the readings."""
    try:
        angle, reading = (np.asarray(part) for part in pair)
    except (TypeError, ValueError):
        hint = "give a path or a pair (angles, readings)"
        raise CaptureError("it is neither table nor pair", where=name, hint=hint) from None
    for part in (angle, reading):
        if part.dtype.kind not in "iuf" or part.ndim != 1 or not np.isfinite(part).all():
            hint = "give one finite number for each reading"
            raise CaptureError("it holds more than a list of numbers", where=name, hint=hint)
    if not 0 < angle.size == reading.size:
        what = f"{angle.size} angles and {reading.size} readings are no pair"
        raise CaptureError(what, where=name, hint="give one angle for each reading, at least one")
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


def _refuse(channel: Channel, wrong: np.ndarray, what: str, hint: str) -> None:
    """Raise for the first row that is wrong."""
    if wrong.any():
        row = int(np.argmax(wrong))
        values = f"(angle {channel.angle[row]:g}, {channel.name} {channel.light[row]:g})"
        raise CaptureError(f"{what} {values}", where=channel.places[row], hint=hint)


def _printed_step(reading: np.floating) -> float:
    """Value of the last digit that a number needs in print, in its own precision."""
    digits = np.format_float_positional(reading, trim="-")
    return float(f"1e{Decimal(digits).as_tuple().exponent}")


# --- Goniometer readings, s and p light apart, as a capture ---------------------------------------


Readings = str | os.PathLike[str] | tuple[ArrayLike, ArrayLike]

WHERE = "goniometer"
LEVEL = Interval(-LARGEST_READING, LARGEST_READING, open_low=True, open_high=True)
ERROR = Interval(SMALLEST_ERROR, LARGEST_READING, open_high=True)
FRACTION = Interval(0.0, 1.0, open_high=True)


def from_goniometer(
    s: Readings | None = None,
    p: Readings | None = None,
    *,
    table: str | os.PathLike[str] | None = None,
    angle: str | None = None,
    s_incident: float | None = None,
    p_incident: float | None = None,
    dark_level: float = 0.0,
    wavelength: float | None = None,
    s_error: float | None = None,
    p_error: float | None = None,
    relative_error: float = 0.01,
    name: str | None = None,
) -> xr.Dataset:
    """A capture from goniometer readings of s and p light; the module tells how.

    Args:
        s: A two-column table (angle in degrees, reading) or a pair (angles, readings); with
            `table`, the name of the column of s readings.
        p: The same for p light; its angles may be others.
        table: A table that holds angle, s and p as columns.
        angle: With `table`, the name of the column of angles in degrees.
        s_incident: Reading of the incident s light, by the same detector. Without the incident
            levels, s and p are taken to be on the same scale.
        p_incident: The same for p light; give both or none.
        dark_level: Reading without light; taken off every reading and incident level.
        wavelength: Wavelength in nm, > 0.
        s_error: Standard deviation of s readings without light, > 0, in units of the readings.
        p_error: The same for p readings.
        relative_error: Standard deviation that grows with the reading, over the reading, in [0, 1).
        name: Name of the capture; default: that of the table.

    Returns:
        The validated capture: dop, q, intensity, their errors, `valid` and `interpolated`.

    Raises:
        CaptureError: An option, a file, a line or a reading that is wrong.
    """
    dark_level = _option("dark_level", dark_level, LEVEL)
    relative_error = _option("relative_error", relative_error, FRACTION)
    incident = _incident_levels(s_incident, p_incident, dark_level)
    errors = _optional("s_error", s_error, ERROR), _optional("p_error", p_error, ERROR)
    s_channel, p_channel, sources = _read(s, p, table, angle)
    s_channel = scaled(s_channel, dark_level, incident[0], errors[0])
    p_channel = scaled(p_channel, dark_level, incident[1], errors[1])
    given = {
        "s_incident": incident[0],
        "p_incident": incident[1],
        "s_error": errors[0],
        "p_error": errors[1],
    }
    attributes = {
        "name": name or ", ".join(Path(source).stem for source in sources) or WHERE,
        "source": ", ".join(Path(source).name for source in sources) or "arrays",
        "setup": "goniometer",
        "incident_levels": "not given" if s_incident is None else "given",
        "dark_level": dark_level,
        "relative_error": relative_error,
        "readings_at_zero": int(sum((c.light == 0.0).sum() for c in (s_channel, p_channel))),
        **{key: value for key, value in given.items() if value is not None},
    }
    units = "arbitrary" if s_incident is None else "1"
    capture = _combined(s_channel, p_channel, relative_error, units).assign_attrs(attributes)
    if wavelength is not None:
        nanometers = _option("wavelength", wavelength, POSITIVE)
        capture = capture.assign_coords(wavelength=nanometers)
    return validate(capture, source=str(attributes["name"]))


def _read(
    s: object, p: object, table: str | os.PathLike[str] | None, angle: str | None
) -> tuple[Channel, Channel, list[str]]:
    """Both channels, and the files that they come from."""
    if table is None:
        if angle is not None:
            hint = "give the table, or s and p as tables of their own"
            raise CaptureError("a column is named without table", where="angle", hint=hint)
        if s is None or p is None:
            hint = "give s and p, each a table or a pair (angles, readings)"
            raise CaptureError("a channel is missing", where=WHERE, hint=hint)
        paths = [str(part) for part in (s, p) if isinstance(part, str | os.PathLike)]
        return _channel("s", s), _channel("p", p), paths
    angle = _column("angle", angle, table)
    s, p = _column("s", s, table), _column("p", p, table)
    numbers = read_table(table, [angle, s, p])
    s_channel = channel_from_table("s", numbers, angle, s)
    p_channel = channel_from_table("p", numbers, angle, p)
    return s_channel, p_channel, [str(table)]


def _column(key: str, column: object, table: str | os.PathLike[str]) -> str:
    if isinstance(column, str):
        return column
    hint = f"give {key}= the name of a column of the table"
    raise CaptureError("its column is not named", where=f"{table}: {key}", hint=hint)


def _channel(name: str, readings: object) -> Channel:
    if isinstance(readings, str | os.PathLike):
        return channel_from_file(name, readings)
    return channel_from_arrays(name, readings)


def _combined(s: Channel, p: Channel, relative_error: float, units: str) -> xr.Dataset:
    """One view for each angle of either channel."""
    angle = np.union1d(s.angle, p.angle)
    S, S_error, S_interpolated = on_grid(s, angle, relative_error)
    P, P_error, P_interpolated = on_grid(p, angle, relative_error)
    valid = S + P > 0.0  # not where either is NaN
    if not valid.any():
        what = "s and p share no angle at which light was seen"
        raise CaptureError(what, where=WHERE, hint="read both over the same range of angles")
    total = np.where(valid, S + P, np.nan)
    q = (S - P) / total
    with np.errstate(over="ignore"):  # an error past all bounds is refused by the contract
        q_error = 2.0 * np.hypot(P / total * S_error, S / total * P_error) / total
    intensity_error = np.where(valid, np.hypot(S_error, P_error) / 2.0, np.nan)
    return xr.Dataset(
        {
            "view_zenith": ("view", angle),
            "view_azimuth": ("view", np.full_like(angle, 180.0)),
            "light_zenith": ("view", angle),
            "light_azimuth": ("view", np.zeros_like(angle)),
            "dop": ("view", np.abs(q)),
            "q": ("view", q),
            "intensity": ("view", total / 2.0, {"units": units}),
            "dop_error": ("view", q_error),
            "q_error": ("view", q_error),
            "intensity_error": ("view", intensity_error, {"units": units}),
            "valid": ("view", valid),
            "interpolated": ("view", valid & (S_interpolated | P_interpolated)),
        }
    )


def _incident_levels(
    s: float | None, p: float | None, dark_level: float
) -> tuple[float | None, float | None]:
    if (s is None) != (p is None):
        hint = "give s_incident and p_incident, or neither"
        raise CaptureError("one incident level is missing", where=WHERE, hint=hint)
    above_dark = Interval(dark_level, LARGEST_READING, open_low=True, open_high=True)
    return _optional("s_incident", s, above_dark), _optional("p_incident", p, above_dark)


def _optional(name: str, value: float | None, allowed: Interval) -> float | None:
    return None if value is None else _option(name, value, allowed)


def _option(name: str, value: object, allowed: Interval) -> float:
    """A number given by the user, refused unless it lies inside the interval."""
    if isinstance(value, Real) and allowed.contains(value):
        return float(value)
    raise CaptureError(f"it is {value!r}", where=name, hint=f"give {allowed}")
