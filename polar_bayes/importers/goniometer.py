"""A capture from goniometer readings of s and p light, or of one channel alone.

Light falls in at the angle of a row and the detector is at the mirror angle, once for s and once
for p light. With S and P the readings less the dark level, over the incident levels,

    q = (S - P) / (S + P),    dop = |q|,    intensity = (S + P) / 2,

one view for each angle at which either channel was read. Of one channel alone (s, p, or
unpolarized light) there is the intensity, and its attribute `channel` says whose it is.

Errors: a reading R has the standard deviation sqrt((relative_error R)^2 + e^2), where e is the
error given for its channel, or else the resolution of the printed number (last digit / sqrt(12)). A
reading with its uncertainty in one cell, such as 47.1(20) or 47.1±2.0, has that error.

An angle that was read several times, in several scans or on both sides of the normal, is one view:
the mean. Where `relative_error` or e is not given, the scatter of the repeats around their means is
the error, fitted as relative_error and e to the sample variances of all angles of a channel (Gamma
likelihood); that of a mean of k readings is smaller by sqrt(k). Fewer than six repeats do not tell
the scatter.

A reading of zero, or below, has the scatter of its neighbors as its error, if that is larger: the
last digit of a zero says nothing of the noise that a detector or program has cut off.

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
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.interpolate import PchipInterpolator
from scipy.optimize import nnls

from polar_bayes.capture.plausibility import ASSUMED, indices_by_eye
from polar_bayes.capture.schema import POSITIVE, Interval, validate
from polar_bayes.errors import CaptureError
from polar_bayes.importers.columns import Table, counted, last_digit, read_table
from polar_bayes.importers.mirror import as_incidence, mirror_views

Readings = str | os.PathLike[str] | tuple[ArrayLike, ArrayLike]

SMALLEST_ERROR, LARGEST_READING = 1e-30, 1e30
LEVEL = Interval(-LARGEST_READING, LARGEST_READING, open_low=True, open_high=True)
RELATIVE_ERROR = 0.01
"""Error of a reading over the reading, where neither a user nor repeats tell it."""


def from_goniometer(
    s: Readings | None = None,
    p: Readings | None = None,
    *,
    unpolarized: Readings | None = None,
    table: str | os.PathLike[str] | None = None,
    angle: str | None = None,
    angle_is: str | None = None,
    sheet: str | None = None,
    s_incident: float | None = None,
    p_incident: float | None = None,
    dark_level: float = 0.0,
    wavelength: float | None = None,
    s_error: float | None = None,
    p_error: float | None = None,
    relative_error: float | None = None,
    angle_set_by: str = "hand",
    name: str | None = None,
) -> xr.Dataset:
    """Make a capture from goniometer readings of one or both channels; see the module.

    Args:
        s: A two-column table (angle in degrees, reading) or a pair (angles, readings); with
            `table`, the name of the column of s readings.
        p: The same for p light; its angles may be others.
        unpolarized: The same for unpolarized light without an analyzer, in place of s and p.
        table: A text table or .xlsx workbook that holds angle and channels as columns.
        angle: With `table`, the name of the column of angles in degrees.
        angle_is: What the angles are: "incidence", "from-surface", "two-theta" or "deviation"
            (`polar_bayes.importers.mirror`), with any sign; by default incidence, 0 or larger.
        sheet: Sheet of a workbook, where several hold something.
        s_incident: Reading of the incident s light, by the same detector. Without the incident
            levels, s and p are taken to be on the same scale.
        p_incident: The same for p light; give both or none.
        dark_level: Reading without light; taken off every reading and incident level.
        wavelength: Wavelength in nm, > 0.
        s_error: Standard deviation of s readings without light, > 0, in units of the readings.
        p_error: The same for p readings.
        relative_error: Standard deviation that grows with the reading, over the reading, in [0, 1);
            by default the scatter of repeats tells it, or it is 0.01.
        angle_set_by: How the angles were set: "stage", "hand" or "lens"; a fit takes the prior of
            `angle_zero` from it (`polar_bayes.priors.ANGLE_ZERO`).
        name: Name of the capture; default: that of the table.

    Returns:
        The validated capture: dop, q, intensity, their errors, `valid` and `interpolated`, or of
        one channel intensity and its error. `import_notes` says what was done to the readings.

    Raises:
        CaptureError: An option, a file, a line or a reading that is wrong.
    """
    asked = {"s": s, "p": p, "unpolarized": unpolarized}
    given = _check_levels(
        dark_level, relative_error,
        s_incident=s_incident, p_incident=p_incident, s_error=s_error, p_error=p_error,
    )  # fmt: skip
    _check_channels(asked, given)
    channels = {
        key: rows.at_incidence(angle_is)
        .averaged(relative_error)
        .scaled(dark_level, given.get(f"{key}_incident"), given.get(f"{key}_error"))
        for key, rows in _read(asked, table, angle, sheet).items()
    }
    files = asked.values() if table is None else [table]
    paths = [Path(each) for each in files if isinstance(each, str | os.PathLike)]
    capture = _views(channels, given).assign_attrs(
        name=name or ", ".join(source.stem for source in paths) or "goniometer",
        source=", ".join(source.name for source in paths) or "arrays",
        setup="goniometer",
        dark_level=float(dark_level),
        angle_set_by=angle_set_by,
        **given,
        **_told(channels.values(), relative_error),
    )
    if wavelength is not None:
        capture = capture.assign_coords(wavelength=POSITIVE.check(wavelength, "wavelength"))
    if len(channels) == 2:
        _refuse_swapped(capture)
        _refuse_angles_from_surface(capture, angle_is)
    return validate(capture, source=capture.attrs["name"])


def _views(channels: Mapping[str, "Channel"], given: Mapping[str, float]) -> xr.Dataset:
    """Return the views of both channels, or of one alone."""
    is_share = any(key.endswith("_incident") for key in given)
    units = "1" if is_share else "arbitrary"
    if len(channels) == 1:
        return _alone(next(iter(channels.values())), units)
    levels = "given" if is_share else "not given"
    return _combined(channels["s"], channels["p"], units).assign_attrs(incident_levels=levels)


def _told(
    channels: Collection["Channel"], relative_error: float | None
) -> dict[str, str | int | float]:
    """Describe the treatment of the readings in attributes."""
    notes = dict.fromkeys(note for each in channels for note in each.notes)
    error: str | float = RELATIVE_ERROR if relative_error is None else float(relative_error)
    origin: dict[str, str] = {}
    if relative_error is None and any(each.by_scatter for each in channels):
        error, origin = "scatter of the repeats", {"errors": "from the scatter of repeats"}
    assumed = [each.name for each in channels if not each.stated.all()]
    if relative_error is None and assumed:
        origin = {"errors": ASSUMED}
        what = f"an error of {RELATIVE_ERROR:.0%} of each reading of {' and '.join(assumed)}"
        notes[f"{what} was assumed, which relative_error= replaces"] = None
    return {
        **origin,
        "relative_error": error,
        "readings_at_zero": int(sum((each.light == 0.0).sum() for each in channels)),
        **({"import_notes": "; ".join(notes)} if notes else {}),
    }


def _check_levels(
    dark_level: float, relative_error: float | None, **levels: float | None
) -> dict[str, float]:
    """Refuse incident levels and errors outside their ranges."""
    LEVEL.check(dark_level, "dark_level")
    if relative_error is not None:
        Interval(0.0, 1.0, open_high=True).check(relative_error, "relative_error")
    above_dark = dataclasses.replace(LEVEL, low=dark_level)
    errors = Interval(SMALLEST_ERROR, LARGEST_READING, open_high=True)
    return {
        key: (above_dark if key.endswith("_incident") else errors).check(value, key)
        for key, value in levels.items()
        if value is not None
    }


def _check_channels(asked: Mapping[str, Readings | None], given: Mapping[str, float]) -> None:
    """Refuse incompatible channels, and levels of a channel without readings."""
    present = {key for key, readings in asked.items() if readings is not None}
    if not present or ("unpolarized" in present and len(present) > 1):
        what = "no channel is there" if not present else "unpolarized light is a channel alone"
        hint = "give s= and p=, or one of s=, p= and unpolarized= (a table or a pair of arrays)"
        raise CaptureError(what, where="goniometer", hint=hint)
    for key in given:
        if key.partition("_")[0] not in present:
            hint = f"give {key.partition('_')[0]}=, or leave it out"
            raise CaptureError("its channel is missing", where=key, hint=hint)
    if {"s", "p"} <= present and ("s_incident" in given) != ("p_incident" in given):
        hint = "give s_incident= and p_incident=, or neither"
        raise CaptureError("one incident level is missing", where="goniometer", hint=hint)


def _refuse_swapped(capture: xr.Dataset) -> None:
    """Refuse s and p if s lies below p at nearly every angle, including Brewster's."""
    q, limit = capture["q"], 2.0 * capture["q_error"]
    # Nearer to the normal s and p differ too little.
    compared = capture["valid"] & (capture["view_zenith"] >= 10.0)
    below, total = int((compared & (q < -limit)).sum()), int(compared.sum())
    if total >= 3 and below >= 0.9 * total:
        what = f"s lies below p at {below} of {total} angles, which no reflecting surface does"
        hint = (
            "swap s= and p=, or give s_incident= and p_incident= where the channels differ in "
            "gain; a coating that reflects more p light is imported by pb.from_table, as q"
        )
        raise CaptureError(what, where=capture.attrs["name"], hint=hint)


