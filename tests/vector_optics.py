"""Layers and facets once more, from complex fields and explicit vectors: an independent twin.

Rays point away from the surface. The axes of a ray are s = (z x ray)/|z x ray| and ray x s. Fields
along them have Stokes components q > 0 (along s) and u > 0 (half-way between the two).
"""

import itertools

import numpy as np

Powers = tuple[complex, complex, complex]
"""Power s, power p, and what the product of both fields is multiplied by."""


def ray(zenith: float, azimuth: float) -> np.ndarray:
    """Unit vector, from degrees."""
    theta, phi = np.deg2rad([zenith, azimuth])
    return np.array([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])


def angles(vector: np.ndarray) -> tuple[float, float]:
    """Zenith and azimuth of a vector, in degrees."""
    x, y, z = vector
    return float(np.rad2deg(np.arctan2(np.hypot(x, y), z))), float(np.rad2deg(np.arctan2(y, x)))


def axes(zenith: float, azimuth: float) -> np.ndarray:
    """Both axes of a ray, as rows; on the normal they are the limit along the azimuth."""
    phi = np.deg2rad(azimuth)
    s = np.array([-np.sin(phi), np.cos(phi), 0.0])
    return np.array([s, np.cross(ray(zenith, azimuth), s)])


def coherency(q: float, u: float) -> np.ndarray:
    """Matrix of mean field products, of unit power."""
    return 0.5 * np.array([[1.0 + q, u], [u, 1.0 - q]])


def stokes(matrix: np.ndarray) -> np.ndarray:
    """S0, S1, S2 of a coherency matrix."""
    first, second = matrix[0, 0].real, matrix[1, 1].real
    return np.array([first + second, first - second, 2.0 * matrix[0, 1].real])


def facet_of(view: tuple[float, float], light: tuple[float, float]) -> tuple[float, np.ndarray]:
    """Squared sine of incidence on the facet that mirrors light to viewer, and its s axis."""
    towards, from_ = ray(*view), ray(*light)
    half = towards + from_
    half /= np.linalg.norm(half)
    across = np.cross(half, from_)
    length = np.linalg.norm(across)
    # Where viewer and light coincide, any axis serves.
    return length**2, across / length if length > 1e-14 else axes(*light)[0]


def mirrored(powers, view, light, incident=(0.0, 0.0)):
    """Stokes vector that a facet sends to the viewer, per unit power that falls on it."""
    s, p, cross = powers
    _, axis = facet_of(view, light)
    arriving = np.array([axis, np.cross(ray(*light), axis)]) @ axes(*light).T
    leaving = axes(*view) @ np.array([axis, np.cross(ray(*view), axis)]).T
    matrix = arriving @ coherency(*incident) @ arriving.T
    matrix = matrix * np.array([[s, cross], [np.conj(cross), p]])
    return stokes(leaving @ matrix @ leaving.T)


def cosine(index: complex, sin_squared: float) -> complex:
    """Cosine of the angle in a medium; sin_squared is in air."""
    return np.sqrt(1.0 - sin_squared / complex(index) ** 2)


def admittances(index: complex, sin_squared: float) -> np.ndarray:
    """Tangential magnetic field over electric field, for s and p."""
    inside = cosine(index, sin_squared)
    return np.array([index * inside, index / inside])


def films(above, layers, below, sin_squared):
    """Fields reflected and passed, and power passed, for s and p, by characteristic matrices.

    `layers` are (index, 2 pi thickness/wavelength) from the top down; none for a bare boundary.
    """
    first, last = admittances(above, sin_squared), admittances(below, sin_squared)
    electric, magnetic = np.ones_like(last), last
    for index, wavenumber in reversed(layers):
        y = admittances(index, sin_squared)
        delta = wavenumber * index * cosine(index, sin_squared)
        electric, magnetic = (
            np.cos(delta) * electric - 1j * np.sin(delta) / y * magnetic,
            np.cos(delta) * magnetic - 1j * np.sin(delta) * y * electric,
        )
    total = first * electric + magnetic
    passed = 2.0 * first / total
    power = np.where(first.real > 0.0, last.real / np.where(first.real > 0.0, first.real, 1.0), 0.0)
    return (first * electric - magnetic) / total, passed, power * np.abs(passed) ** 2


def powers(fields: np.ndarray) -> Powers:
    """Powers of reflected fields."""
    return abs(fields[0]) ** 2, abs(fields[1]) ** 2, fields[0] * np.conj(fields[1])


def bare(index: float, sin_squared: float) -> Powers:
    """Powers that a bare body reflects."""
    return powers(films(1.0, (), index, sin_squared)[0])


def bounced(indexes, absorbances, sin_squared, bounces=4000):
    """Reflectance and transmittance (s, p, cross) of thick layers, by following every bounce.

    `indexes` run from air to body, `absorbances` over the layers between.
    """
    # Between two media: from above and from below, for s, p and the product of their fields.
    reflected, back, passed = [], [], []
    for above, below in itertools.pairwise(indexes):
        there, _, through = films(above, (), below, sin_squared)
        again, _, _ = films(below, (), above, sin_squared)
        cross = np.sqrt(through[0] * through[1])
        reflected.append(np.real([*np.abs(there) ** 2, there[0] * np.conj(there[1])]))
        back.append(np.real([*np.abs(again) ** 2, again[0] * np.conj(again[1])]))
        passed.append(np.real([*through, cross]))
    kept = [
        np.exp(-absorbance / cosine(index, sin_squared).real)
        for index, absorbance in zip(indexes[1:-1], absorbances, strict=True)
    ]
    count = len(kept)
    # Light in each layer just under its upper boundary going down, and just above its lower
    # boundary going up.
    down, up = np.zeros((count, 3)), np.zeros((count, 3))
    down[0] = passed[0]
    out, into = reflected[0].copy(), np.zeros(3)
    for _ in range(bounces):
        next_down, next_up = np.zeros_like(down), np.zeros_like(up)
        for i in range(count):
            at_bottom, at_top = down[i] * kept[i], up[i] * kept[i]
            next_up[i] += at_bottom * reflected[i + 1]
            next_down[i] += at_top * back[i]
            if i + 1 < count:
                next_down[i + 1] += at_bottom * passed[i + 1]
            else:
                into += at_bottom * passed[i + 1]
            if i > 0:
                next_up[i - 1] += at_top * passed[i]
            else:
                out += at_top * passed[0]
        down, up = next_down, next_up
    return out, into


