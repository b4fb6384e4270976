"""What holds for every scene, whatever its parts: possible light, energy, symmetry, and limits."""

import dataclasses

import numpy as np
import pytest
from cases import each
from hypothesis import given, settings
from hypothesis import strategies as st
from optics import BEAM, GROOVED, between_points, predict, stokes_of
from optics import at as one_view
from optics import directions as directions_of

from polar_bayes.physics.coat import BackFace, ClearCoat, CoatStack, ThinFilm
from polar_bayes.physics.dispersion import Cauchy, Sellmeier
from polar_bayes.physics.facets import FacetQuadrature
from polar_bayes.physics.geometry import Geometry
from polar_bayes.physics.illumination import Disc, UniformSky
from polar_bayes.physics.instrument import (
    Analyzer,
    AngleZero,
    BeamOverlap,
    ChannelGain,
    DarkLevel,
    Discrepancy,
    DolpGain,
    Instrument,
    Leakage,
    Saturation,
)
from polar_bayes.physics.microfacet import (
    GGX,
    AnisotropicSlopes,
    Beckmann,
    HeightCorrelatedShadowing,
    IsotropicSlopes,
    NoShadowing,
    SeparableShadowing,
)
from polar_bayes.physics.mixing import DopMixing, StokesMixing
from polar_bayes.physics.phase_function import HenyeyGreenstein
from polar_bayes.physics.scene import Scene
from polar_bayes.physics.second_bounce import TwoBounceSurface
from polar_bayes.physics.second_passage import TwoFacetPassage
from polar_bayes.physics.subsurface import Depolarizer, Lambertian, TurbidMedium, Unpolarized
from polar_bayes.physics.surface import (
    InternalReflection,
    RoughPassage,
    RoughSurface,
    SmoothExit,
    SmoothSurface,
)

FEW = FacetQuadrature(2, 2)

GONIOMETER = (AngleZero(), ChannelGain(), Leakage(), Discrepancy())
CAMERA = (BeamOverlap(), DolpGain(), DarkLevel(), Saturation(0.2))

# Every part occurs, and every kind of light meets every kind of surface.
SCENES = {
    "grooves under a polarized beam, lacquered": Scene(
        RoughSurface(Beckmann(), BEAM, slopes=GROOVED, shadowing=HeightCorrelatedShadowing()),
        Lambertian("albedo", InternalReflection()),
        StokesMixing(),
        ClearCoat(),
        Instrument((AngleZero(), *CAMERA)),
    ),
    "grooves under a sky, with a film": Scene(
        RoughSurface(GGX(), UniformSky(), FEW, GROOVED, way_out=TwoFacetPassage()),
        Depolarizer(),
        DopMixing(signed=True),
        ThinFilm(),
    ),
    "a polished plate under films and coats": Scene(
        SmoothSurface(BEAM, BackFace(absorbance=0.1)),
        Unpolarized("albedo"),
        StokesMixing(),
        CoatStack((ThinFilm(), ClearCoat(), ThinFilm("second_index", "second_thickness"))),
        Instrument((*GONIOMETER, Analyzer(30.0), *CAMERA)),
    ),
    "a disc on a body of its own color": Scene(
        RoughSurface(Beckmann(), Disc(10.0), shadowing=HeightCorrelatedShadowing()),
        Depolarizer(None, HenyeyGreenstein("anisotropy")),
        DopMixing(),
        dispersion=Cauchy(),
    ),
    "nothing hidden, smooth way out": Scene(
        RoughSurface(GGX(), BEAM, slopes=GROOVED, shadowing=NoShadowing(), way_out=SmoothExit()),
        Lambertian("albedo"),
        StokesMixing(),
        CoatStack((ClearCoat(), ClearCoat("second_index", "second_absorbance"))),
        dispersion=Sellmeier(),
    ),
}
SURFACES = {name: Scene(scene.surface, coat=scene.coat) for name, scene in SCENES.items()}

every_scene = each("name", sorted(SCENES, key=lambda name: "under a sky" in name), quick=3)
RUN = settings(deadline=None, max_examples=40, derandomize=True)

