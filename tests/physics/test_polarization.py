"""Polarized light: against fields and vectors, and the laws that every mirror obeys."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vector_optics as twin
from cases import each
from hypothesis import example, given, settings
from hypothesis import strategies as st
from optics import BEAM, at, components, stokes_of

from polar_bayes.physics.coat import ClearCoat, ThinFilm
from polar_bayes.physics.geometry import Geometry, cos_degrees
from polar_bayes.physics.illumination import PointSource
from polar_bayes.physics.scene import Scene
from polar_bayes.physics.stack import Stack
from polar_bayes.physics.stokes import LinearPolarization, to_stokes
from polar_bayes.physics.surface import RoughSurface, SmoothSurface

RUN = settings(deadline=None, max_examples=100, derandomize=True)
zenith = st.floats(0.0, 89.5)
azimuth = st.floats(-360.0, 360.0)
direction = st.tuples(zenith, azimuth)
degree = st.floats(0.0, 1.0)
angle = st.floats(-180.0, 180.0)
index = st.floats(1.01, 3.0)

MIRROR = Scene(SmoothSurface(BEAM))


def mirrored(
    view: tuple, light: tuple, n: float, degree: float, angle: float, scene: Scene = MIRROR
) -> np.ndarray:
    parameters = {
        "refractive_index": n,
        "light_degree": degree,
        "light_angle": angle,
        "roughness": 0.3,
    }
    return np.asarray(stokes_of(scene, parameters, at(view, light)))[0]


@given(view=direction, light=direction, n=index, degree=degree, angle=angle)
@settings(parent=RUN, max_examples=300)
@example(view=(0.0, 30.0), light=(0.0, -50.0), n=1.5, degree=1.0, angle=20.0)
@example(view=(40.0, 30.0), light=(40.0, 30.0), n=1.5, degree=1.0, angle=20.0)
@example(view=(40.0, 30.0), light=(40.0, 210.0), n=1.5, degree=1.0, angle=20.0)
@example(view=(0.0, 30.0), light=(60.0, 10.0), n=1.5, degree=1.0, angle=-70.0)
@example(view=(60.0, 30.0), light=(0.0, 10.0), n=1.5, degree=0.5, angle=100.0)
def test_a_facet_turns_the_field_as_vectors_do(view, light, n, degree, angle) -> None:
    """Fresnel's amplitudes along explicit axes: all three components, in and out of the plane."""
    powers = twin.bare(n, twin.facet_of(view, light)[0])
    expected = twin.mirrored(powers, view, light, components(degree, angle))
    found = mirrored(view, light, n, degree, angle)
    size = np.real(powers[0] + powers[1])
    np.testing.assert_allclose(found, expected, atol=1e-12 * size + 1e-16)


FILM, COAT = (1.38, 230.0), (1.7, 0.3)


@pytest.mark.thorough
@given(view=direction, light=direction, degree=degree, angle=angle)
@RUN
def test_a_facet_under_a_film_or_coat_does_so_too(view, light, degree, angle) -> None:
    b, _ = twin.facet_of(view, light)
    film = twin.powers(twin.films(1.0, ((FILM[0], 2.0 * np.pi * FILM[1] / 550.0),), 1.5, b)[0])
    coat = tuple(twin.bounced((1.0, COAT[0], 1.5), COAT[1:], b, bounces=60)[0])
    for layer, powers in ((ThinFilm(*FILM), film), (ClearCoat(*COAT), coat)):
        expected = twin.mirrored(powers, view, light, components(degree, angle))
        scene = Scene(SmoothSurface(BEAM), coat=layer)
        found = mirrored(view, light, 1.5, degree, angle, scene)
        np.testing.assert_allclose(found, expected, atol=1e-12)


@given(view=direction, light=direction, n=index, angle=angle)
@RUN
def test_degree_0_and_orthogonal_pairs_are_unpolarized_light(view, light, n, angle) -> None:
    for surface, beam in (
        (SmoothSurface(), SmoothSurface(BEAM)),
        (RoughSurface(), RoughSurface(illumination=BEAM)),
    ):
        plain = mirrored(view, light, n, 0.0, 0.0, Scene(surface))
        none = mirrored(view, light, n, 0.0, angle, Scene(beam))
        across = angle - 90.0 if angle > 0.0 else angle + 90.0
        pair = [mirrored(view, light, n, 1.0, a, Scene(beam)) for a in (angle, across)]
        slack = 1e-13 * plain[0] + 1e-300
        np.testing.assert_allclose(none, plain, rtol=1e-13, atol=slack)
        np.testing.assert_allclose(0.5 * (pair[0] + pair[1]), plain, rtol=1e-12, atol=10 * slack)


@pytest.mark.thorough
@each("view", [(0.0, 20.0), (40.0, 20.0), (85.0, 20.0), (40.0, 200.0)], ids=str)
@each("dtype", [np.float64, np.float32])
def test_derivatives_exist_where_viewer_and_light_coincide(view: tuple, dtype: type) -> None:
    """The gradient over both directions, the polarization and the index; and it is a limit."""

    def reading(row: jax.Array) -> jax.Array:
        parameters = {"refractive_index": row[4], "light_degree": row[5], "light_angle": row[6]}
        geometry = Geometry(*(row[i : i + 1] for i in range(4)))
        return MIRROR.stokes(parameters, geometry)[0] @ jnp.asarray([0.3, 1.0, -0.7], dtype)

    row = jnp.array([*view, 40.0, 20.0, 1.5, 0.8, 25.0], dtype)
    gradient = jax.jit(jax.grad(reading))
    assert np.all(np.isfinite(gradient(row)))
    if dtype == np.float64:
        step = 1e-4
        for i, basis in enumerate(np.eye(row.size)):
            slope = (reading(row + step * basis) - reading(row - step * basis)) / (2.0 * step)
            np.testing.assert_allclose(gradient(row)[i], slope, atol=1e-8)


@pytest.mark.thorough
@given(incidence=zenith, n=index, degree=degree, angle=angle)
@RUN
def test_what_enters_is_what_the_transmittances_of_s_and_p_let_through(incidence, n, degree, angle):
    b = float(np.sin(np.deg2rad(incidence)) ** 2)
    _, fields, (s, p) = twin.films(1.0, (), n, b)
    # The product of both fields grows in power as each does.
    cross = np.real(fields[0] * np.conj(fields[1])) * np.sqrt(s * p) / np.abs(np.prod(fields))
    q, u = components(degree, angle)
    source = PointSource(LinearPolarization(degree, angle))
    light = source.entering(Stack(jnp.array([n])), at((10.0, 0.0), (incidence, 0.0)), {})
    expected = [
        0.5 * (s * (1.0 + q) + p * (1.0 - q)),
        0.5 * (s * (1.0 + q) - p * (1.0 - q)),
        cross * u,
    ]
    found = np.asarray(to_stokes(light))[0] / cos_degrees(incidence)
    np.testing.assert_allclose(found, expected, atol=1e-13)
