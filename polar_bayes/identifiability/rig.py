"""Which views a rig can take, and which of them together."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from polar_bayes.errors import FitError

Directions = Float[np.ndarray, "view 4"]
"""View zenith and azimuth, light zenith and azimuth, in degree."""


@dataclasses.dataclass(frozen=True)
class Rig:
    """The limits of a set-up.

    Args:
        view_zenith: Least and largest, unit degree, range [0, 90].
        light_zenith: The same for the light.
        from_light: Smallest angle between viewer and light, which would hide each other. Unit
            degree.
        minimum_separation: Smallest angle between two views under one light: between two new ones
            and, unless repeatable, between a new one and one that was measured. Unit degree.
        repeatable: True where a view may be taken again: one that was measured, or a new one
            more than once.

    Raises:
        FitError: A limit is outside of its range.
    """

    view_zenith: tuple[float, float] = (0.0, 90.0)
    light_zenith: tuple[float, float] = (0.0, 90.0)
    from_light: float = 0.0
    minimum_separation: float = 0.0
    repeatable: bool = False

    def __post_init__(self) -> None:
        for name in ("view_zenith", "light_zenith"):
            low, high = getattr(self, name)
            if not 0.0 <= low <= high <= 90.0:
                raise FitError(
                    f"{name} is ({low:g}, {high:g})",
                    where="Rig",
                    mend="give two rising angles from 0 to 90 degrees",
                )
        for name in ("from_light", "minimum_separation"):
            if not 0.0 <= getattr(self, name) <= 180.0:
                raise FitError(
                    f"{name} is {getattr(self, name):g}",
                    where="Rig",
                    mend="give degrees from 0 to 180",
                )

    def allows(self, candidates: Directions, measured: Directions) -> Bool[np.ndarray, " view"]:
        """Which candidates can be taken at all.

        Args:
            candidates: Directions, (view, 4), degree.
            measured: Of the views that are there already.

        Returns:
            True where the limits hold.

        Raises:
            Nothing.
        """
        allowed = np.ones(len(candidates), bool)
        for column, (low, high) in ((0, self.view_zenith), (2, self.light_zenith)):
            allowed &= (candidates[:, column] >= low) & (candidates[:, column] <= high)
        viewer, light = candidates[:, :2], candidates[:, 2:]
        allowed &= _angle(viewer, light) >= self.from_light
        if not self.repeatable and len(measured):
            allowed &= ~self._too_near(candidates, measured).any(axis=1)
        return allowed

    def clashes(self, candidates: Directions) -> Bool[np.ndarray, "view view"]:
        """Which pairs cannot be taken both; a view with itself, where it cannot be repeated.

        Args:
            candidates: Directions, (view, 4), degree.

        Returns:
            Symmetric; True where one excludes the other.

        Raises:
            Nothing.
        """
        near = self._too_near(candidates, candidates)
        if self.repeatable:
            near &= _distance(candidates, candidates) > SAME
        return near

    def _too_near(self, some: Directions, others: Directions) -> Bool[np.ndarray, "some other"]:
        return _distance(some, others) < max(self.minimum_separation, SAME)


SAME = 1e-4
"""Directions within so many degrees are one."""


def _distance(some: Directions, others: Directions) -> Float[np.ndarray, "some other"]:
    """The larger of the angles between two viewers and between two lights."""
    return np.maximum(
        _angle(some[:, None, :2], others[None, :, :2]),
        _angle(some[:, None, 2:], others[None, :, 2:]),
    )


def _angle(some: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Degrees between directions (zenith, azimuth)."""
    first, second = (
        np.stack(
            [np.sin(z) * np.cos(a), np.sin(z) * np.sin(a), np.cos(z) * np.ones_like(a)], axis=-1
        )
        for z, a in (np.moveaxis(np.radians(x), -1, 0) for x in (some, others))
    )
    half = 0.5 * np.linalg.norm(first - second, axis=-1)  # an arc cosine loses small angles
    return np.degrees(2.0 * np.arcsin(np.minimum(half, 1.0)))
