"""Directions, and the facet between them."""

import jax.numpy as jnp
import numpy as np
import pytest
import vector_optics as twin
from cases import each
from hypothesis import given, settings
from hypothesis import strategies as st
from optics import directions

from polar_bayes.physics.geometry import (
    Geometry,
    cos_degrees,
    mirror_facet,
    mirror_slopes,
    per_ray,
    sin_degrees,
    turn_between_frames,
)

zenith = st.floats(0.0, 89.9)
azimuth = st.floats(-360.0, 360.0)


def at(view: float, light: float, difference: float, turn: float = 0.0) -> Geometry:
    return Geometry(*(jnp.array([x]) for x in (view, turn, light, turn + difference)))


def test_angles_broadcast_to_one_shape_and_one_float() -> None:
    geometry = directions(np.array([10, 20, 30]), 180, [45.0], 0)
    assert all(angle.shape == (3,) for angle in geometry[:4])
    assert all(angle.dtype == jnp.float64 for angle in geometry[:4])
    assert geometry.wavelength is None


def test_single_precision_stays_single() -> None:
    angle = np.float32([10.0, 20.0])
    geometry = directions(angle, angle, angle, angle)
    assert all(one.dtype == jnp.float32 for one in geometry[:4])


def test_on_the_normal_the_frame_comes_from_the_light() -> None:
    geometry = directions([0.0, 10.0], 77.0, 30.0, 20.0)
    np.testing.assert_array_equal(geometry.view_azimuth, [200.0, 77.0])


@each("angle", [0.0, 30.0, 45.0, 60.0, 89.0, 89.9999999])
def test_sine_and_cosine_in_degrees(angle: float) -> None:
    complement = np.float64(90.0 - angle)
    np.testing.assert_allclose(sin_degrees(angle), np.sin(np.deg2rad(angle)), rtol=3e-16)
    np.testing.assert_allclose(cos_degrees(angle), np.sin(np.deg2rad(complement)), rtol=3e-16)


@given(view=zenith, light=zenith, difference=azimuth)
@settings(deadline=None, max_examples=40)
def test_a_negative_zenith_is_the_other_side(view: float, light: float, difference: float) -> None:
    """The frame turns by 180 degrees with the viewer, which leaves Stokes as they are."""
    here = mirror_facet(at(view, light, difference))
    there = mirror_facet(at(-view, light, difference + 180.0))
    for one, other in zip(here, there, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12)


@given(view=zenith, light=zenith, turn=azimuth, difference=azimuth)
@settings(deadline=None, max_examples=60)
def test_mirror_slopes_agree_with_vectors(view, light, turn, difference) -> None:
    """Towards the viewer, and across along the viewer's s axis: relative to the facet's tilt."""
    half = twin.ray(view, turn) + twin.ray(light, turn + difference)
    s, second = twin.axes(view, turn)
    towards = np.cross(s, [0.0, 0.0, 1.0])
    geometry = at(view, light, difference, turn)
    found = np.ravel(mirror_slopes(geometry))
    expected = np.array([half @ towards, half @ s]) / half[2]
    size = 1.0 + np.hypot(*expected)
    np.testing.assert_allclose(found, expected, atol=1e-12 * size)
    tilt = mirror_facet(geometry).tan_squared_tilt[0]
    np.testing.assert_allclose(np.sum(found**2), tilt, rtol=1e-10, atol=1e-24)
    np.testing.assert_allclose(second @ twin.ray(view, turn), 0.0, atol=1e-15)


@pytest.mark.thorough
@given(view=zenith, light=zenith, turn=azimuth, difference=azimuth)
@settings(deadline=None, max_examples=60)
def test_turn_between_frames_agrees_with_vectors(view, light, turn, difference) -> None:
    """A mirror that treats s and p alike takes light's s axis to where the angle says."""
    ends = (view, turn), (light, turn + difference)
    geometry = at(view, light, difference, turn)
    sin_squared = float(mirror_facet(geometry).sin_squared[0])
    cos, sin = np.ravel(turn_between_frames(geometry))
    np.testing.assert_allclose(cos**2 + sin**2, 1.0, rtol=1e-14)
    if 1e-12 < sin_squared < 1.0 - 1e-12:  # the facet's own axis is defined
        stokes = twin.mirrored((1.0, 1.0, 1.0), *ends, (1.0, 0.0))
        np.testing.assert_allclose([cos, -sin], stokes[1:], atol=1e-9)


@pytest.mark.thorough
def test_the_wavelength_travels_with_the_directions() -> None:
    colors = [[450.0], [650.0]]
    geometry = directions(
        np.float32([10.0, 20.0]),
        np.float32(180.0),
        np.float32(30.0),
        np.float32(0.0),
        wavelength=colors,
    )
    assert geometry.wavelength.shape == (2, 1)
    assert geometry.wavelength.dtype == jnp.float32
    assert geometry.dtype == jnp.float32
    assert per_ray(geometry).wavelength.shape == (2, 1, 1)
    assert per_ray(geometry).view_zenith.shape == (2, 1)
    np.testing.assert_array_equal(geometry.reversed().wavelength, colors)


def test_reversed_is_light_and_viewer_in_each_others_place() -> None:
    geometry = directions(10.0, 20.0, 30.0, 40.0)
    back = geometry.reversed()
    assert [float(angle[0]) for angle in back[:4]] == [30.0, 40.0, 10.0, 20.0]
    assert back.wavelength is None
    assert back.reversed() == geometry
