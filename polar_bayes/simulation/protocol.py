"""Where to look from: the paper's protocol of about 40 views."""

import dataclasses

import numpy as np

from polar_bayes.errors import CaptureError


@dataclasses.dataclass(frozen=True)
class Protocol:
    """Views on rings of azimuth, with the light fixed.

    Args:
        views: How many, at least 2.
        largest_view_zenith: Unit degree, range (0, 90).
        azimuths: View azimuths; 180 is the mirror side of a light at azimuth 0. Unit degree.
        light_zenith: Unit degree, range [0, 90).
        wavelengths: Unit nm; empty for a capture without color.

    Raises:
        CaptureError: A value is outside its range.
    """

    views: int = 40
    largest_view_zenith: float = 85.0
    azimuths: tuple[float, ...] = (180.0, 150.0, 120.0, 60.0)
    light_zenith: float = 45.0
    wavelengths: tuple[float, ...] = (450.0, 550.0, 650.0)

    def __post_init__(self) -> None:
        checks = {
            "views": (
                isinstance(self.views, int) and 2 <= self.views <= 100_000,
                "give a whole number from 2 to 100000",
            ),
            "largest_view_zenith": (
                0.0 < self.largest_view_zenith < 90.0,
                "give degrees above 0 and below 90",
            ),
            "light_zenith": (0.0 <= self.light_zenith < 90.0, "give degrees from 0 to below 90"),
            "azimuths": (
                len(self.azimuths) > 0 and all(abs(a) <= 360.0 for a in self.azimuths),
                "give at least one, each from -360 to 360 degrees",
            ),
            "wavelengths": (
                all(0.0 < w < 1e6 for w in self.wavelengths),
                "give nanometers above zero",
            ),
        }
        for name, (holds, mend) in checks.items():
            if not holds:
                raise CaptureError(f"{name} is {getattr(self, name)}", where="Protocol", mend=mend)

    def angles(self) -> dict[str, np.ndarray]:
        """Directions of every view.

        Returns:
            view_zenith, view_azimuth, light_zenith and light_azimuth, each (view,), in degree.
            The zeniths step evenly from near the normal to the largest, the azimuths in turn, so
            that every azimuth sees the whole range.
        """
        steps = np.arange(1, self.views + 1) / self.views
        azimuths = np.resize(np.asarray(self.azimuths, float), self.views)
        return {
            "view_zenith": steps * self.largest_view_zenith,
            "view_azimuth": azimuths,
            "light_zenith": np.full(self.views, self.light_zenith),
            "light_azimuth": np.zeros(self.views),
        }
