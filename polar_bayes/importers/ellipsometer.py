r"""A capture from an ellipsometer: psi and delta, or Mueller elements, against the angle.

With psi the arctangent of |r_p/r_s| and delta the phase of r_p/r_s, unpolarized light that a mirror
sends back has

$$ q = \cos 2\psi, \qquad u = \sin 2\psi \cos\Delta \;\text{(light polarized at 45 degrees)} $$

and q is the same for light polarized at 45 degrees. That angle counts as ellipsometers count it; in
the axes of `polar_bayes.physics.LinearPolarization` it is -45, which the attribute `light_angle` of
u states and a fit puts in. Errors of psi and delta are propagated to second order, since q has no
slope where psi is 0 or 90:

$$ \sigma_q^2 = (2 \sin 2\psi\, \sigma_\psi)^2 + 8 (\cos 2\psi\, \sigma_\psi^2)^2 $$

With delta, q and u hold the same reading of psi, and a fit takes them as independent: there the
error of psi counts sqrt(2) times, so that both together know psi as well as it was read.

Of a Mueller matrix, the first column is what unpolarized light becomes, the first row what a
detector blind to polarization sees: q = -m10/m00 or -m01/m00, since ellipsometers count p positive.

WVASE writes three lines (title, method, unit of wavelength), then a line for each reading: its
kind, wavelength, angle, psi, delta and their errors. Lines of another kind than E, such as dpolE,
are left out and counted. A plate with a polished back sends back light of its back face too.

Source:
    Azzam and Bashara 1977, Ellipsometry and Polarized Light, sections 1.7, 2.12 and 4.2; Fujiwara
    2007, Spectroscopic Ellipsometry, chapter 4.
"""

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import xarray as xr

from polar_bayes.capture.plausibility import ASSUMED
from polar_bayes.capture.schema import as_numbers, check_choice, validate
from polar_bayes.errors import CaptureError
from polar_bayes.importers.columns import Table, counted, read_table
from polar_bayes.importers.mirror import as_incidence, mirror_views
from polar_bayes.importers.table import MUELLER, capture_of_lines

ASSUMED_ERRORS, ELEMENT_ERROR = {"psi": 0.1, "delta": 0.2}, 0.005
"""Default errors of psi and delta in degrees, and of an element of a Mueller matrix."""
TO_NM = {"nm": 1.0, "angstroms": 0.1, "angstrom": 0.1, "um": 1000.0, "µm": 1000.0}
WVASE = ("wavelength", "angle", "psi", "delta", "psi_error", "delta_error")
"""Columns of WVASE files, after the kind of the line."""

UNITS = {"degree": 1.0, "radian": 180.0 / math.pi}
"""Size of each unit of psi and delta, in degrees."""

Columns = str | Sequence[str]
Given = str | float | Sequence[str] | Sequence[float] | None


def from_ellipsometer(
    table: str | os.PathLike[str],
    *,
    angle: str | float | None = None,
    psi: Columns = (),
    delta: Columns = (),
    mueller: str | None = None,
    wavelength: str | float | Sequence[float] | None = None,
    unit: str | None = None,
    psi_error: str | float | None = None,
    delta_error: str | float | None = None,
    angle_is: str | None = None,
    sheet: str | None = None,
    angle_set_by: str = "stage",
    name: str | None = None,
) -> xr.Dataset:
    """Make a capture from readings of an ellipsometer; see the module.

    Args:
        table: A text table or .xlsx workbook; without `psi` and `mueller`, a .dat file of WVASE.
        angle: Column with the angle, or the angle of all lines, degree.
        psi: Column of psi, or one for each wavelength.
        delta: Column of delta, or one for each wavelength, which gives u as well.
        mueller: In place of psi, elements named m00 to m33 or m11 to m44: "column" where light was
            unpolarized and the reflected light analyzed, "row" where light was polarized and the
            detector blind to it. Where m00 is not there, they are normalized.
        wavelength: Column of wavelengths, the wavelength of all lines, or one for each column of
            psi. Unit nm.
        unit: Of psi and delta: "degree" or "radian"; by default degrees, and what looks like
            radians is refused.
        psi_error: Standard deviation of psi, > 0, or its column, in the same unit; by default 0.1
            degrees. A fit finds a common factor of all errors.
        delta_error: The same of delta; by default 0.2 degrees.
        angle_is: What the angles are, as in `polar_bayes.from_goniometer`.
        sheet: Sheet of a workbook, where several hold something.
        angle_set_by: How the angles were set: "stage", "hand" or "lens".
        name: Name of the capture; default: that of the table.

    Returns:
        The validated capture: q and its error, with delta u and its error too, of dims (view[,
        wavelength]). The attribute `import_notes` says what was done to the readings.

    Raises:
        CaptureError: An option, the file, a line or a reading that is wrong.
    """
    check_choice(unit, (None, *UNITS), "unit")
    check_choice(mueller, (None, "column", "row"), "mueller")
    given: dict[str, Given] = {
        "angle": angle, "psi": psi or None, "delta": delta or None, "wavelength": wavelength,
        "psi_error": psi_error, "delta_error": delta_error,
    }  # fmt: skip
    to_nm = 1.0
    if given["psi"] is None and mueller is None:
        read, to_nm, given = _read_wvase(table)
    else:
        read = _read_named(table, given, mueller, sheet)
    values = {key: _grid(read, key, each) for key, each in given.items() if each is not None}
    incidence = _incidence(read, values, angle_is)
    in_use = [key for key in ASSUMED_ERRORS if key in values]
    is_assumed = mueller is not None or any(f"{key}_error" not in values for key in in_use)
    notes = [*read.notes, *([f"the angles were read as {angle_is}"] if angle_is else [])]
    if mueller is None:
        _check_angles(read, values, unit)
        stokes = _of_angles(values, UNITS[unit or "degree"], notes)
    else:
        stokes = _of_elements(read, mueller, incidence, notes)
    if "wavelength" in values:
        stokes["wavelength"] = to_nm * values["wavelength"]
    capture = _capture(incidence, stokes, notes).assign_attrs(
        name=name or Path(table).stem,
        source=Path(table).name,
        setup="goniometer",
        angle_set_by=angle_set_by,
        **({"errors": ASSUMED} if is_assumed else {}),
        **({"import_notes": "; ".join(notes)} if notes else {}),
    )
    return validate(capture, source=capture.attrs["name"])


