"""Plausibility of a capture: readings that no light explains, and the index they suggest.

A validated capture may still hold the channels swapped or the directions of another convention.
Where unpolarized light falls in, a view at the mirror angle sees light of the surface, whose s
share is the larger one (Fresnel), and light of the body, which is partly p polarized by its
refraction at the surface. So no mixture of them has a q below that of the body alone, and on the
light's own side none is polarized more than a facet that mirrors the light, or the body. The
bounds are those of the largest and the smallest index that a dielectric is likely to have.
"""

import itertools
import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

ASSUMED = "assumed by the import"
"""Value of the attribute `errors` of a capture whose errors nobody stated."""

SMALLEST_VIEWS = 3
"""Smallest number of views from whose polarization anything is concluded."""
PURE_PEAK = 0.9
"""Degree of polarization from which a peak is attributed to the surface alone."""
DEFAULT_INDICES = (1.2, 2.0)
"""Smallest and largest index under the default priors; a test compares them."""
MAX_LISTED = 4


class IndexByEye(NamedTuple):
    """The index of a bare mirror, from the angle at which mirror views are most polarized.

    Args:
        low: Smallest index that the peak allows.
        center: Index that the middle of the peak means.
        high: Largest index that the peak allows.
        polarization: Of the peak; light of a body lowers it, and moves it to larger angles.
    """

    low: float
    center: float
    high: float
    polarization: float

    @property
    def angle(self) -> float:
        """The angle at the middle of the peak, unit degree."""
        return math.degrees(math.atan(self.center))

    @property
    def below_vacuum(self) -> str:
        """What speaks against the angles, which may be those from the surface; or an empty text."""
        if self.high >= 1.0:
            return ""
        return (
            f"is largest near {self.angle:.0f} degrees, which would be Brewster's angle of an "
            f"index of {self.center:.2f}, below that of vacuum"
        )

    @property
    def is_pure(self) -> bool:
        """True if the surface alone makes the peak."""
        return self.polarization >= PURE_PEAK

    @property
    def spread(self) -> float:
        """Half the width of the range of the index, rounded up to one digit."""
        half = 0.5 * (self.high - self.low)
        step = 10.0 ** math.floor(math.log10(half))
        return math.ceil(half / step - 1e-9) * step

    @property
    def prior(self) -> str:
        """A prior that includes the range, as text."""
        decimals = 1 if self.spread >= 0.1 else 2
        return f"TruncatedNormal({self.center:.{decimals}f}, {self.spread:g}, low=1)"

    def is_beyond(self, bounds: tuple[float, float]) -> bool:
        """Return whether a prior ends before the middle and is not narrower than the range."""
        within = self.low <= bounds[0] and bounds[1] <= self.high
        within = within or self.high < 1.0  # no prior mends that
        return self.is_pure and not within and not bounds[0] <= self.center <= bounds[1]

    def is_excluded(self, bounds: tuple[float, float], degrees: float = 0.0) -> bool:
        """Return whether a prior ends before the range, allowing for an angle offset."""
        low, high = (
            _index(math.degrees(math.atan(end)) + turn)
            for end, turn in ((self.low, -degrees), (self.high, degrees))
        )
        return self.is_beyond(bounds) and (high < bounds[0] or bounds[1] < low)


def indices_by_eye(capture: xr.Dataset) -> dict[str, IndexByEye | None]:
    """Estimate the index of each material or patch from Brewster's angle.

    The angles are those of mirror views, smoothed by a running median of three, so that a single
    reading makes no peak. The middle is that of the flanks.

    Args:
        capture: A validated capture.

    Returns:
        By the words that name a material, "" where there is one only: the index with its range, or
        None where the views do not show a peak.
    """
    return {name.removeprefix(" of "): _brewster(part) for name, part in _materials(capture)}


def index_sentences(
    found: Mapping[str, IndexByEye | None],
    bounds: tuple[float, float] = DEFAULT_INDICES,
    parameter: str = "refractive_index",
    prior: str = "the default prior",
) -> tuple[str, ...]:
    """State the index by Brewster's angle where a prior excludes it, and a prior that fits.

    Args:
        found: What `indices_by_eye` returned.
        bounds: Smallest and largest index that the prior allows.
        parameter: Whose prior it is.
        prior: Which prior it is, in words.

    Returns:
        One sentence; none where the prior excludes no index.
    """
    beyond = {name: each for name, each in found.items() if each and each.is_beyond(bounds)}
    remedy = allowing_prior(found, bounds)
    if not remedy:
        return ()
    indices = " and ".join(
        f"{each.center:.2f} ({each.low:.2f} to {each.high:.2f}){name and f' of {name}'}"
        for name, each in itertools.islice(beyond.items(), MAX_LISTED)
    )
    ends = dict.fromkeys(
        f"ends at {bounds[1]:g}" if each.center > bounds[1] else f"begins at {bounds[0]:g}"
        for each in beyond.values()
    )
    sentence = (
        f"Brewster's angle means an index near {indices}, but {prior} of {parameter} "
        f"{' and '.join(ends)}: give priors={{'{parameter}': {remedy}}}."
    )
    return (sentence,)


