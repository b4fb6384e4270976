"""A capture from goniometer readings of s and p light.

Light falls in at the angle of a row and the detector is at the mirror angle, once for s and once
for p light. With S and P the readings less the dark level, over the incident levels,

    q = (S - P) / (S + P),    dop = |q|,    intensity = (S + P) / 2,

one view for each angle at which either channel was read.

Errors: a reading R has the standard deviation sqrt((relative_error R)^2 + e^2), where e is the
error given for its channel, or else the resolution of the printed number (last digit / sqrt(12)).

Angles at which one channel alone was read: between readings of the other, the logarithm of that
one is interpolated (PCHIP: no overshoot) and the view flagged `interpolated`. Its error grows by a
quarter of the larger leave-one-out residual of the two neighbors: leaving one out doubles the gap,
and the error of a smooth curve falls at least with the square of the gap. Outside the range of the
other channel nothing is interpolated: the view stays, with valid=False.

Readings below the dark level: by at most three errors they are noise around zero light. Such a
reading is kept as zero light with its error, and counted in the attribute `readings_at_zero`
(masking it would keep the upward fluctuations alone). One further below is refused. A view in
which neither channel saw light has no q: valid=False.
"""

import dataclasses
import math
import os
from decimal import Decimal
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.interpolate import PchipInterpolator

from polar_bayes.capture.schema import POSITIVE, ZENITH, Interval, validate
from polar_bayes.errors import CaptureError
from polar_bayes.importers.table import Table, read_table

Readings = str | os.PathLike[str] | tuple[ArrayLike, ArrayLike]

SMALLEST_ERROR, LARGEST_READING = 1e-30, 1e30
LEVEL = Interval(-LARGEST_READING, LARGEST_READING, open_low=True, open_high=True)


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
    angle_set_by: str = "hand",
    name: str | None = None,
) -> xr.Dataset:
    """A capture from goniometer readings of s and p light; see the module.

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
        angle_set_by: How the angles were set: "stage", "hand" or "lens"; a fit takes the prior of
            `angle_zero` from it (`polar_bayes.priors.ANGLE_ZERO`).
        name: Name of the capture; default: that of the table.

    Returns:
        The validated capture: dop, q, intensity, their errors, `valid` and `interpolated`.

    Raises:
        CaptureError: An option, a file, a line or a reading that is wrong.
    """
    LEVEL.check(dark_level, "dark_level")
    Interval(0.0, 1.0, open_high=True).check(relative_error, "relative_error")
    if (s_incident is None) != (p_incident is None):
        hint = "give s_incident and p_incident, or neither"
        raise CaptureError("one incident level is missing", where="goniometer", hint=hint)
    above_dark = dataclasses.replace(LEVEL, low=dark_level)
    errors = Interval(SMALLEST_ERROR, LARGEST_READING, open_high=True)
    optional = (
        ("s_incident", s_incident, above_dark),
        ("p_incident", p_incident, above_dark),
        ("s_error", s_error, errors),
        ("p_error", p_error, errors),
    )
    given = {key: limits.check(x, key) for key, x, limits in optional if x is not None}
    s_channel, p_channel, sources = _channels(s, p, table, angle)
    s_channel = s_channel.scaled(dark_level, s_incident, s_error)
    p_channel = p_channel.scaled(dark_level, p_incident, p_error)
    units = "arbitrary" if s_incident is None else "1"
    capture = _combined(s_channel, p_channel, relative_error, units).assign_attrs(
        name=name or ", ".join(source.stem for source in sources) or "goniometer",
        source=", ".join(source.name for source in sources) or "arrays",
        setup="goniometer",
        incident_levels="not given" if s_incident is None else "given",
        dark_level=float(dark_level),
        relative_error=float(relative_error),
        angle_set_by=angle_set_by,
        readings_at_zero=int(sum((c.light == 0.0).sum() for c in (s_channel, p_channel))),
        **given,
    )
    if wavelength is not None:
        capture = capture.assign_coords(wavelength=POSITIVE.check(wavelength, "wavelength"))
    _refuse_swapped(capture)
    return validate(capture, source=capture.attrs["name"])