VALUES = {
    "roughness": st.floats(0.0, 1.0),
    "roughness_across": st.floats(0.01, 1.0),
    "roughness_azimuth": st.floats(-180.0, 180.0),
    "subsurface_fraction": st.floats(0.0, 1.0),
    "absorption": st.floats(0.0, 10.0),
    "refractive_index": st.floats(1.0, 2.5),
    "albedo": st.floats(0.0, 1.0),
    "anisotropy": st.floats(0.0, 0.9),
    "coat_refractive_index": st.floats(1.0, 2.0),
    "coat_absorbance": st.floats(0.0, 5.0),
    "second_index": st.floats(1.0, 2.0),
    "second_absorbance": st.floats(0.0, 5.0),
    "film_refractive_index": st.floats(1.0, 2.5),
    "film_thickness": st.floats(0.0, 1000.0),
    "second_thickness": st.floats(0.0, 1000.0),
    "back_face_share": st.floats(0.0, 1.0),
    "cauchy_a": st.floats(1.0, 2.0),
    "cauchy_b": st.floats(0.0, 0.02),
    "sellmeier_strength": st.floats(0.0, 3.0),
    "sellmeier_resonance": st.floats(0.0, 0.03),
    "light_degree": st.floats(0.0, 1.0),
    "light_angle": st.floats(-180.0, 180.0),
    "angle_zero": st.floats(-1.0, 1.0),
    "beam_overlap_zenith": st.floats(60.0, 89.0),
    "dolp_gain": st.floats(0.0, 1.0),
    "dark_level": st.floats(0.0, 0.1),
    "channel_gain_ratio": st.floats(0.5, 2.0),
    "leakage": st.floats(0.0, 0.2),
    "discrepancy_amplitude": st.floats(0.0, 0.5),
}
parameters = st.fixed_dictionaries(VALUES).map(
    lambda values: values | {"discrepancy_weights": np.array([1.0, -0.5, 1.2])}
)
zenith = st.floats(0.0, 89.5)
azimuth = st.floats(-180.0, 180.0)
directions = st.tuples(zenith, azimuth, zenith, azimuth)


def at(direction: tuple, turn: float = 0.0) -> Geometry:
    view, va, light, la = direction
    return one_view((view, va + turn), (light, la + turn))


# --- light that can be ----------------------------------------------------------------------------


@every_scene
@given(values=parameters, direction=directions)
@RUN
def test_no_light_is_more_than_polarized_or_less_than_dark(name, values, direction) -> None:
    """S0 >= |S|, before the instrument."""
    s0, s1, s2 = np.asarray(stokes_of(SCENES[name], values, at(direction)))[0]
    assert s0 >= 0.0
    assert np.hypot(s1, s2) <= s0 * (1.0 + 1e-11) + 1e-300


@each("name", sorted(name for name, scene in SCENES.items() if scene.instrument), quick=1)
@given(values=parameters, direction=directions)
@RUN
def test_no_reading_is_more_than_polarized_or_less_than_dark(name, values, direction) -> None:
    """Behind an instrument with all its terms, and another."""
    readings = predict(SCENES[name], values, at(direction))
    assert readings["intensity"] >= 0.0
    assert 0.0 <= readings["dop"] <= 1.0 + 1e-9
    np.testing.assert_allclose(np.hypot(readings["q"], readings["u"]), readings["dop"], atol=2e-12)


# --- energy ---------------------------------------------------------------------------------------


def reflected_share(
    scene: Scene, values: dict, light: float, steps: int = 100, reach: float = 5.0
) -> float:
    """Directional-hemispherical reflectance, summed over the facets that mirror to each viewer.

    Steps in slope follow the highlight however narrow it is: dw_v = 4 (l.m) dw_m.
    """
    middle = (np.arange(steps) + 0.5) / steps
    if isinstance(scene.surface.distribution, GGX):
        radius, width = np.tan(0.5 * np.pi * middle), 0.5 * np.pi / steps
        width = width / np.cos(0.5 * np.pi * middle) ** 2
    else:
        radius, width = reach * middle, np.full(steps, reach / steps)
    turn = 2.0 * np.pi * middle
    scale = np.sqrt(values["roughness"] * values["roughness_across"])
    x = scale * np.outer(radius, np.cos(turn)).ravel()
    y = scale * np.outer(radius, np.sin(turn)).ravel()
    area = scale**2 * np.repeat(radius * width, steps) * 2.0 * np.pi / steps
    cos_tilt = 1.0 / np.sqrt(1.0 + x**2 + y**2)
    facet = np.stack([x, y, np.ones_like(x)], axis=-1) * cos_tilt[:, None]
    theta = np.deg2rad(light)
    towards = np.array([np.sin(theta), 0.0, np.cos(theta)])
    cosine = facet @ towards
    view = 2.0 * cosine[:, None] * facet - towards
    up = (view[:, 2] > 1e-9) & (cosine > 0.0)
    view = np.where(up[:, None], view, [0.0, 0.0, 1.0])
    sine = np.hypot(view[:, 0], view[:, 1])
    zenith, turn = np.arctan2(sine, view[:, 2]), np.arctan2(view[:, 1], view[:, 0])
    geometry = directions_of(np.rad2deg(zenith), np.rad2deg(turn), light)
    brightness = stokes_of(scene, values, geometry)[:, 0]
    solid_angle = 4.0 * cosine * cos_tilt**3 * area
    return float(np.sum(np.where(up, brightness * view[:, 2] * solid_angle, 0.0)) / towards[2])