def allowing_prior(found: Mapping[str, IndexByEye | None], bounds: tuple[float, float]) -> str:
    """Return a prior, as text, that allows the indices of all materials; "" if bounds do."""
    pure = [each for each in found.values() if each and each.is_pure]
    if not any(each.is_beyond(bounds) for each in pure):
        return ""
    if len(pure) == 1:
        return pure[0].prior
    low, high = min(each.low for each in pure), max(each.high for each in pure)
    return IndexByEye(low, 0.5 * (low + high), high, PURE_PEAK).prior


def cautions(capture: xr.Dataset) -> tuple[str, ...]:
    """List unlikely readings or directions of a capture, each with its likely cause.

    Args:
        capture: A validated capture.

    Returns:
        A sentence for each, none for a capture in which nothing is unlikely.
    """
    found = [*_azimuth_cautions(capture), *_excess_cautions(capture), *_gamma_cautions(capture)]
    for check in (_sign_cautions, _side_cautions, _scale_cautions, _ceiling_cautions):
        found += [each for name, part in _materials(capture) for each in check(name, part)]
    return tuple(dict.fromkeys(found))


def inferred(capture: xr.Dataset) -> tuple[str, ...]:
    """Describe a capture and what its readings suggest, for its user to confirm.

    Args:
        capture: A validated capture.

    Returns:
        Sentences on readings, directions, wavelengths, the sign of q and Brewster's angle by eye,
        as far as the capture has them.
    """
    found = [_readings_sentence(capture)]
    for tell in (_sign_sentences, _brewster_sentences):
        found += [each for name, part in _materials(capture) for each in tell(name, part)]
    return tuple(found)


def stated(capture: xr.Dataset) -> tuple[str, ...]:
    """Describe how the file of a capture was read, and what it states for fits.

    Args:
        capture: A validated capture.

    Returns:
        A sentence on what an import left out, read otherwise or averaged, one on the set-up, and
        one on the incident levels of a goniometer.
    """
    setup = (
        "Set-up: not stated, so a fit takes 'polarimeter', a point source and an unsigned degree "
        "of polarization; name it by setup= at import or scene= of the fit."
    )
    if "setup" in capture.attrs:
        setup = f"Set-up: {capture.attrs['setup']}, which its fits take by default."
    levels = {
        "given": ("Incident levels: given, so s and p are on one scale.",),
        "not given": (
            "Incident levels: not given, so s and p are taken to be on one scale; a fit gives the "
            "ratio of their gains (channel_gain_ratio) a wider prior than otherwise.",
        ),
    }
    notes = capture.attrs.get("import_notes")
    done = (f"Import: {notes}.",) if notes else ()
    return (*done, setup, *levels.get(capture.attrs.get("incident_levels", ""), ()))


# --- Directions -----------------------------------------------------------------------------------


def _materials(capture: xr.Dataset) -> list[tuple[str, xr.Dataset]]:
    """Return the capture of each material or patch with its name; an image counts as one."""
    for dim in (name for name in ("material", "patch") if name in capture.dims):
        labels = capture[dim].values  # numbers from 0 where the capture has none
        return [(f" of {dim} {label}", capture.isel({dim: k})) for k, label in enumerate(labels)]
    return [("", capture)]


def azimuth_difference(views: xr.Dataset) -> xr.DataArray:
    """Return the angle between azimuths of viewer and light, degree, 0 to 180: the mirror side."""
    return abs((views["view_azimuth"] - views["light_azimuth"] + 180.0) % 360.0 - 180.0)


def at_mirror(capture: xr.Dataset, within: float = 2.5) -> xr.DataArray:
    """Return True for views in the mirror direction of the light, within so many degrees."""
    apart = abs(capture["view_zenith"] - capture["light_zenith"])
    sideways = 180.0 - azimuth_difference(capture)
    return (apart <= within) & (sideways * np.sin(np.deg2rad(capture["view_zenith"])) <= within)


def _signals(capture: xr.Dataset) -> list[str]:
    return [name for name in ("dop", "q", "u", "intensity") if name in capture]