def _refuse_swapped(capture: xr.Dataset) -> None:
    """Refuse s and p where s lies below p at nearly every angle, Brewster's included."""
    q, limit = capture["q"], 2.0 * capture["q_error"]
    # Nearer to the normal s and p differ too little.
    compared = capture["valid"] & (capture["view_zenith"] >= 10.0)
    below, total = int((compared & (q < -limit)).sum()), int(compared.sum())
    if total >= 3 and below >= 0.9 * total:
        what = f"s lies below p at {below} of {total} angles, which no reflecting surface does"
        hint = (
            "swap s and p, or give s_incident and p_incident where the channels differ in gain; a "
            "coating that reflects more p light is imported by from_table, as q"
        )
        raise CaptureError(what, where=capture.attrs["name"], hint=hint)


def _channels(
    s: Readings | None, p: Readings | None, table: str | os.PathLike[str] | None, angle: str | None
) -> tuple["Channel", "Channel", list[Path]]:
    """Both channels, and the files that they come from."""
    if table is None:
        if angle is not None:
            hint = "give the table, or s and p as tables of their own"
            raise CaptureError("a column is named without table", where="angle", hint=hint)
        if s is None or p is None:
            hint = "give s and p, each a table or a pair (angles, readings)"
            raise CaptureError("a channel is missing", where="goniometer", hint=hint)
        paths = [Path(part) for part in (s, p) if isinstance(part, str | os.PathLike)]
        return _channel("s", s), _channel("p", p), paths
    for key, column in (("angle", angle), ("s", s), ("p", p)):
        if not isinstance(column, str):
            hint = f"give {key}= the name of a column of the table"
            raise CaptureError("its column is not named", where=f"{table}: {key}", hint=hint)
    angle, s, p = str(angle), str(s), str(p)
    columns = read_table(table, [angle, s, p])
    return (
        _channel_of_table("s", columns, angle, s),
        _channel_of_table("p", columns, angle, p),
        [Path(table)],
    )


def _combined(s: "Channel", p: "Channel", relative_error: float, units: str) -> xr.Dataset:
    """One view for each angle of either channel."""
    angle = np.union1d(s.angle, p.angle)
    S, S_error, S_interpolated = s.at(angle, relative_error)
    P, P_error, P_interpolated = p.at(angle, relative_error)
    valid = S + P > 0.0  # not where either is NaN
    if not valid.any():
        what = "s and p share no angle at which light was seen"
        hint = "read both over the same range of angles"
        raise CaptureError(what, where="goniometer", hint=hint)
    total = np.where(valid, S + P, np.nan)
    q = (S - P) / total
    with np.errstate(over="ignore"):  # `validate` refuses an infinite error
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


