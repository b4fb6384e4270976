r"""Opto-electronic transfer functions: the relation between light and counts of a picture.

A sensor counts in proportion to light; a picture made to be looked at has a tone curve. With V the
count over the white count, light is

$$ L = V^G \;\text{(gamma G)}, \qquad
   L = \begin{cases} V/12.92 & V \le 0.04045 \\ ((V + 0.055)/1.055)^{2.4} & V > 0.04045
   \end{cases} \;\text{(sRGB)} $$

on a scale on which white keeps its count. Counts below zero, which averaged dark frames may hold,
are those of the same light below zero.

PNG states a curve by its chunks sRGB, gAMA (1/G) or iCCP, TIFF by an ICC profile or the tag
TransferFunction, EXIF by ColorSpace, its interoperability index or Gamma; a JPEG has one even where
it states none. Pillow applies none of them, does not see the chunk cICP, and a file that Pillow
writes again lacks sRGB, gAMA and EXIF, so a file that states no curve may have one.
`polar_bayes.importers.linearity` tests it.

Source:
    IEC 61966-2-1:1999 (sRGB); W3C, Portable Network Graphics (PNG) Specification, section 11.3.2.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from PIL import Image

from polar_bayes.capture.schema import Interval
from polar_bayes.errors import CaptureError

UNDONE_UNCERTAINTY = 0.05
"""Relative standard uncertainty of the gamma of frames whose curve is undone by its name, a
judgment: the curves of cameras differ from the standard of their files (Grossberg & Nayar 2004,
IEEE TPAMI 26, 1272)."""


class Transfer(NamedTuple):
    """The correction of one tone curve.

    Args:
        description: What is done, as an attribute of the capture.
        gamma: Exponent of the counts, for sRGB that of the nearest power.
        linear: Counts in proportion to light, of counts and the white count.
    """

    description: str
    gamma: float
    linear: Callable[[np.ndarray, float], np.ndarray]

    @property
    def metadata(self) -> dict[str, str | float]:
        """Attributes of a capture; the uncertainty of a sensor without a curve is the set-up's."""
        known = {"tone_curve_uncertainty": UNDONE_UNCERTAINTY} if self.gamma != 1.0 else {}
        return {"transfer": self.description, "transfer_gamma": self.gamma, **known}


def _srgb(counts: np.ndarray, white: float) -> np.ndarray:
    value = np.abs(counts) / white
    light = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return np.sign(counts) * white * light


def as_transfer(transfer: object) -> Transfer:
    """Return the transfer function of a name or a gamma.

    Args:
        transfer: `"srgb"`, `"linear"`, a gamma from 0.2 to 5, also as text, or None: not stated,
            and taken to be linear.

    Raises:
        CaptureError: It is none of these.
    """
    if transfer is None or transfer == "linear":
        description = "linear, as stated" if transfer else "linear, as assumed"
        return Transfer(description, 1.0, lambda counts, white: counts)
    if transfer == "srgb":
        return Transfer("sRGB (IEC 61966-2-1), undone", 2.2, _srgb)
    try:
        gamma = Interval(0.2, 5.0).check(float(str(transfer)), "transfer")
    except ValueError as error:
        hint = "give srgb, linear or a gamma from 0.2 to 5"
        raise CaptureError(f"it is {transfer!r}", where="transfer", hint=hint) from error
    return Transfer(
        f"gamma {gamma:g}, undone",
        gamma,
        lambda counts, white: np.sign(counts) * white * (np.abs(counts) / white) ** gamma,
    )


def stated_curve(image: Image.Image) -> str:
    """Return the tone curve that an image states; empty if none."""
    info, exif = image.info, image.getexif()
    more = exif.get_ifd(0x8769)
    gamma, exponent = info.get("gamma", 1.0), float(more.get(0xA500, 1.0))  # 1 is linear
    color_space = more.get(0xA001, exif.get(0xA001))
    found = {
        "sRGB": "srgb" in info,
        f"gAMA {gamma:g}": abs(gamma - 1.0) > 1e-3,
        f"EXIF Gamma {exponent:g}": abs(exponent - 1.0) > 1e-3,
        "ICC profile": "icc_profile" in info,
        "TransferFunction": 0x012D in exif,
        "EXIF ColorSpace sRGB": color_space == 1,
        "EXIF ColorSpace Adobe RGB": color_space == 2 or exif.get_ifd(0xA005).get(1) == "R03",
        "JPEG": image.format in ("JPEG", "MPO"),
    }
    return ", ".join(name for name, is_stated in found.items() if is_stated)