def _valid(capture: xr.Dataset) -> xr.DataArray:
    return capture.get("valid", xr.DataArray(True))


def _judged(capture: xr.Dataset, where: xr.DataArray, signal: str) -> xr.DataArray:
    """Return True for measured readings at views whose zenith separates surface and body."""
    # Between these zeniths surface and body are polarized enough to be told apart.
    zenith, known = capture["view_zenith"], _valid(capture) & capture[signal].notnull()
    return where & (zenith >= 15.0) & (zenith <= 80.0) & known


def _mostly(wrong: xr.DataArray, judged: xr.DataArray) -> str:
    """Describe how many of the judged views are wrong, as "3 of 4"; empty if under half are."""
    count, total = int((judged & wrong).sum()), int(judged.sum())
    return f"{count} of {total}" if total >= SMALLEST_VIEWS and 2 * count >= total else ""


def _noise(capture: xr.Dataset, signal: str) -> xr.DataArray:
    """Return the largest plausible error of a reading by noise."""
    return 3.0 * capture.get(f"{signal}_error", xr.DataArray(0.03))


# --- What light can be ----------------------------------------------------------------------------


def fresnel(zenith: Any, index: float) -> tuple[Any, Any]:
    """Return the s and p reflectance of a smooth surface at a zenith in degrees."""
    cos, sin = np.cos(np.deg2rad(zenith)), np.sin(np.deg2rad(zenith))
    inside = np.sqrt(index**2 - sin**2)
    s = ((cos - inside) / (cos + inside)) ** 2
    p = ((index**2 * cos - inside) / (index**2 * cos + inside)) ** 2
    return s, p


def _body_polarization(zenith: xr.DataArray) -> xr.DataArray:
    """Return the largest DoP, along p, of light that leaves a body at a zenith."""
    s, p = fresnel(zenith, 2.5)
    return (s - p) / (2.0 - s - p)


# --- Cautions -------------------------------------------------------------------------------------


def _azimuth_cautions(capture: xr.Dataset) -> Iterator[str]:
    largest = max(float(abs(capture[f"{each}_azimuth"]).max()) for each in ("view", "light"))
    at_pi = abs(azimuth_difference(capture) - np.pi) < 0.01
    if largest <= 2.0 * np.pi + 0.01 and bool(at_pi.any()):
        yield (
            "Viewer and light are pi degrees of azimuth apart, which looks like radians: give 180 "
            "for the mirror side of the light."
        )


def _excess_cautions(capture: xr.Dataset) -> Iterator[str]:
    """Caution against (q, u) longer than 1 by more than the errors allow."""
    if "q_error" not in capture or "u_error" not in capture:
        return
    q, u = capture["q"], capture["u"]
    degree = (q**2 + u**2) ** 0.5
    error = ((q * capture["q_error"]) ** 2 + (u * capture["u_error"]) ** 2) ** 0.5 / degree
    valid = degree.notnull() & _valid(capture)
    wrong = valid & (degree > 1.0 + 5.0 * error)
    count, total = int(wrong.sum()), int(valid.sum())
    if count > 0.01 * total:
        largest = float(degree.where(wrong).max())
        yield (
            f"{count} of {total} readings have sqrt(q^2 + u^2) above 1 by more than "
            f"5 stated errors (up to {largest:.3g}): "
            "no light has it, so errors are stated too small, or dark level, background or the "
            "gains of the channels are off."
        )


def _gamma_cautions(capture: xr.Dataset) -> Iterator[str]:
    """Caution against counts that are not in proportion to light by their analyzer angles."""
    undone, gamma, error = (
        float(capture.attrs.get(name, 1.0))
        for name in ("transfer_gamma", "measured_gamma", "measured_gamma_error")
    )
    off = abs(np.log(gamma / undone))
    # Tone curves compress: an exponent below 1 has another cause, such as an object that moved.
    if "measured_gamma" in capture.attrs and gamma > 0.85 and off > max(0.05, 5.0 * error / gamma):
        transfer = "'linear'" if gamma < 1.05 else f"{gamma:.2g}"
        pictures = " (transfer='srgb' where they are pictures)" if 1.8 < gamma < 2.6 else ""
        remedy = f"import them with transfer={transfer}{pictures}"
        if gamma < 1.05 and undone == 1.0:  # they are read as linear already
            remedy = "no tone curve has it: look for a wrong dark level or an object that moved"
        yield (
            "Light behind the analyzers contradicts that counts are in proportion to it, as they "
            f"are taken to be (transfer function: {capture.attrs.get('transfer', 'linear')}): the "
            f"frames have a gamma of {gamma:.2f} +- {error:.1g}, and q and u are wrong by about "
            f"{abs(undone / gamma - 1.0):.0%}; {remedy}."
        )