# --- One channel ----------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True, eq=False)
class Channel:
    """Readings of one channel, sorted by angle; `sources` names each in errors."""

    name: str
    angle: np.ndarray
    light: np.ndarray
    error: np.ndarray
    sources: tuple[str, ...]

    def refuse(self, wrong: np.ndarray, what: str, hint: str) -> None:
        """Raise for the first wrong row."""
        if wrong.any():
            row = int(np.argmax(wrong))
            values = f"(angle {self.angle[row]:g}, {self.name} {self.light[row]:g})"
            raise CaptureError(f"{what} {values}", where=self.sources[row], hint=hint)

    def scaled(self, dark_level: float, incident: float | None, error: float | None) -> "Channel":
        """The light above the dark level, over the incident light where that is known."""
        errors = self.error if error is None else np.full_like(self.error, error)
        light = self.light - dark_level
        what = f"the reading lies below the dark level {dark_level:g}"
        hint = f"give the right dark_level, or the noise without light as {self.name}_error"
        self.refuse(light < -3.0 * errors, what, hint)
        light = np.maximum(light, 0.0)
        full = 1.0
        if incident is not None:
            full = incident - dark_level
            what = "more light comes back than went in"
            hint = f"check the incident levels: {self.name}_incident is {incident:g}"
            # Noise may carry a reflectance past one, not this far.
            self.refuse(light > 1.2 * full, what, hint)
        return dataclasses.replace(self, light=light / full, error=errors / full)

    def at(
        self, angle: np.ndarray, relative_error: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Light and its error at these angles, and which of them are interpolated."""
        light, error = np.full((2, angle.size), np.nan)
        read = np.isin(angle, self.angle)
        light[read], error[read] = self.light, self.error
        between = ~read & (angle > self.angle[0]) & (angle < self.angle[-1])
        if between.any():
            right = np.searchsorted(self.angle, angle[between])
            # The logarithm of a reading of zero is replaced by that of its error.
            logs = np.log(np.maximum(self.light, self.error))
            light[between] = np.exp(PchipInterpolator(self.angle, logs)(angle[between]))
            neighbors = np.maximum(self.error[right - 1], self.error[right])
            spread = light[between] * _interpolation_error(self.angle, logs)[right - 1]
            error[between] = np.hypot(neighbors, spread)
        return light, np.hypot(error, relative_error * light), between


def _interpolation_error(angle: np.ndarray, logs: np.ndarray) -> np.ndarray:
    """Standard deviation of the interpolated logarithm in each gap. Shape (row - 1,)."""
    if angle.size < 3:  # no reading can be left out: a uniform distribution between the two
        return np.abs(np.diff(logs)) / math.sqrt(12.0)
    residual = np.full(angle.shape, np.nan)
    for k in range(1, angle.size - 1):
        near = [j for j in range(max(k - 2, 0), min(k + 3, angle.size)) if j != k]
        residual[k] = abs(PchipInterpolator(angle[near], logs[near])(angle[k]) - logs[k])
    return np.fmax(residual[:-1], residual[1:]) / 4.0


def _channel(name: str, readings: Readings) -> Channel:
    """A channel from a table of two columns, or from a pair of arrays."""
    if isinstance(readings, str | os.PathLike):
        table = read_table(readings)
        if len(table.names) != 2:
            what = f"it has {len(table.names)} columns, not two"
            hint = "give angle and reading, or use table= and name the columns angle=, s= and p="
            raise CaptureError(what, where=table.source, hint=hint)
        return _channel_of_table(name, table, *table.names)
    try:
        angle, reading = (np.asarray(part) for part in readings)
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
    printed = reading if reading.dtype.kind == "f" else reading.astype(np.float64)
    finest = min(map(_last_digit, printed))  # the resolution of all readings
    sources = [f"{name}[row={row}]" for row in range(angle.size)]
    return _sorted(name, angle, reading, np.full(angle.shape, finest), sources)


def _channel_of_table(name: str, table: Table, angle: str, reading: str) -> Channel:
    """A channel from two columns of a table; its errors are the resolution of the print."""
    sources = [f"{table.source}: line {line}" for line in table.lines]
    columns = table.columns[angle], table.columns[reading], table.steps[reading]
    return _sorted(name, *columns, sources)


def _sorted(
    name: str, angle: np.ndarray, reading: np.ndarray, step: np.ndarray, sources: list[str]
) -> Channel:
    angle = np.round(angle.astype(np.float64), 6)  # angles that agree so far are one
    order = np.argsort(angle, kind="stable")
    resolution = np.maximum(step / math.sqrt(12.0), SMALLEST_ERROR)
    columns = angle[order], reading.astype(np.float64)[order], resolution[order]
    channel = Channel(name, *columns, tuple(sources[k] for k in order))
    is_outside, is_repeated = ~ZENITH.contains(columns[0]), np.diff(columns[0], prepend=-1.0) == 0.0
    what, hint = f"the angle is outside {ZENITH}", "give degrees from the surface normal"
    channel.refuse(is_outside, what, hint)
    what, hint = f"{name} was read at this angle before", "average the repeats or keep one"
    channel.refuse(is_repeated, what, hint)
    what, hint = "the reading is too large", f"give readings below {LARGEST_READING:g}"
    channel.refuse(np.abs(columns[1]) >= LARGEST_READING, what, hint)
    return channel


def _last_digit(reading: np.floating) -> float:
    """Value of the last digit that a number needs in print, in its own precision."""
    digits = np.format_float_positional(reading, trim="-")
    return float(f"1e{Decimal(digits).as_tuple().exponent}")