MIRRORS = {
    "separable": (Beckmann(), SeparableShadowing()),
    "correlated": (Beckmann(), HeightCorrelatedShadowing()),
    "long tail, separable": (GGX(), SeparableShadowing()),
    "long tail, correlated": (GGX(), HeightCorrelatedShadowing()),
}


@each("name", MIRRORS, quick=2)
def test_a_surface_reflects_no_more_than_it_gets(name: str) -> None:
    """For every roughness, groove and angle, in s- and p-polarized light and in plain light.

    An index of 1,000 mirrors .996 of the light, so that a gain of 1 % would show; rougher surfaces
    lose what would hit a second facet.
    """
    distribution, shadowing = MIRRORS[name]
    scene = Scene(RoughSurface(distribution, BEAM, slopes=GROOVED, shadowing=shadowing))
    for along, across, turn in ((0.05, 0.05, 0.0), (0.4, 0.4, 0.0), (0.5, 0.1, 30.0), (1, 1, 0)):
        for light in (0.0, 60.0, 85.0):
            for degree, angle in ((0.0, 0.0), (1.0, 0.0), (1.0, 90.0)):
                values = {"roughness": along, "roughness_across": across, "roughness_azimuth": turn}
                values |= {"light_degree": degree, "light_angle": angle, "refractive_index": 1e3}
                share = reflected_share(scene, values, light)
                assert 0.0 < share <= 1.001
                if light == 0.0 and along == 0.05:
                    assert share > 0.98


@pytest.mark.thorough
@each("distribution", [Beckmann(), GGX()], ids=["Beckmann", "GGX"])
@each("coat", [None, ClearCoat(1.3, 0.2)], ids=["bare", "coated"])
@each("light", [0.0, 40.0, 70.0])
def test_a_nearly_smooth_surface_reflects_what_a_plane_does(distribution, coat, light) -> None:
    """To the square of the roughness; a long tail lets a part in 1,000 go elsewhere."""
    values = {"roughness": 0.003, "roughness_across": 0.003, "refractive_index": 1.5}
    rough = Scene(RoughSurface(distribution), coat=coat)
    mirror = at((light, 180.0, light, 0.0))
    plane = float(stokes_of(Scene(SmoothSurface(), coat=coat), values, mirror)[0, 0])
    bound = 2e-3 if isinstance(distribution, GGX) else 3e-4
    assert reflected_share(rough, values, light) == pytest.approx(plane, rel=bound)


# --- symmetry -------------------------------------------------------------------------------------


def states(scene: Scene, values: dict, direction: tuple) -> np.ndarray:
    """Mueller matrix (3 x 3) from three incident states."""
    none, s, diagonal = (
        np.asarray(
            stokes_of(scene, values | {"light_degree": degree, "light_angle": angle}, at(direction))
        )[0]
        for degree, angle in ((0.0, 0.0), (1.0, 0.0), (1.0, 45.0))
    )
    return np.stack([none, s - none, diagonal - none], axis=1)


@each("name", [name for name, scene in SCENES.items() if "light_degree" in scene.parameters])
@given(values=parameters, direction=directions)
@RUN
def test_viewer_and_light_may_change_places(name: str, values: dict, direction: tuple) -> None:
    """Helmholtz, for plates with their backs and grooves under coats, in polarized light."""
    view, va, light, la = direction
    values = values | {"roughness": max(values["roughness"], 0.02)}
    scene = SURFACES[name]
    forth, back = states(scene, values, direction), states(scene, values, (light, la, view, va))
    if isinstance(scene.surface, RoughSurface):  # radiance of an area, over the cosine
        forth, back = forth * np.cos(np.deg2rad(view)), back * np.cos(np.deg2rad(light))
    np.testing.assert_allclose(back, forth.T, atol=1e-9 * forth[0, 0] + 1e-28)


GLOSSY = {"roughness": 0.2, "roughness_across": 0.5, "refractive_index": 1.5}
STEEP = {"roughness": 0.05, "roughness_across": 0.8, "refractive_index": 1.45}
STEEP |= {"subsurface_fraction": 1.0, "absorption": 3.0}
# Grooves polarize what leaves along an axis of their own, and pass more of what agrees.
GROOVES = RoughSurface(slopes=AnisotropicSlopes(20.0), way_out=RoughPassage())
BOTH_WAYS = [
    (Scene(GROOVES, TurbidMedium(1.0), StokesMixing()), STEEP, 1e-12),
    *(
        (Scene(TwoBounceSurface(GGX(), shadowing=shadowing, slopes=slopes)), GLOSSY, 1e-9)
        for shadowing in (HeightCorrelatedShadowing(), SeparableShadowing())
        for slopes in (AnisotropicSlopes(35.0), IsotropicSlopes())
    ),
]


