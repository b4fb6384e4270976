"""Value, gradient and Hessian are finite in every hard case, in both precisions."""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hard_cases.catalogue import DIRECTIONS, INSTRUMENTS, MATERIALS, Cases, every_case
from jaxtyping import Array

from polar_bayes.physics.geometry import Geometry
from polar_bayes.physics.illumination import Disc, UniformSky
from polar_bayes.physics.microfacet import GGX, Beckmann
from polar_bayes.physics.mixing import DopMixing, StokesMixing
from polar_bayes.physics.scene import MATERIAL_PARAMETERS, Scene
from polar_bayes.physics.scenes import SCENES
from polar_bayes.physics.subsurface import Depolarizer, Lambertian
from polar_bayes.physics.surface import RoughSurface

READINGS = ("dop", "q", "u", "intensity")

ALL_SCENES = SCENES | {
    "GGX, point": Scene(RoughSurface(GGX()), Depolarizer(), StokesMixing()),
    "GGX, sky": Scene(RoughSurface(GGX(), UniformSky()), Lambertian(), StokesMixing()),
    "Beckmann, sky": Scene(
        RoughSurface(Beckmann(), UniformSky()), Depolarizer(), DopMixing(signed=True)
    ),
    "Beckmann, disc": Scene(
        RoughSurface(Beckmann(), Disc(half_width=5.0)), Depolarizer(), StokesMixing()
    ),
}


def instrument_columns(scene: Scene, settings: Mapping[str, object], dtype: type) -> np.ndarray:
    """The instrument parameters that a scene reads, laid out in one row."""
    names = [name for name in scene.parameters if name not in MATERIAL_PARAMETERS]
    parts = [np.atleast_1d(np.asarray(settings[name], dtype)) for name in names]
    return np.concatenate([np.zeros(0, dtype), *parts])


def rows(scene: Scene, cases: Cases, dtype: type) -> np.ndarray:
    """Every case with every state of the instrument: one row of inputs each.

    A scene without an instrument gets as many rows: operations of one shape compile once.
    """
    count = len(cases.names)
    return np.concatenate(
        [
            np.concatenate(
                [
                    cases.directions,
                    cases.materials,
                    np.tile(instrument_columns(scene, setting, dtype), (count, 1)),
                ],
                axis=1,
            )
            for setting in INSTRUMENTS.values()
        ]
    )


def readings(scene: Scene, row: Array) -> Array:
    """All readings of one view, from one row of inputs."""
    geometry = Geometry(row[0:1], jnp.zeros_like(row[0:1]), row[1:2], row[2:3])
    parameters = dict(zip(MATERIAL_PARAMETERS, row[3:7], strict=True))
    start = 7
    for name in scene.parameters[len([n for n in scene.parameters if n in MATERIAL_PARAMETERS]) :]:
        size = np.size(INSTRUMENTS["perfect"][name])
        piece = row[start : start + size]
        parameters[name] = piece if name == "discrepancy_weights" else piece[0]
        start += size
    predicted = scene.predict(parameters, geometry)
    return jnp.concatenate([predicted[name] for name in READINGS])


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("name", ALL_SCENES)
def test_value_gradient_and_hessian_are_finite(name: str, dtype: type) -> None:
    scene, cases = ALL_SCENES[name], every_case(dtype)
    inputs = rows(scene, cases, dtype)
    generator = np.random.default_rng(20)
    # A sum over readings, and a Hessian times a vector, hide nothing: one entry that is not
    # finite spoils its row. They compile in a fraction of the time of the full Hessian.
    reading_weights = jnp.asarray(generator.normal(size=len(READINGS)), dtype)
    tangent = jnp.asarray(generator.normal(size=inputs.shape[1]), dtype)

    def mixed(row: Array) -> tuple[Array, Array]:
        values = readings(scene, row)
        return values @ reading_weights, values

    def derivatives(row: Array) -> tuple[Array, Array, Array]:
        gradient, hessian, values = jax.jvp(
            jax.grad(mixed, has_aux=True), (row,), (tangent,), has_aux=True
        )
        return values, gradient, hessian

    for what, result in zip(
        ("value", "gradient", "Hessian"), jax.vmap(derivatives)(jnp.asarray(inputs)), strict=True
    ):
        assert result.dtype == dtype
        broken = np.unique(np.nonzero(~np.isfinite(np.asarray(result)))[0])
        names = [cases.names[row % len(cases.names)] for row in broken]
        assert not names, f"{what} of scene {name} is not finite at {names[:8]}"


@pytest.mark.parametrize("name", ALL_SCENES)
def test_light_is_possible(name: str) -> None:
    """S0 >= |S|: no reading of an ideal instrument is more than fully polarized, or negative."""
    cases = every_case(np.float64)
    view, light, azimuth = (jnp.asarray(column)[:, None] for column in cases.directions.T)
    geometry = Geometry(view, jnp.zeros_like(view), light, azimuth)
    parameters = dict(zip(MATERIAL_PARAMETERS, cases.materials.T, strict=True))
    stokes = np.asarray(ALL_SCENES[name].stokes(parameters, geometry))[:, 0]
    assert np.all(stokes[:, 0] >= 0.0)
    slack = 1e-14 * stokes[:, 0] + 1e-300
    assert np.all(np.hypot(stokes[:, 1], stokes[:, 2]) <= stokes[:, 0] + slack)


def test_the_catalogue_reaches_every_end() -> None:
    zeniths = np.array(list(DIRECTIONS.values()))[:, :2]
    materials = np.array(list(MATERIALS.values()))
    assert zeniths.min() == 0.0
    assert zeniths.max() > 89.99
    assert materials[:, 0].min() == 0.0
    assert materials[:, 0].max() > 1.0
    assert {0.0, 1.0} <= set(materials[:, 1])
    assert materials[:, 2].min() == 0.0
    assert materials[:, 2].max() > 10.0
    assert materials[:, 3].min() == 1.0
