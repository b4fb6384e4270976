"""Input quantities: what each does to directions and readings, and that it is finite."""

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from cases import each

import polar_bayes as pb
from polar_bayes.physics.geometry import Geometry
from polar_bayes.physics.input_quantities import (
    AbstractInputQuantity,
    AmbientLight,
    AnalyzerRoll,
    IncidenceAngle,
    LightAzimuth,
    LightZenith,
    PolarizationLoss,
    SampleLean,
    ToneCurve,
    ViewZenithScale,
)
from polar_bayes.physics.stokes import Light
from polar_bayes.setups import SETUPS
from polar_bayes.simulation import Protocol

GEOMETRY = Geometry(
    jnp.array([0.0, 30.0, 60.0]), jnp.array([180.0, 180.0, 0.0]), jnp.full(3, 40.0), jnp.zeros(3)
)
LIGHT = Light(jnp.array([1.0, 0.5, 0.1]), jnp.array([0.2, 0.6, -0.3]), jnp.array([0.0, 0.1, 0.2]))


def frames(light: Light, power: float) -> Light:
    """Light as frames have it whose counts are a power of light."""
    found = []
    for contrast in (light.q, light.u):
        one, other = ((light.intensity * (1.0 + sign * contrast)) ** power for sign in (1.0, -1.0))
        found.append((one - other) / (one + other))
    return Light(light.intensity**power, *found)


def turned(light: Light, degrees: float) -> Light:
    stokes = (light.q + 1j * light.u) * np.exp(2j * np.radians(degrees))
    return Light(light.intensity, stokes.real, stokes.imag)


AIMED = {
    LightZenith(): GEOMETRY._replace(light_zenith=GEOMETRY.light_zenith + 0.1),
    LightAzimuth(): GEOMETRY._replace(light_azimuth=GEOMETRY.light_azimuth + 0.1),
    IncidenceAngle(): GEOMETRY._replace(
        light_zenith=GEOMETRY.light_zenith + 0.1, view_zenith=GEOMETRY.view_zenith + 0.1
    ),
    ViewZenithScale(): GEOMETRY._replace(view_zenith=1.1 * GEOMETRY.view_zenith),
    SampleLean(): GEOMETRY._replace(
        light_zenith=GEOMETRY.light_zenith + 0.1,
        view_zenith=GEOMETRY.view_zenith + jnp.array([-0.1, -0.1, 0.1]),
    ),
}
RECORDED = {
    AnalyzerRoll(): turned(LIGHT, 0.1),
    PolarizationLoss(): Light(LIGHT.intensity, 0.9 * LIGHT.q, 0.9 * LIGHT.u),
    AmbientLight(): Light(
        LIGHT.intensity + 0.1,
        *(x * LIGHT.intensity / (LIGHT.intensity + 0.1) for x in (LIGHT.q, LIGHT.u)),
    ),
    ToneCurve(): frames(LIGHT, 1.1),
}


def offset(quantity: AbstractInputQuantity, amount: float) -> dict[str, jnp.ndarray]:
    return {name: jnp.array([amount]) for name in quantity.parameters}


@each("quantity", [*AIMED, *RECORDED], ids=lambda each: each.name)
def test_it_does_what_it_says_and_nothing_at_zero(quantity: AbstractInputQuantity) -> None:
    def both(amount: float) -> tuple[Geometry, Light]:
        given = offset(quantity, amount)
        return quantity.aim(given, GEOMETRY), quantity.record(given, GEOMETRY, LIGHT)

    found, expected = both(0.1), (AIMED.get(quantity, GEOMETRY), RECORDED.get(quantity, LIGHT))
    # A tone curve regards a millionth of the light as stray.
    jax.tree.map(
        lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-5, atol=1e-8), found, expected
    )
    jax.tree.map(
        lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-14), both(0.0), (GEOMETRY, LIGHT)
    )


HARD = Light(
    jnp.array([0.0, 0.0, 1e-300, 1e-30, 1.0, 1.0, 1e8]),
    jnp.array([0.0, 1.0, 0.5, -1.0, 1.0, -1.0, 0.3]),
    jnp.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.0, -0.4]),
)


