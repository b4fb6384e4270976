"""Scenes: parts in, readings out; what is off is absent; mistakes are told by name."""

import dataclasses
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import each
from optics import BEAM, EVERYTHING, directions, predict, stokes_of

from polar_bayes.errors import SceneError
from polar_bayes.physics.coat import ClearCoat
from polar_bayes.physics.illumination import Disc, PointSource, UniformSky
from polar_bayes.physics.instrument import (
    AbstractInstrumentTerm,
    Analyzer,
    DarkLevel,
    Discrepancy,
    DolpGain,
    Instrument,
    TiltedNormal,
)
from polar_bayes.physics.microfacet import GGX, Beckmann
from polar_bayes.physics.mixing import StokesMixing
from polar_bayes.physics.scene import SCENES, Scene
from polar_bayes.physics.subsurface import Depolarizer, Lambertian
from polar_bayes.physics.surface import RoughSurface, SmoothExit, SmoothSurface

VIEWS = directions([0.0, 45.0, 80.0], 180.0, 45.0)
PARAMETERS = {
    "roughness": 0.1,
    "subsurface_fraction": 0.3,
    "absorption": 0.3,
    "refractive_index": 1.5,
    "dolp_gain": 0.9,
    "angle_zero": 0.1,
    "channel_gain_ratio": 1.05,
    "leakage": 0.01,
    "dark_level": 0.001,
    "discrepancy_amplitude": 0.1,
    "discrepancy_weights": np.array([0.5, -0.5, 1.0]),
    "normal_tilt_x": 4.0,
    "normal_tilt_y": -3.0,
    "light_degree": 0.8,
    "light_angle": 30.0,
}


LEANING = Scene(
    RoughSurface(Beckmann(), BEAM, way_out=SmoothExit()),
    Lambertian(),
    StokesMixing(),
    normal=TiltedNormal(),
)
EVERY_SCENE = SCENES | {"leaning": LEANING}


def test_a_scene_of_the_design_reads_as_written() -> None:
    scene = Scene(
        surface=RoughSurface(distribution=GGX(), illumination=PointSource()),
        subsurface=Lambertian(albedo=1.0),
        mixing=StokesMixing(),
        coat=None,
        instrument=None,
    )
    assert scene.parameters == ("roughness", "subsurface_fraction", "refractive_index")
    stokes = stokes_of(scene, {**PARAMETERS, "subsurface_fraction": 0.0}, VIEWS)
    assert stokes.shape == (3, 3)
    alone = stokes_of(Scene(surface=scene.surface), PARAMETERS, VIEWS)
    np.testing.assert_allclose(stokes, alone, rtol=1e-12, atol=1e-30)


@pytest.mark.thorough
@each("name", EVERY_SCENE)
def test_leading_axes_of_parameters_and_geometry_broadcast(name: str) -> None:
    """Patches by wavelengths, each with its own parameters and lean, seen in the same views."""
    scene = EVERY_SCENE[name]
    many = {
        key: jnp.broadcast_to(jnp.asarray(value), (2, 5, *np.shape(value)))
        for key, value in PARAMETERS.items()
    }
    for key, ends in (("refractive_index", (1.3, 1.7)), ("normal_tilt_x", (-5.0, 5.0))):
        many[key] = jnp.linspace(*ends, 10).reshape(2, 5)
    found = predict(scene, many, VIEWS)
    one = predict(scene, {key: value[1, 2] for key, value in many.items()}, VIEWS)
    for reading in ("dop", "q", "u", "intensity"):
        assert found[reading].shape == (2, 5, 3)
        np.testing.assert_allclose(found[reading][1, 2], one[reading], rtol=1e-12, atol=1e-15)


@pytest.mark.thorough
@each("name", EVERY_SCENE)
def test_single_precision_stays_single_and_agrees(name: str) -> None:
    scene = EVERY_SCENE[name]
    single = jax.tree.map(lambda angle: angle.astype(jnp.float32), VIEWS)
    small = {key: np.float32(value) for key, value in PARAMETERS.items()}
    for parameters in (small, PARAMETERS | {"discrepancy_weights": np.zeros(3, np.float32)}):
        found = predict(scene, parameters, single)
        assert all(value.dtype == jnp.float32 for value in found.values())
    found = predict(scene, small, single)
    for reading, value in predict(scene, PARAMETERS, VIEWS).items():
        bound = 2e-5 if name == "leaning" else 1e-4
        np.testing.assert_allclose(found[reading], value, rtol=bound, atol=1e-6)


def test_a_scene_is_static_data() -> None:
    """Hashable, equal by value, printable and picklable: it can be a static argument of jit."""
    for scene in (SCENES["goniometer"], EVERYTHING):
        copy = pickle.loads(pickle.dumps(scene))
        assert copy == scene
        assert hash(copy) == hash(scene)
    scene = SCENES["goniometer"]
    stokes_of(scene, PARAMETERS, VIEWS)
    traces = stokes_of._cache_size()
    stokes_of(pickle.loads(pickle.dumps(scene)), PARAMETERS, VIEWS)
    assert stokes_of._cache_size() == traces


def operations(scene: Scene) -> list[str]:
    """The primitives of the program that a scene becomes."""
    program = jax.make_jaxpr(lambda p: scene.predict(p, VIEWS))(PARAMETERS)
    return [str(equation.primitive) for equation in program.eqns]