def _combined(s: "Channel", p: "Channel", units: str) -> xr.Dataset:
    """Return views at the angles of either channel, from both."""
    angle = np.union1d(s.angle, p.angle)
    S, S_error, S_interpolated = s.at(angle)
    P, P_error, P_interpolated = p.at(angle)
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
            **mirror_views(angle),
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


def _alone(channel: "Channel", units: str) -> xr.Dataset:
    """Return views of one channel, which have an intensity and no polarization."""
    light, error, _ = channel.at(channel.angle)
    return xr.Dataset(
        {
            **mirror_views(channel.angle),
            "intensity": ("view", light, {"units": units, "channel": channel.name}),
            "intensity_error": ("view", error, {"units": units}),
        },
    )


# --- One channel ----------------------------------------------------------------------------------


class Rows(NamedTuple):
    """Raw readings of one channel, each (row,); errors name rows by `places`."""

    name: str
    angle: np.ndarray
    reading: np.ndarray
    step: np.ndarray
    stated: np.ndarray
    places: list[str]
    notes: list[str]

    def at_incidence(self, angle_is: str | None) -> "Rows":
        """Return rows at angles of incidence, without those that hold no reading."""
        brightens = None if self.name == "p" else self.reading
        angle = as_incidence(self.angle, angle_is, self.places, brightens)
        wrong = np.abs(self.reading) >= LARGEST_READING
        if wrong.any():
            hint = f"give readings below {LARGEST_READING:g}"
            where = self.places[int(np.argmax(wrong))]
            raise CaptureError("the reading is too large", where=where, hint=hint)
        notes = [*self.notes]
        if angle_is is not None and not np.array_equal(angle, self.angle):
            notes.append(counted(angle.size, "angle", f"of {self.name} read as {angle_is}"))
        known = np.isfinite(self.reading)
        return Rows(
            self.name,
            np.round(angle[known], 6),  # angles that agree so far are one
            self.reading[known],
            self.step[known],
            self.stated[known],
            [place for place, is_known in zip(self.places, known, strict=True) if is_known],
            notes,
        )

    def averaged(self, relative_error: float | None) -> "Channel":
        """Return the mean at each angle, with its error, by default from the scatter."""
        angle, first, group, count = np.unique(
            self.angle, return_index=True, return_inverse=True, return_counts=True
        )
        mean = np.bincount(group, self.reading) / count
        absolute = np.sqrt(
            np.bincount(group, np.maximum(self.step / math.sqrt(12.0), SMALLEST_ERROR) ** 2) / count
        )
        relative = RELATIVE_ERROR if relative_error is None else relative_error
        notes = list(self.notes)
        square = np.bincount(group, (self.reading - mean[group]) ** 2)
        beyond = self.reading.size - angle.size
        told = beyond >= 6 and bool(square.any())  # fewer do not tell the scatter
        if told:
            several = count > 1
            scatter = _scatter(mean[several], square[several], count[several] - 1)
            absolute = np.maximum(absolute, scatter[0])
            relative = scatter[1] if relative_error is None else relative_error
        if beyond:
            error = "their errors are those of the mean of as many independent readings"
            if told:
                error = (
                    f"the error of one is their scatter, {100.0 * scatter[1]:.2g}% of the "
                    f"reading and {max(scatter[0], float(absolute.min())):.2g}"
                )
            at = counted(int((count > 1).sum()), "angle")
            what = counted(self.reading.size, "reading", f"of {self.name}")
            notes.append(f"{what}, repeated at {at}, averaged; {error}")
        stated = np.sqrt(np.bincount(group, self.stated**2) / count)
        known = np.isfinite(stated)
        return Channel(
            name=self.name,
            angle=angle,
            light=mean,
            absolute=np.where(known, stated, absolute),
            relative=np.where(known & (relative_error is None), 0.0, relative),
            count=count,
            stated=known | told,
            places=tuple(self.places[k] for k in first),
            notes=tuple(notes),
            by_scatter=told,
        )