class Population:
    """All facets of a surface on a dense grid of slopes, with their shares.

    Args:
        kind: "Beckmann" or "GGX".
        along: Roughness along the azimuth.
        across: Roughness at right angles to it.
        azimuth: Degrees.
        steps: Grid points in radius and in azimuth.
    """

    def __init__(
        self, kind: str, along: float, across: float, azimuth: float = 0.0, steps: int = 700
    ) -> None:
        self.kind, self.along, self.across, self.azimuth = kind, along, across, azimuth
        middle = (np.arange(steps) + 0.5) / steps
        if kind == "Beckmann":
            radius = 6.0 * middle
            share = 2.0 * radius * np.exp(-(radius**2)) * 6.0 / steps
        else:
            angle = 0.5 * np.pi * middle
            radius = np.tan(angle)
            share = np.sin(2.0 * angle) * 0.5 * np.pi / steps
        turn = 2.0 * np.pi * middle
        first = along * np.outer(radius, np.cos(turn))
        second = across * np.outer(radius, np.sin(turn))
        phi = np.deg2rad(azimuth)
        slopes = np.stack(
            [
                first * np.cos(phi) - second * np.sin(phi),
                first * np.sin(phi) + second * np.cos(phi),
                np.ones_like(first),
            ],
            axis=-1,
        ).reshape(-1, 3)
        self.normal = slopes / np.linalg.norm(slopes, axis=-1, keepdims=True)
        self.share = np.repeat(share / steps, steps)

    def visible(self, rays: np.ndarray) -> np.ndarray:
        """Smith's G1 of directions (..., 3) above the surface."""
        turn = np.arctan2(rays[..., 1], rays[..., 0]) - np.deg2rad(self.azimuth)
        roughness = np.hypot(self.along * np.cos(turn), self.across * np.sin(turn))
        height = np.maximum(rays[..., 2], 1e-12)
        steepness = roughness * np.hypot(rays[..., 0], rays[..., 1]) / height
        if self.kind == "GGX":
            return 2.0 / (1.0 + np.sqrt(1.0 + steepness**2))
        a = 1.0 / np.maximum(steepness, 1e-12)
        fit = (3.535 * a + 2.181 * a**2) / (1.0 + 2.276 * a + 2.577 * a**2)
        return np.where(a < 1.6, fit, 1.0)

    def density(self, rays: np.ndarray) -> np.ndarray:
        """Facet area per steradian around normals (..., 3)."""
        phi = np.deg2rad(self.azimuth)
        x, y = rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]
        first = (x * np.cos(phi) + y * np.sin(phi)) / self.along
        second = (y * np.cos(phi) - x * np.sin(phi)) / self.across
        square = first**2 + second**2
        bell = np.exp(-square) if self.kind == "Beckmann" else (1.0 + square) ** -2.0
        return bell / (np.pi * self.along * self.across * rays[..., 2] ** 4)

    def _seen(self, zenith: float, azimuth: float, index: float) -> tuple:
        """Per facet: area shown, light mirrored to the viewer, powers, and both turns of axes."""
        towards, (s, second) = ray(zenith, azimuth), axes(zenith, azimuth)
        cosine_ = self.normal @ towards
        shown = self.share * np.maximum(cosine_, 0.0) / self.normal[:, 2]
        light = 2.0 * cosine_[:, None] * self.normal - towards
        b = 1.0 - cosine_**2
        r_s, r_p, _ = bare(index, b)
        axis = np.cross(self.normal, towards)
        axis /= np.maximum(np.linalg.norm(axis, axis=-1, keepdims=True), 1e-300)
        first, other = axis @ s, axis @ second
        return shown, light, r_s, r_p, first**2 - other**2, 2.0 * first * other

    def sky(self, zenith, azimuth, index, *, correlated=False):
        """Stokes vector under a sky of unit radiance."""
        shown, light, r_s, r_p, cos, sin = self._seen(zenith, azimuth, index)
        above = light[:, 2] > 0.0
        first = self.visible(ray(zenith, azimuth))
        second = self.visible(light)
        both = first * second
        if correlated:
            both = both / (first + second - both)
        weight = np.where(above, shown * both, 0.0) / ray(zenith, azimuth)[2]
        difference = 0.5 * weight * (r_s - r_p)
        mean = 0.5 * weight * (r_s + r_p)
        return np.array([mean.sum(), (difference * cos).sum(), (difference * sin).sum()])

    def way_out(self, zenith: float, azimuth: float, index: float) -> np.ndarray:
        """Stokes vector of light from below, per unit radiance of the transmitted light."""
        shown, _, r_s, r_p, cos, sin = self._seen(zenith, azimuth, index)
        difference = 0.5 * shown * (r_p - r_s)
        mean = shown * (1.0 - 0.5 * (r_s + r_p))
        total = [mean.sum(), (difference * cos).sum(), (difference * sin).sum()]
        return np.array(total) / shown.sum()