def _incidence(read: Table, values: Mapping[str, np.ndarray], angle_is: str | None) -> np.ndarray:
    """Return the angle of incidence of each line."""
    if "angle" not in values:
        hint = "give its column, or degrees, by angle="
        raise CaptureError("nothing gives the angle", where=f"{read.source}: angle", hint=hint)
    angles = np.broadcast_to(values["angle"], (len(read.lines), 1))[:, 0]
    return as_incidence(angles, angle_is, read.places)


def _capture(
    incidence: np.ndarray, stokes: Mapping[str, np.ndarray], notes: list[str]
) -> xr.Dataset:
    """Make a capture from arrays (line or 1, wavelength or 1); blank readings are masked."""
    directions = {key: each[:, None] for key, (_, each) in mirror_views(incidence).items()}
    arrays = np.broadcast_arrays(*directions.values(), *stokes.values())
    lines = dict(zip((*directions, *stokes), (each.ravel() for each in arrays), strict=True))
    lines["valid"] = np.isfinite(lines["q"]) & np.isfinite(lines.get("u", 0.0))
    if masked := int((~lines["valid"]).sum()):
        notes.append(counted(masked, "blank reading", "masked"))
    capture = capture_of_lines(lines)
    if "u" in capture:
        # Light polarized at 45 degrees of an ellipsometer, in the axes of `LinearPolarization`.
        capture["u"].attrs["light_angle"] = -45.0
    return capture


# --- Reading --------------------------------------------------------------------------------------


def _read_named(
    table: str | os.PathLike[str],
    given: Mapping[str, Given],
    mueller: str | None,
    sheet: str | None,
) -> Table:
    """Read the named columns and, with `mueller`, the elements of Mueller matrices."""
    named = [column for each in given.values() for column in _columns(each)]

    def chosen(names: list[str]) -> list[str]:
        elements = [name for name in names if MUELLER.fullmatch(name)]
        if mueller is not None and not elements:
            hint = f"name them m00 to m33 or m11 to m44; there are {', '.join(names)}"
            raise CaptureError("no column is an element of a matrix", where=str(table), hint=hint)
        return [*named, *(elements if mueller is not None else ())]

    return read_table(table, chosen, sheet=sheet, wanted=named)


def _columns(given: Given) -> list[str]:
    """Return the arguments that are names of columns."""
    each = [given] if given is None or isinstance(given, str | float | int) else given
    return [name for name in each if isinstance(name, str)]


def _read_wvase(
    table: str | os.PathLike[str],
) -> tuple[Table, float, dict[str, Given]]:
    """Read a .dat file of WVASE: columns, factor from its wavelengths to nm, and their meaning."""
    read = read_table(table, kind="E")
    if not 4 <= len(read.names) <= len(WVASE):
        what = f"psi is not named, and {len(read.names)} columns are no .dat file of WVASE"
        hint = "name psi=, or mueller= where it holds elements of Mueller matrices"
        raise CaptureError(what, where=read.source, hint=hint)
    units = [word.lower() for word in read.above if word.lower() in TO_NM]
    if not units:
        what, hint = "no line above the readings names nm or Angstroms", "name psi= and wavelength="
        raise CaptureError(what, where=read.source, hint=hint)
    return read, TO_NM[units[-1]], dict(zip(WVASE, read.names, strict=False))


