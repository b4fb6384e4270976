"""Scenes by name: the paper's, a polarization camera's, a goniometer's."""

from polar_bayes.errors import SceneError
from polar_bayes.physics.discrepancy import Discrepancy
from polar_bayes.physics.facets import FacetQuadrature
from polar_bayes.physics.illumination import PointSource
from polar_bayes.physics.instrument import (
    AngleZero,
    ChannelGain,
    DolpGain,
    Instrument,
    Leakage,
)
from polar_bayes.physics.microfacet import Beckmann
from polar_bayes.physics.mixing import DopMixing, StokesMixing
from polar_bayes.physics.scene import Scene
from polar_bayes.physics.subsurface import Depolarizer, Lambertian, Unpolarized
from polar_bayes.physics.surface import RoughSurface, SmoothSurface

# Twenty facets for the way out of the body: DoP within 0.0004 and brightness within 0.1 % of 400
# facets for every roughness up to 0.5 and zenith up to 85 degrees, at half the default's cost.
WAY_OUT = FacetQuadrature(along=5, across=4)

SCENES: dict[str, Scene] = {
    # Equation 1 as printed: unsigned degrees of polarization, one fraction for all views.
    "paper": Scene(
        surface=RoughSurface(Beckmann(), PointSource(), WAY_OUT),
        subsurface=Depolarizer(),
        mixing=DopMixing(),
    ),
    # A camera with a polarizer: Stokes vectors add; its extinction ratio is finite.
    "camera": Scene(
        surface=RoughSurface(Beckmann(), PointSource(), WAY_OUT),
        subsurface=Lambertian(),
        mixing=StokesMixing(),
        instrument=Instrument((DolpGain(),)),
    ),
    # A goniometer on a polished plate: the whole reflected beam is caught, s and p in turn.
    "goniometer": Scene(
        surface=SmoothSurface(),
        subsurface=Unpolarized(),
        mixing=StokesMixing(),
        # No DarkLevel: over angle it looks like the unpolarized body, which is there already.
        instrument=Instrument((AngleZero(), ChannelGain(), Leakage(), Discrepancy())),
    ),
}


def find_scene(scene: Scene | str) -> Scene:
    """A scene, or the scene of that name.

    Args:
        scene: A Scene, or a key of `SCENES`.

    Returns:
        The scene.

    Raises:
        SceneError: There is no scene of that name, or it is no scene at all.
    """
    if isinstance(scene, Scene):
        return scene
    if scene not in SCENES:
        raise SceneError(
            f"{scene!r} is no scene",
            where="scene",
            mend=f"give one of {', '.join(SCENES)}, or a Scene(...)",
        )
    return SCENES[scene]