def _scatter(mean: np.ndarray, square: np.ndarray, freedom: np.ndarray) -> tuple[float, float]:
    """Estimate absolute and relative error from sums of squared deviations from means."""
    unit = float(np.abs(mean).max()) or 1.0
    design = np.stack([np.ones_like(mean), (mean / unit) ** 2], axis=-1)
    variance = square / freedom
    expected = np.full_like(mean, variance.mean())
    for _ in range(20):  # iteratively reweighted: the Gamma likelihood of sample variances
        weight = np.sqrt(freedom) / expected
        found, _ = nnls(weight[:, None] * design, weight * variance)
        expected = np.maximum(design @ found, 1e-6 * variance.mean())
    return math.sqrt(found[0]), math.sqrt(found[1]) / unit


@dataclasses.dataclass(frozen=True, eq=False)
class Channel:
    """Light of one channel, one row per angle in ascending order; errors name rows by `places`.

    The error of one reading is that at no light (`absolute`) and over the reading (`relative`); a
    row is the mean of `count` of them.
    """

    name: str
    angle: np.ndarray
    light: np.ndarray
    absolute: np.ndarray
    relative: np.ndarray
    count: np.ndarray
    stated: np.ndarray
    places: tuple[str, ...]
    notes: tuple[str, ...]
    by_scatter: bool

    def refuse(self, wrong: np.ndarray, what: str, hint: str) -> None:
        """Raise an error for the first row that is wrong."""
        if wrong.any():
            row = int(np.argmax(wrong))
            values = f"(angle {self.angle[row]:g}, {self.name} {self.light[row]:g})"
            raise CaptureError(f"{what} {values}", where=self.places[row], hint=hint)

    def scaled(self, dark_level: float, incident: float | None, error: float | None) -> "Channel":
        """Subtract the dark level, and divide by the incident light if it is known."""
        light = self.light - dark_level
        errors, notes = np.full_like(self.absolute, error or 0.0), self.notes
        if error is None:
            unknown = (light <= 0.0) & ~self.stated
            errors = np.where(unknown, np.maximum(self.absolute, self._scatter()), self.absolute)
            if raised := int((errors > 10.0 * self.absolute).sum()):
                what = f"of {self.name} at zero or below given the scatter of its neighbors"
                notes = (*notes, counted(raised, "reading", what))
        what = f"the reading lies below the dark level {dark_level:g}"
        hint = f"give the right dark_level=, or the noise without light by {self.name}_error="
        self.refuse(light < -3.0 * errors / np.sqrt(self.count), what, hint)
        light = np.maximum(light, 0.0)
        full = 1.0
        if incident is not None:
            full = incident - dark_level
            what = "more light comes back than went in"
            hint = f"check {self.name}_incident=, which is {incident:g}"
            # Noise may carry a reflectance past one, not this far.
            self.refuse(light > 1.2 * full, what, hint)
        return dataclasses.replace(self, light=light / full, absolute=errors / full, notes=notes)

    def _scatter(self) -> np.ndarray:
        """Return the deviation of each row's neighbors from a parabola; 0 with too few rows."""
        found = np.zeros_like(self.light)
        for k in range(self.angle.size) if self.angle.size > 6 else ():
            near = np.argsort(np.abs(self.angle - self.angle[k]))[1:7]
            x = self.angle[near] - self.angle[k]
            design = np.vander(x / np.abs(x).max(), 3)
            rest = self.light[near] - design @ np.linalg.lstsq(design, self.light[near])[0]
            found[k] = math.sqrt(float(rest @ rest) / 3.0)  # six readings, three coefficients
        return found

    @property
    def error(self) -> np.ndarray:
        """Standard deviation of each row."""
        return np.hypot(self.absolute, self.relative * self.light) / np.sqrt(self.count)

    def at(self, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return light and its error at these angles, and which angles are interpolated."""
        light, error = np.full((2, angle.size), np.nan)
        read = np.isin(angle, self.angle)
        light[read], error[read] = self.light, self.error
        between = ~read & (angle > self.angle[0]) & (angle < self.angle[-1])
        if between.any():
            right = np.searchsorted(self.angle, angle[between])
            # The logarithm of a reading of zero is replaced by that of its error.
            logs = np.log(np.maximum(self.light, self.absolute))
            light[between] = np.exp(PchipInterpolator(self.angle, logs)(angle[between]))
            absolute, relative = (
                np.maximum(x[right - 1], x[right])
                for x in (self.absolute / np.sqrt(self.count), self.relative / np.sqrt(self.count))
            )
            spread = light[between] * _interpolation_error(self.angle, logs)[right - 1]
            error[between] = np.hypot(np.hypot(absolute, spread), relative * light[between])
        return light, error, between


def _interpolation_error(angle: np.ndarray, logs: np.ndarray) -> np.ndarray:
    """Return the sd of the interpolated logarithm in each gap, (row - 1,)."""
    if angle.size < 3:  # no reading can be left out: a uniform distribution between the two
        return np.abs(np.diff(logs)) / math.sqrt(12.0)
    residual = np.full(angle.shape, np.nan)
    for k in range(1, angle.size - 1):
        near = [j for j in range(max(k - 2, 0), min(k + 3, angle.size)) if j != k]
        residual[k] = abs(PchipInterpolator(angle[near], logs[near])(angle[k]) - logs[k])
    return np.fmax(residual[:-1], residual[1:]) / 4.0


def _refuse_angles_from_surface(capture: xr.Dataset, angle_is: str | None) -> None:
    """Refuse a Brewster angle below that of vacuum, unless the scale of the angle was stated."""
    (peak,) = indices_by_eye(capture).values()
    if angle_is is None and peak is not None and peak.below_vacuum:
        what = f"the polarization {peak.below_vacuum}"
        hint = "this looks like angle_is='from-surface'; if not, say angle_is='incidence'"
        raise CaptureError(what, where=capture.attrs["name"], hint=hint)


def _read(
    asked: Mapping[str, Readings | None],
    table: str | os.PathLike[str] | None,
    angle: str | None,
    sheet: str | None,
) -> dict[str, "Rows"]:
    """Read the requested channels from one table, from a table each, or from arrays."""
    channels = {key: each for key, each in asked.items() if each is not None}
    if table is None and angle is not None:
        hint = "give table=, or s= and p= as tables of their own"
        raise CaptureError("a column is named without table", where="angle", hint=hint)
    if table is None:
        return {key: _rows_of_own(key, each, sheet) for key, each in channels.items()}
    columns = {"angle": angle, **channels}
    for key, column in columns.items():
        if not isinstance(column, str):
            hint = f"name a column of the table by {key}="
            raise CaptureError("its column is not named", where=f"{table}: {key}", hint=hint)
    named = [str(each) for each in columns.values()]
    read = read_table(table, named, sheet=sheet)
    return {key: _rows_of(key, read, named[0], str(each)) for key, each in channels.items()}


def _rows_of_own(name: str, readings: Readings, sheet: str | None) -> "Rows":
    """Read a channel from a table of two columns, or from a pair of arrays."""
    if not isinstance(readings, str | os.PathLike):
        return _rows_of_arrays(name, readings)
    table = read_table(readings, sheet=sheet)
    if len(table.names) != 2:
        what = f"it has {len(table.names)} columns, not two"
        hint = "give angle and reading, or use table= and name the columns angle=, s= and p="
        raise CaptureError(what, where=table.source, hint=hint)
    return _rows_of(name, table, *table.names)


def _rows_of(name: str, table: Table, angle: str, reading: str) -> Rows:
    """Read a channel from two columns of a table; the last printed digit gives the error."""
    if not np.isfinite(table.columns[reading]).any():
        where = f"{table.source}: column {reading}"
        raise CaptureError("no line has a reading", where=where, hint="name another column")
    return Rows(
        name,
        table.columns[angle],
        table.columns[reading],
        table.steps[reading],
        table.errors[reading],
        table.places,
        [*table.notes],
    )


def _rows_of_arrays(name: str, readings: Any) -> Rows:
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
    # The resolution of all readings, by the digits that each needs in its own precision.
    finest = min(last_digit(np.format_float_positional(x, trim="-")) for x in printed)
    angle, reading = angle.astype(np.float64), reading.astype(np.float64)
    places = [f"{name}[row={row}]" for row in range(angle.size)]
    step, stated = np.full(angle.shape, finest), np.full(angle.shape, np.nan)
    return Rows(name, angle, reading, step, stated, places, [])