def _grid(read: Table, key: str, given: Given) -> np.ndarray:
    """Return the values of a quantity, (line or 1, wavelength or 1)."""
    if names := _columns(given):
        return np.stack([read.columns[name] for name in names], axis=-1)
    numbers = as_numbers(given)
    if numbers.ndim > 1 or not np.isfinite(numbers).all():
        raise CaptureError(f"it is {given!r}", where=key, hint="give a number or a column")
    return numbers.reshape(1, -1)


# --- Stokes parameters ----------------------------------------------------------------------------


def _check_angles(read: Table, values: Mapping[str, np.ndarray], unit: str | None) -> None:
    """Refuse psi and delta outside their ranges, and those that look like radians."""
    width = values["psi"].shape[1]
    for key in ("delta", "wavelength", "psi_error", "delta_error"):
        if key in values and values[key].shape[1] not in (1, width):
            what = f"there are {values[key].shape[1]} for {counted(width, 'column')} of psi"
            raise CaptureError(what, where=key, hint="give one of all, or one for each")
    if width > 1 and values.get("wavelength", np.empty((1, 1))).shape[1] != width:
        hint = "give the wavelength of each"
        raise CaptureError(f"psi has {width} columns", where="wavelength", hint=hint)
    scale = UNITS[unit or "degree"]
    for key, low, high in (("psi", 0.0, 90.0), ("delta", -360.0, 360.0)):
        if key not in values:
            continue
        degrees = scale * values[key]
        wrong = (degrees < low) | (degrees > high)
        if wrong.any():
            line, _ = np.argwhere(wrong)[0]
            what = f"{key} is {values[key][wrong][0]:g}, outside {low:g} to {high:g} degrees"
            hint = "check the column" if unit is None else "check unit="
            raise CaptureError(what, where=read.places[line], hint=hint)
    psi = values["psi"]
    if unit is None and psi.size > 2 and np.nanmax(psi) <= np.pi / 2.0 and np.ptp(psi) > 0.1:
        what = f"psi from {np.nanmin(psi):g} to {np.nanmax(psi):g} looks like radians"
        hint = "say unit='radian', or unit='degree' if it is not"
        raise CaptureError(what, where=read.source, hint=hint)


def _of_angles(
    values: Mapping[str, np.ndarray], to_degrees: float, notes: list[str]
) -> dict[str, np.ndarray]:
    """Return Stokes parameters from psi and delta."""
    radians, errors = {}, {}
    for key in (key for key in ASSUMED_ERRORS if key in values):
        radians[key] = np.deg2rad(to_degrees * values[key])
        stated = values.get(f"{key}_error")
        if stated is None:
            notes.append(f"an error of {ASSUMED_ERRORS[key]:g} degrees of {key} was assumed")
        known = np.full((1, 1), ASSUMED_ERRORS[key]) if stated is None else to_degrees * stated
        errors[key] = np.deg2rad(known)
    sin, cos = np.sin(2.0 * radians["psi"]), np.cos(2.0 * radians["psi"])
    psi = errors["psi"] * (math.sqrt(2.0) if "delta" in values else 1.0)
    found = {"q": cos, "q_error": np.hypot(2.0 * sin * psi, math.sqrt(8.0) * cos * psi**2)}
    if "delta" in values:
        turn, delta = radians["delta"], errors["delta"]
        found["u"] = sin * np.cos(turn)
        by_psi = np.cos(turn) * np.hypot(2.0 * cos * psi, math.sqrt(8.0) * sin * psi**2)
        by_delta = sin * np.hypot(np.sin(turn) * delta, np.cos(turn) * delta**2 / math.sqrt(2.0))
        found["u_error"] = np.hypot(by_psi, by_delta)
    return found


def _of_elements(
    read: Table, mueller: str, incidence: np.ndarray, notes: list[str]
) -> dict[str, np.ndarray]:
    """Return the Stokes parameter q from elements of Mueller matrices."""
    elements = {
        (int(match[1]), int(match[2])): name
        for name in read.names
        if (match := MUELLER.fullmatch(name))
    }
    first = min(min(place) for place in elements)
    wanted = (first + 1, first) if mueller == "column" else (first, first + 1)
    if wanted not in elements:
        hint = f"there are {', '.join(elements.values())}"
        what = f"the element {wanted[0]}{wanted[1]} is missing"
        raise CaptureError(what, where=read.source, hint=hint)
    q = -read.columns[elements[wanted]]
    if (first, first) in elements:
        q = q / read.columns[elements[first, first]]
    oblique = incidence >= 10.0
    if oblique.any() and (q[oblique] < 0.0).mean() >= 0.9:  # no reflecting surface does that
        q = -q
        notes.append("q has the sign of the element, since s light counts as positive here")
    notes.append(f"an error of {ELEMENT_ERROR:g} of q was assumed")
    return {"q": q[:, None], "q_error": np.full((1, 1), ELEMENT_ERROR)}