def _sign_cautions(name: str, capture: xr.Dataset) -> Iterator[str]:
    """Caution against mirror views with more p light than the body alone can send."""
    if "q" not in capture:
        return
    judged = _judged(capture, at_mirror(capture), "q")
    least = -_body_polarization(capture["view_zenith"]) - _noise(capture, "q")
    if share := _mostly(capture["q"] < least, judged):
        yield (
            f"q{name} is negative at {share} mirror angles, more than surface and body "
            "can make it: s and p are likely swapped, or q is defined with the other sign (here "
            "q > 0 is s light, perpendicular to the plane of normal and viewer); swap them, or "
            "turn the sign."
        )


def _side_cautions(name: str, capture: xr.Dataset) -> Iterator[str]:
    """Caution against views on the light's side that are polarized like mirror views."""
    signal = next((each for each in ("dop", "q") if each in capture), None)
    if signal is None or capture.attrs.get("setup") == "picture":  # light from everywhere
        return
    apart = azimuth_difference(capture)
    if not bool((apart <= 20.0).all()):
        return
    judged = _judged(capture, apart <= 20.0, signal)
    view, light = (np.deg2rad(capture[f"{each}_zenith"]) for each in ("view", "light"))
    cos = np.cos(view) * np.cos(light) + np.sin(view) * np.sin(light) * np.cos(np.deg2rad(apart))
    s, p = fresnel(0.5 * np.rad2deg(np.arccos(np.clip(cos, -1.0, 1.0))), 1.2)
    most = np.maximum((s - p) / (s + p), _body_polarization(capture["view_zenith"]))
    if share := _mostly(abs(capture[signal]) > most + _noise(capture, signal), judged):
        yield (
            f"Every view{name} is on the side of the light, and {share} are polarized "
            "more than any light that returns there: the detector was likely on the mirror side, "
            "where view_azimuth and light_azimuth are 180 degrees apart."
        )


def _scale_cautions(name: str, capture: xr.Dataset) -> Iterator[str]:
    """Caution against a Brewster angle below that of vacuum: angles from the surface?"""
    peak = _brewster(capture)
    if peak is not None and peak.below_vacuum:
        yield (
            f"The polarization{name} {peak.below_vacuum}: the angles were likely counted from the "
            "surface, which an import takes by angle_is='from-surface'."
        )


def _ceiling_cautions(name: str, capture: xr.Dataset) -> Iterator[str]:
    """Caution against readings that stop at one value below full scale: a sensor's limit."""
    if {"y", "x"} & set(capture.dims):
        return
    for signal in _signals(capture):
        readings = capture[signal].where(_valid(capture))
        limit = readings.attrs.get("saturation_level", math.inf) if signal == "intensity" else 1.0
        is_spectral = "wavelength" in readings.dims
        for color in readings.transpose("wavelength", ...) if is_spectral else [readings]:
            value, count = _ceiling(color.to_numpy())
            if count and value < 0.999 * limit:
                wavelength = f" at {float(color['wavelength']):g} nm" if is_spectral else ""
                yield (
                    f"The {count} largest readings of {signal}{wavelength}{name} are {value:.4g} "
                    "in every digit, and no others are so alike: a channel likely saturates there. "
                    "Expose less, or mask these views (valid = 0)."
                )


def _ceiling(readings: np.ndarray) -> tuple[float, int]:
    """Return the largest reading and how many have it, or 0 where that is no sign of a limit."""
    values, counts = np.unique(readings[np.isfinite(readings)], return_counts=True)
    if len(values) < 2 * SMALLEST_VIEWS or counts[-1] <= 2 * counts[:-1].max():
        return 0.0, 0
    # A smooth peak repeats in every digit, too, but falls by few of the smallest steps beside.
    digits = next((n for n in range(15) if np.array_equal(values.round(n), values)), 15)
    falls = values[-1] - values[-2] > 5.0 * 10.0**-digits
    return float(values[-1]), int(counts[-1]) if falls else 0


# --- What was inferred ----------------------------------------------------------------------------


