"""Scenes as compiled programs, directions and reference tables, which tests of physics share."""

import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from polar_bayes.physics.boundary import Diattenuation
from polar_bayes.physics.coat import ClearCoat, CoatStack, ThinFilm
from polar_bayes.physics.dispersion import Cauchy
from polar_bayes.physics.geometry import Geometry, cos_degrees, sin_degrees
from polar_bayes.physics.illumination import PointSource
from polar_bayes.physics.instrument import AngleZero, BeamOverlap, DolpGain, Instrument
from polar_bayes.physics.microfacet import GGX, AnisotropicSlopes, Beckmann
from polar_bayes.physics.mixing import StokesMixing
from polar_bayes.physics.scene import Scene
from polar_bayes.physics.stokes import LinearPolarization
from polar_bayes.physics.subsurface import Lambertian
from polar_bayes.physics.surface import RoughPassage, RoughSurface

REFERENCE = Path(__file__).parent / "reference"
DISTRIBUTIONS = {"Beckmann": Beckmann(), "GGX": GGX()}
BEAM = PointSource(LinearPolarization("light_degree", "light_angle"))
GROOVED = AnisotropicSlopes("roughness_azimuth")

EVERYTHING = Scene(
    RoughSurface(GGX(), BEAM, slopes=GROOVED, way_out=RoughPassage()),
    Lambertian("albedo"),
    StokesMixing(),
    CoatStack((ThinFilm(), ClearCoat())),
    Instrument((AngleZero(), BeamOverlap(), DolpGain())),
    Cauchy(),
)

stokes_of = jax.jit(Scene.stokes, static_argnums=0)
light_of = jax.jit(Scene.light, static_argnums=0)
predict = jax.jit(Scene.predict, static_argnums=0)


@functools.cache
def read(name: str) -> np.ndarray:
    """Columns of a reference table."""
    return np.loadtxt(REFERENCE / name, delimiter=",", skiprows=1).T


def directions(
    view_zenith, view_azimuth, light_zenith, light_azimuth=0.0, wavelength=None
) -> Geometry:
    """Views in degrees, broadcast to one shape."""
    return Geometry.from_degrees(
        view_zenith=view_zenith,
        view_azimuth=view_azimuth,
        light_zenith=light_zenith,
        light_azimuth=light_azimuth,
        wavelength=wavelength,
    )


def at(view: tuple[float, float], light: tuple[float, float]) -> Geometry:
    """One view in green light, from zenith and azimuth of viewer and light as they are."""
    return Geometry(*(jnp.array([x]) for x in (*view, *light)), wavelength=jnp.array([550.0]))


def between_points(count: int, seed: int) -> Geometry:
    """Directions at random, one in three in the plane of the mirror side, one in three grazing."""
    random = np.random.default_rng(seed)
    view, light = random.uniform(0.0, 88.0, (2, count))
    grazing = np.arange(count) % 3 == 0
    view = np.where(grazing, random.uniform(70.0, 88.0, count), view)
    turn = np.where(np.arange(count) % 3 == 1, 180.0, random.uniform(0.0, 360.0, count))
    return directions(view, 0.0, light, turn)


def mirrored_at(zenith: np.ndarray) -> Geometry:
    """A view from each zenith, (view, 1), with the light in the mirror direction."""
    view = jnp.asarray(zenith)[:, None]
    return Geometry(view, jnp.zeros_like(view), view, jnp.full_like(view, 180.0))


def components(degree: float, angle: float) -> tuple[float, float]:
    """q and u of light of a degree and an angle of polarization."""
    return degree * np.cos(np.deg2rad(2 * angle)), degree * np.sin(np.deg2rad(2 * angle))


def incidence(degrees: float | np.ndarray) -> tuple[jax.Array, jax.Array]:
    """Cosine and squared sine of an angle of incidence."""
    return cos_degrees(jnp.asarray(degrees)), sin_degrees(jnp.asarray(degrees)) ** 2


def one_by_one(power: Diattenuation) -> np.ndarray:
    """Factors on power along s, along p, and on the product of their fields."""
    difference = power.contrast * power.sin_squared
    return np.array([power.mean + difference, power.mean - difference, power.cross])
