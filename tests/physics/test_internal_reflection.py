"""Light that the interface turns back: a series of round trips, and what conserves it."""

import jax.numpy as jnp
import numpy as np
from cases import each

from polar_bayes.physics.coat import ClearCoat
from polar_bayes.physics.geometry import Geometry
from polar_bayes.physics.mixing import StokesMixing
from polar_bayes.physics.scene import Scene
from polar_bayes.physics.stack import Stack
from polar_bayes.physics.subsurface import (
    Depolarizer,
    Lambertian,
    half_space_loss,
)
from polar_bayes.physics.surface import Interface, InternalReflection, SmoothSurface

VIEWS = Geometry.from_degrees(
    view_zenith=[0.0, 40.0, 80.0], view_azimuth=180.0, light_zenith=30.0, light_azimuth=0.0
)
MATERIAL = {"refractive_index": jnp.array([1.5]), "absorption": jnp.array([0.3])}
INTERFACE = Interface(SmoothSurface(), Stack(MATERIAL["refractive_index"]))


@each("coat", [None, ClearCoat(1.3, 0.0), ClearCoat(1.9, 0.0)], ids=str)
def test_a_white_body_returns_all_that_enters(coat: ClearCoat | None) -> None:
    """Reflected and returned light together are the light, whatever clear coat there is.

    The body's light is alike in all directions inside, so that its share is T+(l).
    """
    node, weight = np.polynomial.legendre.leggauss(120)
    cosine = (0.5 * (node + 1.0)) ** 2
    measure = 2.0 * np.pi * cosine * 0.5 * (node + 1.0) * weight
    geometry = Geometry.from_degrees(
        view_zenith=np.rad2deg(np.arccos(cosine)),
        view_azimuth=180.0,
        light_zenith=65.0,
        light_azimuth=0.0,
    )
    white = Lambertian(1.0, InternalReflection())
    scene = Scene(SmoothSurface(), white, StokesMixing(), coat=coat)
    below = scene.light({"refractive_index": 1.5, "subsurface_fraction": 1.0}, geometry)
    returned = np.sum(below.intensity * measure) / np.cos(np.deg2rad(65.0))
    mirror = geometry._replace(view_zenith=jnp.full_like(geometry.view_zenith, 65.0))
    above = Scene(SmoothSurface(), coat=coat).light({"refractive_index": 1.5}, mirror)
    np.testing.assert_allclose(returned + above.intensity[0], 1.0, atol=1e-8)


def test_without_it_a_depolarizer_keeps_what_a_half_space_loses() -> None:
    lost = half_space_loss(MATERIAL["absorption"])
    leaving = INTERFACE.exit(MATERIAL, VIEWS)
    once = Depolarizer(internal_reflection=None).light(MATERIAL, VIEWS, INTERFACE)
    all_trips = Depolarizer().light(MATERIAL, VIEWS, INTERFACE)
    np.testing.assert_allclose(once.q, lost * leaving.q, rtol=1e-14)
    # Light that is turned back is scattered again: brighter and less polarized.
    assert np.all(all_trips.intensity > once.intensity)