@each(("scene", "values", "bound"), BOTH_WAYS, quick=2)
def test_as_much_light_goes_back_as_came(scene: Scene, values: dict, bound: float) -> None:
    """Over the cosine of where it goes: at random, in the plane of the mirror side, and grazing."""
    there = between_points(12, 3)
    forth, back = (stokes_of(scene, values, each)[:, 0] for each in (there, there.reversed()))
    cosines = np.cos(np.deg2rad([there.view_zenith, there.light_zenith]))
    np.testing.assert_allclose(forth * cosines[0], back * cosines[1], rtol=bound)


def no_mirror(values: dict) -> dict:
    """The material with a highlight that is not narrow."""
    rough = {key: max(values[key], 0.05) for key in ("roughness", "roughness_across")}
    return values | rough


@every_scene
@given(values=parameters, direction=directions, turn=st.floats(-360.0, 360.0))
@settings(parent=RUN, max_examples=30)
def test_turning_sample_viewer_and_light_together_changes_nothing(name, values, direction, turn):
    """What it leaves of a narrow highlight's brightness is rounding of azimuths, over its width."""
    values = no_mirror(values)
    turned = values | {"roughness_azimuth": values["roughness_azimuth"] + turn}
    here = stokes_of(SCENES[name], values, at(direction))
    there = stokes_of(SCENES[name], turned, at(direction, turn))
    np.testing.assert_allclose(there, here, rtol=1e-8, atol=1e-8 * float(here[0, 0]) + 1e-28)


@every_scene
@given(values=parameters, direction=directions)
@settings(parent=RUN, max_examples=30)
def test_a_mirror_image_has_the_other_sign_of_u(name: str, values: dict, direction: tuple) -> None:
    view, va, light, la = direction
    values = no_mirror(values)
    image = values | {key: -values[key] for key in ("roughness_azimuth", "light_angle")}
    here = np.asarray(stokes_of(SCENES[name], values, at(direction)))
    there = np.asarray(stokes_of(SCENES[name], image, at((view, -va, light, -la))))
    flipped = there * np.array([1.0, 1.0, -1.0])
    np.testing.assert_allclose(flipped, here, rtol=1e-9, atol=1e-9 * here[0, 0] + 1e-28)


# --- limits ---------------------------------------------------------------------------------------


@pytest.mark.thorough
@each("distribution", [Beckmann(), GGX()], ids=["Beckmann", "GGX"])
@each("coat", [None, ThinFilm(1.38, 120.0)], ids=["bare", "filmed"])
def test_a_smooth_surface_under_a_sky_obeys_fresnel(distribution, coat) -> None:
    """As roughness goes to zero, grooves or not; the nodes of Beckmann's slopes lack 1.6e-4."""
    scene = Scene(RoughSurface(distribution, UniformSky(), slopes=GROOVED), coat=coat)
    zeniths = np.array([1.0, 30.0, 56.0, 75.0])
    views = directions_of(zeniths, 0.0, zeniths, 180.0, [550.0])
    values = {"roughness": 1e-4, "roughness_across": 1e-5, "roughness_azimuth": 30.0}
    values["refractive_index"] = 1.5
    found = stokes_of(scene, values, views)
    mirror = stokes_of(Scene(SmoothSurface(), coat=coat), values, views)
    bound = 2e-5 if isinstance(distribution, GGX) else 2e-4
    np.testing.assert_allclose(found, mirror, rtol=bound, atol=bound * 1e-2)


@pytest.mark.thorough
@each("name", list(SCENES)[1:3])
@given(values=parameters, direction=directions)
@settings(parent=RUN, max_examples=20)
def test_a_coat_of_zero_effect_is_no_coat(name: str, values: dict, direction: tuple) -> None:
    """Films of no thickness, coats like air: on grooves under a sky, on a plate, over bodies."""
    scene = dataclasses.replace(SCENES[name], instrument=None, dispersion=None)
    values = no_mirror(values) | {"refractive_index": max(values["refractive_index"], 1.01)}
    bare = stokes_of(dataclasses.replace(scene, coat=None), values, at(direction))
    nothing = CoatStack((ThinFilm("film_refractive_index", 0.0), ClearCoat(1.0, 0.0)))
    found = stokes_of(dataclasses.replace(scene, coat=nothing), values, at(direction))
    np.testing.assert_allclose(found, bare, rtol=1e-8, atol=1e-9 * float(bare[0, 0]) + 1e-28)
