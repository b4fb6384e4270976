"""Scenes by name, as they are used and with every effect on that such a set-up may have."""

from polar_bayes.physics.discrepancy import Discrepancy
from polar_bayes.physics.facets import FacetQuadrature
from polar_bayes.physics.illumination import PointSource
from polar_bayes.physics.instrument import (
    AngleZero,
    BeamOverlap,
    ChannelGain,
    DarkLevel,
    DolpGain,
    Instrument,
    Leakage,
)
from polar_bayes.physics.internal_reflection import InternalReflection
from polar_bayes.physics.microfacet import Beckmann
from polar_bayes.physics.mixing import DopMixing, StokesMixing
from polar_bayes.physics.scene import Scene
from polar_bayes.physics.shadowing import HeightCorrelatedShadowing
from polar_bayes.physics.subsurface import Depolarizer, Lambertian, Unpolarized
from polar_bayes.physics.surface import RoughSurface, SmoothSurface

# Twenty facets for the way out of the body: DoP within 0.0005 and brightness within 0.15 % of 400
# facets for every roughness up to 0.5 and zenith up to 85 degrees (tests/physics/test_scenes.py).
WAY_OUT = FacetQuadrature(along=5, across=4)

# Eighty facets, where the number of facets itself is to be judged.
MANY_FACETS = FacetQuadrature(along=10, across=8)

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
    # One picture, read without its brightness: how rough the surface is cannot be told apart from
    # how much of its light falls towards the camera, so that a smooth one stands for any.
    "picture": Scene(surface=SmoothSurface(), subsurface=Lambertian(), mixing=StokesMixing()),
    # A goniometer on a polished plate: the whole reflected beam is caught, s and p in turn.
    "goniometer": Scene(
        surface=SmoothSurface(),
        subsurface=Unpolarized(),
        mixing=StokesMixing(),
        # No DarkLevel: over angle it looks like the unpolarized body, which is there already.
        instrument=Instrument((AngleZero(), ChannelGain(), Leakage(), Discrepancy())),
    ),
}

FULL_SCENES: dict[str, Scene] = {
    "paper": Scene(
        surface=RoughSurface(
            Beckmann(), PointSource(), MANY_FACETS, shadowing=HeightCorrelatedShadowing()
        ),
        subsurface=Depolarizer(),
        mixing=DopMixing(),
        instrument=Instrument((AngleZero(), DarkLevel())),
    ),
    "camera": Scene(
        surface=RoughSurface(
            Beckmann(), PointSource(), MANY_FACETS, shadowing=HeightCorrelatedShadowing()
        ),
        subsurface=Lambertian(internal_reflection=InternalReflection()),
        mixing=StokesMixing(),
        instrument=Instrument((AngleZero(), DolpGain(), DarkLevel())),
    ),
    "picture": Scene(
        surface=SmoothSurface(),
        subsurface=Lambertian(internal_reflection=InternalReflection()),
        mixing=StokesMixing(),
        instrument=Instrument((DolpGain(),)),
    ),
    "goniometer": Scene(
        surface=SmoothSurface(),
        subsurface=Unpolarized(),
        mixing=StokesMixing(),
        instrument=Instrument(
            (AngleZero(), BeamOverlap(), ChannelGain(), Leakage(), Discrepancy())
        ),
    ),
}
"""The same set-ups with everything on: where `polar_bayes.choose_effects` starts."""