@each("term", SCENES["goniometer"].instrument.terms, ids=lambda t: str(t)[:9])
def test_a_term_removed_is_absent_from_the_program(term: AbstractInstrumentTerm) -> None:
    scene = SCENES["goniometer"]
    rest = tuple(part for part in scene.instrument.terms if part != term)
    never_there = Scene(scene.surface, scene.subsurface, scene.mixing, instrument=Instrument(rest))
    removed = scene.without(type(term))
    assert scene.has(type(term))
    assert not removed.has(type(term))
    assert operations(removed) == operations(never_there)
    assert len(operations(removed)) < len(operations(scene))
    assert not set(term.parameters) & set(removed.parameters)


def test_a_part_switched_off_costs_no_operation() -> None:
    """No body, no instrument, nothing but the mirror; no lean."""
    whole = emptied = SCENES["goniometer"]
    for term in whole.instrument.terms:
        emptied = emptied.without(type(term))
    assert emptied == Scene(whole.surface, whole.subsurface, whole.mixing)
    assert emptied.instrument is None
    assert not emptied.has(Discrepancy)
    bare = operations(Scene(SmoothSurface(), None, None, None, None))
    assert len(bare) < 0.5 * len(operations(emptied)) < 0.5 * len(operations(whole))
    level = dataclasses.replace(LEANING, normal=None)
    assert SCENES["camera"].normal is None
    assert len(operations(level)) < len(operations(LEANING))


@pytest.mark.thorough
def test_the_instrument_is_not_in_the_optics() -> None:
    camera = SCENES["camera"]
    stokes, readings = stokes_of(camera, PARAMETERS, VIEWS), predict(camera, PARAMETERS, VIEWS)
    np.testing.assert_allclose(readings["q"], 0.9 * stokes[:, 1] / stokes[:, 0], rtol=1e-12)
    optics_only = {k: v for k, v in PARAMETERS.items() if k != "dolp_gain"}
    np.testing.assert_array_equal(stokes_of(camera, optics_only, VIEWS), stokes)


def test_missing_parameters_are_named() -> None:
    with pytest.raises(SceneError, match="parameters: absorption, refractive_index missing; this"):
        SCENES["paper"].stokes({"roughness": 0.1, "subsurface_fraction": 0.2}, VIEWS)
    with pytest.raises(SceneError, match="parameters: dolp_gain missing"):
        SCENES["camera"].predict({k: 1.5 for k in SCENES["paper"].parameters}, VIEWS)


@pytest.mark.thorough
def test_only_terms_that_are_there_can_be_removed() -> None:
    with pytest.raises(SceneError, match="no DarkLevel; name one of its instrument terms: DolpG"):
        SCENES["camera"].without(DarkLevel)
    assert SCENES["camera"].without(DolpGain).instrument is None


@pytest.mark.thorough
def test_a_scene_of_everything_predicts() -> None:
    values = dict.fromkeys(EVERYTHING.parameters, 0.3)
    values |= {"cauchy_a": 1.45, "cauchy_b": 0.005, "film_thickness": 200.0}
    values |= {"coat_refractive_index": 1.5, "film_refractive_index": 1.4}
    values |= {"beam_overlap_zenith": 80.0, "roughness_azimuth": 30.0}
    colors = VIEWS._replace(wavelength=jnp.array([[450.0], [650.0]]))
    for reading in predict(EVERYTHING, values, colors).values():
        assert reading.shape == (2, 3)
        assert np.all(np.isfinite(reading))
    stokes = stokes_of(EVERYTHING, {k: values[k] for k in EVERYTHING.optical_parameters}, colors)
    np.testing.assert_array_less(np.hypot(stokes[..., 1], stokes[..., 2]), stokes[..., 0])
    missing = {k: v for k, v in values.items() if k not in ("light_angle", "film_thickness")}
    with pytest.raises(SceneError, match="parameters: film_thickness, light_angle missing; this"):
        EVERYTHING.predict(missing, colors)


def test_a_name_used_twice_is_one_parameter() -> None:
    """A coat of the body's index, whatever that is: the same number for both."""
    scene = Scene(SmoothSurface(), coat=ClearCoat("refractive_index", 0.0))
    assert scene.parameters == ("refractive_index",)
    found, bare = (stokes_of(each, PARAMETERS, VIEWS) for each in (scene, Scene(SmoothSurface())))
    np.testing.assert_allclose(found, bare, rtol=1e-12, atol=1e-17)


def test_an_analyzer_of_each_view_is_read_in_its_order() -> None:
    turned = Scene(SmoothSurface(), instrument=Instrument((Analyzer((0.0, 90.0, 45.0)),)))
    plain = predict(Scene(SmoothSurface()), PARAMETERS, VIEWS)
    found = predict(turned, PARAMETERS, VIEWS)
    share = (1.0 + np.array([1.0, -1.0, 0.0]) * plain["q"]) / 2.0
    np.testing.assert_allclose(found["intensity"], share * plain["intensity"], rtol=1e-12)


@pytest.mark.thorough
def test_an_extended_source_needs_no_direction_of_the_light() -> None:
    moved = VIEWS._replace(light_zenith=VIEWS.light_zenith + 20.0, light_azimuth=VIEWS.view_azimuth)
    for source in (UniformSky(), Disc(10.0)):
        scene = Scene(RoughSurface(GGX(), source), Depolarizer(), StokesMixing())
        here, there = (stokes_of(scene, PARAMETERS, views) for views in (VIEWS, moved))
        np.testing.assert_allclose(here, there, rtol=1e-15)