def _readings_sentence(capture: xr.Dataset) -> str:
    signals = _signals(capture)
    errors = f"errors {capture.attrs.get('errors', 'stated')}"
    names = [f"{n} ({errors if f'{n}_error' in capture else 'no errors stated'})" for n in signals]
    zenith = capture["view_zenith"]
    views = capture.sizes["view"]
    mirror = int(at_mirror(capture).any([x for x in zenith.dims if x != "view"]).sum())
    colors = "no wavelength is stated"
    if "wavelength" in capture.coords:
        values = np.atleast_1d(capture["wavelength"].values)
        more = f" and {len(values) - MAX_LISTED} more" if len(values) > MAX_LISTED else ""
        colors = f"{', '.join(f'{x:g}' for x in values[:MAX_LISTED])}{more} nm"
    return (
        f"Readings: {', '.join(names)}; {views} view{'s' if views != 1 else ''} from "
        f"{float(zenith.min()):g} to {float(zenith.max()):g} degrees from the normal, {mirror} of "
        f"them at the mirror angle; {colors}."
    )


def _sign_sentences(name: str, capture: xr.Dataset) -> Iterator[str]:
    if "q" not in capture:
        return
    judged = _judged(capture, at_mirror(capture), "q")
    if total := int(judged.sum()):
        count = int((judged & (capture["q"] > 0.0)).sum())
        yield f"Sign: q{name} is positive (s light) at {count} of {total} mirror angles."


def _brewster_sentences(name: str, capture: xr.Dataset) -> Iterator[str]:
    peak = _brewster(capture)
    if peak is not None:
        moved = (
            f"; the peak is {peak.polarization:.2f}, so light of the body has likely moved it to "
            "larger angles, and the index is smaller"
        )
        yield (
            f"Brewster's angle by eye{name}: the polarization is largest near {peak.angle:.0f} "
            f"degrees, which would mean an index near {peak.center:.2f} "
            f"({peak.low:.2f} to {peak.high:.2f}){'' if peak.is_pure else moved}."
        )


def _brewster(capture: xr.Dataset) -> IndexByEye | None:
    """Return the index from the peak of polarization of mirror views, where they show one."""
    signal = next((each for each in ("q", "dop") if each in capture), None)
    if signal is None or {"y", "x"} & set(capture.dims):
        return None
    zenith = capture["view_zenith"]
    used = at_mirror(capture) & (zenith >= 20.0) & (zenith <= 85.0) & _valid(capture)
    readings = capture[signal].where(used)
    others = [dim for dim in readings.dims if dim != "view"]
    values = readings.mean(others).to_numpy()  # over wavelengths
    kept = np.isfinite(values)
    angles, values = zenith.to_numpy()[kept], values[kept]
    angles, position = np.unique(angles, return_inverse=True)
    if len(angles) < 2 * SMALLEST_VIEWS:
        return None
    values = np.bincount(position, values) / np.bincount(position)
    noise = float(_noise(capture, signal).where(used).median()) / 3.0
    return _peak(angles, values, noise)


def _peak(angles: np.ndarray, values: np.ndarray, noise: float) -> IndexByEye | None:
    """Return the index from the middle between both flanks of a peak; angles in degrees."""
    # A single reading far from its neighbors, which is no peak, does not pass a running median. It
    # moves a flank by one step at most.
    smooth = values.copy()
    smooth[1:-1] = np.median([values[:-2], values[1:-1], values[2:]], axis=0)
    peak = 1 + int(np.argmax(smooth[1:-1]))
    top = float(smooth[peak])
    level = top - max(2.0 * noise, 0.05 * top)
    below = np.flatnonzero(smooth < level)
    if top < 0.5 or not below.size or not below[0] < peak < below[-1]:
        return None
    first, last = below[below < peak][-1], below[below > peak][0]
    step = float(np.diff(angles[first : last + 1]).max())
    if step > 10.0:
        return None
    rises = np.interp(level, smooth[first : first + 2], angles[first : first + 2])
    falls = np.interp(level, smooth[[last, last - 1]], angles[[last, last - 1]])
    middle = _middle(rises, falls)
    half = max(0.25 * float(falls - rises), step)
    low, center, high = map(_index, (middle - half, middle, middle + half))
    return IndexByEye(low, center, high, top)


def _index(angle: float) -> float:
    """Return the index whose Brewster angle this is, in degrees."""
    return math.tan(math.radians(min(max(angle, 0.0), 89.0)))


def _middle(rises: float, falls: float) -> float:
    """Return Brewster's angle of the mirror that polarizes equally at two angles, in degrees."""
    # Both reflect the same |cos(z + t) / cos(z - t)|, with t the angle of refraction: the product
    # of tan(z) tan(t) is 1, and Snell's law makes that a quadratic equation for n^2.
    a, b = np.sin(np.deg2rad([rises, falls])) ** 2
    square = 0.5 * (a + b + np.sqrt((a - b) ** 2 + 4.0 * (a * b) ** 2 / ((1.0 - a) * (1.0 - b))))
    return float(np.rad2deg(np.arctan(np.sqrt(square))))
