"""A leaning normal: against light and viewer rotated the other way, with explicit vectors."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vector_optics as twin
from cases import each
from hypothesis import example, given, settings
from hypothesis import strategies as st
from optics import BEAM, at, components, directions, predict, stokes_of
from scipy.optimize import least_squares

from polar_bayes.physics.facets import FacetQuadrature
from polar_bayes.physics.geometry import Geometry
from polar_bayes.physics.illumination import PointSource, UniformSky
from polar_bayes.physics.instrument import (
    AngleZero,
    BeamOverlap,
    DolpGain,
    Instrument,
    TiltedNormal,
    tilted_direction,
)
from polar_bayes.physics.microfacet import GGX, AnisotropicSlopes, Beckmann
from polar_bayes.physics.mixing import StokesMixing
from polar_bayes.physics.scene import SCENES, Scene
from polar_bayes.physics.subsurface import Lambertian, TurbidMedium
from polar_bayes.physics.surface import RoughSurface, SmoothExit, SmoothSurface

RUN = settings(deadline=None, max_examples=60, derandomize=True)
direction = st.tuples(st.floats(0.0, 75.0), st.floats(-360.0, 360.0))
tilt = st.tuples(st.floats(-30.0, 30.0), st.floats(-30.0, 30.0))


FEW = FacetQuadrature(along=5, across=4)
PARAMETERS = {
    "roughness": 0.3,
    "roughness_across": 0.1,
    "roughness_azimuth": 25.0,
    "subsurface_fraction": 0.4,
    "absorption": 0.3,
    "refractive_index": 1.5,
    "polarized_fraction": 0.7,
    "light_degree": 0.8,
    "light_angle": 30.0,
    "dolp_gain": 0.9,
    "angle_zero": 0.3,
    "beam_overlap_zenith": 70.0,
}
LEVEL = {
    "plate": Scene(SmoothSurface(BEAM)),
    "grooves, polarized beam, body": Scene(
        RoughSurface(Beckmann(), BEAM, FEW, AnisotropicSlopes("roughness_azimuth")),
        Lambertian(),
        StokesMixing(),
    ),
    "sky": Scene(RoughSurface(GGX(), UniformSky(), FEW), Lambertian(), StokesMixing()),
    "turbid body": Scene(SmoothSurface(BEAM), TurbidMedium(), StokesMixing()),
}
QUICK = Scene(
    RoughSurface(Beckmann(), BEAM, way_out=SmoothExit()), Lambertian(), StokesMixing()
)  # compiles in no time
EVERY_SCENE = each("name", LEVEL)


def leaning(scene: Scene) -> Scene:
    return dataclasses.replace(scene, normal=TiltedNormal())


def tilted(tilts: tuple[float, float]) -> dict[str, float]:
    return {**PARAMETERS, "normal_tilt_x": tilts[0], "normal_tilt_y": tilts[1]}


# --- the twin: everything by vectors ----------------------------------------------------------


def rotation(tilts: tuple[float, float]) -> np.ndarray:
    """The shortest rotation from z to the true normal, by Rodrigues' formula."""
    normal = np.array([*np.tan(np.deg2rad(tilts)), 1.0])
    normal /= np.linalg.norm(normal)
    x, y, _ = np.cross([0.0, 0.0, 1.0], normal)
    turn = np.array([[0.0, 0.0, y], [0.0, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + turn + turn @ turn / (1.0 + normal[2])


def rotated(scene: Scene, view: tuple, light: tuple, tilts: tuple) -> np.ndarray:
    """Stokes vector of a level scene under rotated light and viewer, in the detector's own axes."""
    turn = rotation(tilts)
    towards, from_ = (twin.angles(turn.T @ twin.ray(*one)) for one in (view, light))
    # The beam's polarization stays where it is while the normal leans.
    incident = twin.coherency(*components(PARAMETERS["light_degree"], PARAMETERS["light_angle"]))
    arriving = turn @ twin.axes(*from_).T
    arriving = arriving.T @ twin.axes(*light).T
    _, q, u = twin.stokes(arriving @ incident @ arriving.T)
    values = PARAMETERS | {
        "light_degree": np.hypot(q, u),
        "light_angle": 0.5 * np.rad2deg(np.arctan2(u, q)),
    }
    s0, s1, s2 = np.asarray(stokes_of(scene, values, at(towards, from_)))[0]
    leaving = twin.axes(*view) @ (turn @ twin.axes(*towards).T)
    return s0 * twin.stokes(leaving @ twin.coherency(s1 / s0, s2 / s0) @ leaving.T)


@pytest.mark.thorough
@EVERY_SCENE
@given(view=direction, light=direction, tilts=tilt)
@RUN
@example(view=(40.0, 180.0), light=(45.0, 0.0), tilts=(0.0, 10.0))
@example(view=(40.0, 180.0), light=(45.0, 0.0), tilts=(10.0, 0.0))
@example(view=(20.0, 0.0), light=(45.0, 90.0), tilts=(30.0, 0.0))
@example(view=(0.0, 180.0), light=(45.0, 0.0), tilts=(3.0, -4.0))
@example(view=(50.0, 70.0), light=(0.0, 0.0), tilts=(3.0, -4.0))
@example(view=(50.0, 70.0), light=(50.0, 70.0), tilts=(3.0, -4.0))
@example(view=(75.0, 0.0), light=(75.0, 180.0), tilts=(0.0, 30.0))
def test_a_leaning_normal_is_light_and_viewer_rotated_the_other_way(name, view, light, tilts):
    """All three components in the frame of a detector that stays, each with its sign."""
    turn = rotation(tilts)
    if min((turn.T @ twin.ray(*one))[2] for one in (view, light)) < 0.05:
        return  # near or below the true horizon, where other rules hold
    if (turn.T @ twin.ray(*view))[:2] @ (turn.T @ twin.ray(*view))[:2] < 1e-18:
        return  # on the true normal, where the twin's azimuth is noise
    expected = rotated(LEVEL[name], view, light, tilts)
    found = np.asarray(stokes_of(leaning(LEVEL[name]), tilted(tilts), at(view, light)))[0]
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * expected[0])


@given(view=direction, light=direction, tilts=tilt)
@RUN
def test_a_mirror_facet_does_not_care_where_the_normal_is(
    view: tuple, light: tuple, tilts: tuple
) -> None:
    """A plate sends what its one facet sends: only the frames lean, and they are turned back."""
    turn = rotation(tilts)
    if min((turn.T @ twin.ray(*one))[2] for one in (view, light)) < 0.05:
        return
    powers = twin.bare(1.5, twin.facet_of(view, light)[0])
    incident = components(PARAMETERS["light_degree"], PARAMETERS["light_angle"])
    expected = twin.mirrored(powers, view, light, incident)
    found = np.asarray(stokes_of(leaning(LEVEL["plate"]), tilted(tilts), at(view, light)))[0]
    np.testing.assert_allclose(found, expected, atol=1e-11 * sum(np.real(powers[:2])))


@each("tilts", [(0.0, 12.0), (-9.0, 4.0), (20.0, -20.0)])
def test_brightness_and_way_out_are_those_of_a_leaning_population(tilts: tuple) -> None:
    """Against a dense grid of facets around the true normal, in and out of the plane."""
    index, roughness = 1.5, 0.25
    facets = twin.Population("GGX", roughness, roughness, steps=300)
    turn = rotation(tilts)
    many = FacetQuadrature(along=16, across=16)
    values = {"roughness": roughness, "refractive_index": index, "subsurface_fraction": 1.0}
    values |= {"normal_tilt_x": tilts[0], "normal_tilt_y": tilts[1]}
    shiny = leaning(Scene(RoughSurface(GGX(), PointSource(), many)))
    body = leaning(Scene(shiny.surface, Lambertian(), StokesMixing()))
    for view, light in (((40.0, 180.0), (45.0, 0.0)), ((10.0, 130.0), (30.0, 20.0))):
        towards, from_ = (turn.T @ twin.ray(*one) for one in (view, light))
        half = (towards + from_) / np.linalg.norm(towards + from_)
        seen = facets.visible(towards) * facets.visible(from_)
        powers = twin.bare(index, twin.facet_of(view, light)[0])
        area = facets.density(half) * seen / (4.0 * towards[2])
        found = np.asarray(stokes_of(shiny, values, at(view, light)))[0]
        expected = area * twin.mirrored(powers, view, light)
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-15)

        e0, e1, e2 = facets.way_out(*twin.angles(towards), index)
        leaving = twin.axes(*view) @ (turn @ twin.axes(*twin.angles(towards)).T)
        expected = twin.stokes(leaving @ twin.coherency(e1 / e0, e2 / e0) @ leaving.T)
        total, q, u = stokes_of(body, values, at(view, light))[0]
        np.testing.assert_allclose([q / total, u / total], expected[1:], atol=3e-5)


# --- no lean ------------------------------------------------------------------------------------


def test_no_lean_is_no_lean_to_the_last_bit() -> None:
    zenith = jnp.array([0.0, 1e-12, 1e-3, 45.0, 89.999, 89.9999999])
    found = tilted_direction(zenith, jnp.full(6, 70.0), *jnp.zeros((2, 1)))
    np.testing.assert_array_equal(found.zenith, zenith)
    np.testing.assert_array_equal(found.azimuth, np.full(6, 70.0))
    np.testing.assert_array_equal(found.turn, [np.ones(6), np.zeros(6)])


# --- where directions stop having a meaning -----------------------------------------------------


@pytest.mark.thorough
def test_light_below_the_horizon_is_next_to_none() -> None:
    scene = leaning(SCENES["camera"])
    views = at((10.0, 180.0), (75.0, 0.0))
    bright = predict(scene, tilted((0.0, 0.0)), views)["intensity"]
    dark = predict(scene, tilted((-25.0, 0.0)), views)["intensity"]
    assert 0.0 < float(dark[0]) < 1e-3 * float(bright[0])


@pytest.mark.thorough
def test_a_viewer_that_passes_the_true_normal_sees_no_jump() -> None:
    """In the plane, out of it, and exactly on the normal, where azimuth has no meaning.

    The few facets that stand for all turn with the plane of the viewer, which costs some 1e-8.
    """
    scene = leaning(LEVEL["grooves, polarized beam, body"])
    views = at((20.0, 0.0), (45.0, 100.0))
    for tilts in ((20.0, 0.0), (20.0 + 1e-9, 0.0), (20.0 - 1e-9, 0.0), (20.0, 1e-9)):
        found = stokes_of(scene, tilted(tilts), views)
        np.testing.assert_allclose(
            found, stokes_of(scene, tilted((20.0, 0.0)), views), rtol=1e-6, atol=1e-7
        )


@pytest.mark.thorough
def test_slopes_are_those_of_differences() -> None:
    """Also for a viewer on the stated normal, as soon as the true one leans."""
    scene = leaning(QUICK)
    columns = ([20.0, 0.0, 1e-3], [180.0, 180.0, 70.0], [45.0] * 3, [0.0] * 3)
    views = Geometry(*(jnp.array(column) for column in columns))

    def stokes(tilts: jax.Array) -> jax.Array:
        values = PARAMETERS | {"normal_tilt_x": tilts[0], "normal_tilt_y": tilts[1]}
        return scene.stokes(values, views)

    here, step = jnp.array([1.5, -2.0]), 1e-4
    slopes = jax.jit(jax.jacfwd(stokes))(here)
    compiled = jax.jit(stokes)
    for i, by in enumerate(np.eye(2)):
        difference = (compiled(here + step * by) - compiled(here - step * by)) / (2.0 * step)
        np.testing.assert_allclose(slopes[..., i], difference, rtol=1e-6, atol=1e-7)


# --- a part of a scene --------------------------------------------------------------------------


def test_the_instrument_acts_on_the_stated_angles() -> None:
    """Angle zero comes before the lean; what the sensor does comes after, in its own frame."""
    terms = Instrument((AngleZero(), BeamOverlap(), DolpGain()))
    scene = dataclasses.replace(leaning(QUICK), instrument=terms)
    views, values = at((60.0, 150.0), (45.0, 0.0)), tilted((6.0, 5.0))
    moved = views._replace(view_zenith=views.view_zenith + 0.3, light_zenith=jnp.array([45.3]))
    light = scene.light(values, moved)
    found = predict(scene, values, views)
    np.testing.assert_allclose(found["q"], 0.9 * light.q, rtol=1e-12)
    np.testing.assert_allclose(found["u"], 0.9 * light.u, rtol=1e-12)
    level = dataclasses.replace(QUICK, instrument=terms)
    lost = predict(level, values, views)["intensity"] / level.light(values, moved).intensity
    np.testing.assert_allclose(found["intensity"], lost * light.intensity, rtol=1e-12)


def test_a_known_lean_is_no_parameter() -> None:
    known = dataclasses.replace(QUICK, normal=TiltedNormal(4.0, -2.0))
    assert known.parameters == QUICK.parameters
    views = at((30.0, 150.0), (45.0, 0.0))
    found, expected = (
        predict(scene, tilted((4.0, -2.0)), views) for scene in (known, leaning(QUICK))
    )
    np.testing.assert_allclose(found["q"], expected["q"], rtol=1e-14)


# --- what a lean does to the material -----------------------------------------------------------

SHINY = Scene(RoughSurface(way_out=SmoothExit()), Lambertian(), StokesMixing())
NAMES = ("roughness", "subsurface_fraction", "refractive_index", "normal_tilt_x", "normal_tilt_y")
TRUTH = np.array([0.1, 0.3, 1.494, 3.5, -2.0])
NOISE = 0.01
# Beliefs as wide as the paper's, and a sample laid down by eye: mean and spread.
BELIEFS = np.array([[0.2, 0.2], [0.5, 0.25], [1.45, 0.15], [0.0, 3.0], [0.0, 3.0]]).T


def fitted(scene: Scene, count: int, readings: np.ndarray, views: Geometry) -> tuple:
    """Peak of the posterior under known normal noise, and its standard deviations there."""

    def predicted(values: jax.Array) -> jax.Array:
        found = scene.predict(dict(zip(NAMES[:count], values, strict=True)), views)
        return jnp.concatenate([found["q"], found["u"], jnp.log(found["intensity"])])

    def misfit(values: jax.Array) -> jax.Array:
        center, spread = BELIEFS[:, :count]
        return jnp.concatenate([(predicted(values) - readings) / NOISE, (values - center) / spread])

    residual, slopes = jax.jit(misfit), jax.jit(jax.jacfwd(misfit))
    low = [0.02, 0.0, 1.2, -15.0, -15.0][:count]
    high = [0.5, 1.0, 2.0, 15.0, 15.0][:count]
    found = least_squares(
        lambda x: np.asarray(residual(x)),
        [0.1, 0.4, 1.45, 0.0, 0.0][:count],
        lambda x: np.asarray(slopes(x)),
        (low, high),
    )
    return found.x, np.sqrt(np.diag(np.linalg.inv(found.jac.T @ found.jac)))


@pytest.mark.thorough
def test_a_lean_is_found_and_without_it_the_material_is_wrong() -> None:
    """Signed Stokes and brightness of 24 views of a plastic, 1% noise, a sample 4 degrees off."""
    leaning_ = leaning(SHINY)
    angles_ = np.linspace(3.0, 75.0, 24)
    around = np.resize([180.0, 150.0, 120.0, 60.0], 24)
    views = directions(angles_, around, 45.0)
    found = predict(leaning_, dict(zip(NAMES, TRUTH, strict=True)), views)
    readings = np.concatenate([found["q"], found["u"], np.log(found["intensity"])])
    readings += NOISE * np.random.default_rng(5).normal(size=readings.size)

    mean, spread = fitted(leaning_, 5, readings, views)
    np.testing.assert_array_less(np.abs(mean - TRUTH), 3.0 * spread)
    assert np.all(spread[3:] < 0.5)
    mean, spread = fitted(SHINY, 3, readings, views)
    assert abs(mean[2] - TRUTH[2]) > 5.0 * spread[2]