@each("dtype", [np.float32, np.float64])
@each("quantity", RECORDED, ids=lambda each: each.name)
def test_it_is_finite_with_its_slopes(quantity, dtype: type) -> None:
    """Without light, in full polarization, at the ends of what a number can hold."""

    def record(given, light):
        parameters = dict.fromkeys(quantity.parameters, given[None])
        return jax.tree.map(jnp.sum, quantity.record(parameters, GEOMETRY, light))

    amounts = jnp.array([-0.3, 0.0, 0.3], dtype)
    amounts = jnp.abs(amounts) if quantity == AmbientLight() else amounts  # it only adds
    light = jax.tree.map(lambda x: x.astype(dtype), HARD)
    slopes = jax.jacrev(record, (0, 1))
    both = jax.jit(jax.vmap(lambda x: (record(x, light), slopes(x, light))))
    for found in jax.tree.leaves(both(amounts)):
        assert np.isfinite(found).all()


def test_none_goes_beyond_the_horizon() -> None:
    grazing = GEOMETRY._replace(view_zenith=jnp.full(3, 89.9))
    aimed = ViewZenithScale().aim(offset(ViewZenithScale(), 0.01), grazing)
    np.testing.assert_array_equal(aimed.view_zenith, 89.999)


def test_every_quantity_is_tested_and_those_of_set_ups_are_added_to_any_scene_once() -> None:
    every = {getattr(pb.input_quantities, name)() for name in pb.input_quantities.__all__}
    assert every == {*AIMED, *RECORDED}
    assert {each for own in SETUPS.values() for each in own.known} <= every
    scene = SETUPS["camera"].scene.known_to(SETUPS["camera"].known)
    assert scene.known_to(SETUPS["camera"].known) is scene  # with how it was chosen
    assert scene.perfectly_known == SETUPS["camera"].scene
    bare = pb.Scene(surface=pb.SmoothSurface())
    assert bare.known_to((LightZenith(),)).perfectly_known == bare


def test_a_scene_that_is_given_no_offset_has_none() -> None:
    setup = SETUPS["camera"]
    given = {
        "roughness": 0.2,
        "subsurface_fraction": 0.4,
        "refractive_index": 1.5,
        "dolp_gain": 1.0,
    }
    predict = jax.jit(lambda scene: scene.predict(given, GEOMETRY), static_argnums=0)
    with_offsets, without = predict(setup.scene.known_to(setup.known)), predict(setup.scene)
    for name, reading in without.items():
        np.testing.assert_allclose(with_offsets[name], reading, rtol=1e-12, atol=1e-15)


def test_ambient_light_is_a_share_of_what_a_sensor_can_record() -> None:
    """A highlight a thousand times too bright does not make ambient light brighter than a body."""
    bright = LIGHT._replace(intensity=LIGHT.intensity.at[0].set(1000.0))

    def added(exposure: float | None) -> np.ndarray:
        given = offset(AmbientLight(), 0.01)
        if exposure is not None:
            given["exposure"] = jnp.array([exposure])
        lit = AmbientLight().record(given, GEOMETRY, bright).intensity
        return np.asarray(lit - bright.intensity)

    np.testing.assert_allclose(added(2.0), 0.01 / 2.0, rtol=1e-10)  # full scale is 1 / exposure
    np.testing.assert_allclose(added(None), 0.01 * 1000.0, rtol=1e-10)
    np.testing.assert_allclose(added(0.6 / 1000.0), 0.01 * 1000.0, rtol=1e-10)  # nothing is full


def test_an_overexposed_highlight_leaves_the_rest_of_a_capture_as_it_was() -> None:
    """Polarization of the body of a polished plate, with ambient light and without."""

    def simulated(ambient: float) -> xr.Dataset:
        camera = SETUPS["camera"]
        capture = pb.simulate(
            "glass",
            scene=camera.scene.known_to(camera.known),
            links=camera.links,
            protocol=Protocol(views=40, wavelengths=()),
            parameters={"roughness": 0.02, "ambient_light_offset": ambient},
            noise={"stokes_scale": 1e-6, "intensity_scale": 1e-6, "exposure": 20.0},
        )
        assert capture["saturated"].any()
        return capture.where(~capture["saturated"] & (abs(capture["q"]) > 0.01), drop=True)

    lit, dark = simulated(0.003), simulated(0.0)
    share = (1.0 - lit["q"] / dark["q"]) * lit["intensity"]  # of full scale
    np.testing.assert_allclose(share, 0.003, rtol=0.02)  # the noise is up to 1e-4 of q
