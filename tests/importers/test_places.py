"""Directions and axes of pieces of surface, and shapes that give their normals."""

import re

import numpy as np
import pytest
from cases import each
from hypothesis import given, settings
from hypothesis import strategies as st

import polar_bayes as pb
from polar_bayes.errors import CaptureError
from polar_bayes.importers.camera_geometry import local_geometry, mirror_direction
from polar_bayes.importers.normals import NormalMap, as_shape, fit_sphere

COMPONENT = st.floats(-1.0, 1.0)
VECTOR = st.tuples(COMPONENT, COMPONENT, st.floats(0.05, 1.0))
Z = np.array([0.0, 0.0, 1.0])


def unit(vector):
    return np.asarray(vector, float) / np.linalg.norm(vector)


@pytest.mark.thorough
@settings(deadline=None, max_examples=100)
@given(VECTOR, VECTOR, VECTOR, st.floats(0.0, 6.3))
def test_turning_the_camera_turns_nothing_but_its_own_axes(normal, view, light, turn):
    """Zeniths and azimuths belong to the surface; the s axis turns the other way in the frame."""
    n, v, ray = (unit(vector) for vector in (normal, view, light))
    cos, sin = np.cos(turn), np.sin(turn)
    around = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    before = local_geometry(n[None], v[None], ray[None])
    after = local_geometry((around @ n)[None], (around @ v)[None], (around @ ray)[None])
    for name in ("view_zenith", "light_zenith"):
        np.testing.assert_allclose(getattr(after, name), getattr(before, name), atol=1e-6)
    clear = min(np.linalg.norm(np.cross(n, v)), np.linalg.norm(np.cross(n, ray))) > 1e-3
    if clear and not (before.turned_away | before.in_shadow)[0]:
        moved = np.deg2rad(after.view_azimuth - before.view_azimuth)
        np.testing.assert_allclose(np.cos(moved), 1.0, atol=1e-9)
        first = before.cos_twice + 1j * before.sin_twice
        second = after.cos_twice + 1j * after.sin_twice
        np.testing.assert_allclose(second, first * np.exp(2j * turn), atol=1e-6)


def test_the_s_axis_stands_across_the_plane_of_normal_and_view():
    """A wall that leans to the right, seen from the front: s is up in the frame, at 90 degrees."""
    found = local_geometry(unit((0.5, 0.0, 0.8))[None], Z[None], unit((0.1, 0.2, 0.9))[None])
    assert found.cos_twice[0] == pytest.approx(-1.0)
    leaning = local_geometry(unit((0.0, 0.5, 0.8))[None], Z[None], unit((0.1, 0.2, 0.9))[None])
    assert leaning.cos_twice[0] == pytest.approx(1.0)  # up: s lies along x
    diagonal = local_geometry(unit((0.5, 0.5, 0.8))[None], Z[None], unit((0.1, 0.2, 0.9))[None])
    assert diagonal.sin_twice[0] == pytest.approx(-1.0)  # up right: s at 135 degrees


def test_azimuths_count_counterclockwise_around_the_normal_from_the_light():
    """Light to the right, camera up in the frame of the surface: 90 degrees further."""
    light, view = unit((1.0, 0.0, 1.0)), unit((0.0, 0.3, 1.0))
    found = local_geometry(Z[None], view[None], light[None])
    assert found.view_azimuth[0] == pytest.approx(90.0)
    assert found.light_azimuth[0] == 0.0
    assert found.light_zenith[0] == pytest.approx(45.0)
    behind = local_geometry(Z[None], unit((-0.3, 0.0, 1.0))[None], light[None])
    assert behind.view_azimuth[0] == pytest.approx(180.0)  # the mirror side


@pytest.mark.thorough
@each("light", [(0.3, 0.4, 0.8), (0.0, 0.0, 1.0)])
def test_straight_on_the_frame_is_that_of_the_light(light):
    """Continuous with a camera opposite to the light, and finite where both are on the normal."""
    ray = unit(light)
    found = local_geometry(Z[None], Z[None], ray[None])
    assert found.view_zenith[0] == 0.0
    if light[0]:
        near = unit(Z - 1e-4 * np.array([ray[0], ray[1], 0.0]))
        close = local_geometry(Z[None], near[None], ray[None])
        np.testing.assert_allclose(found.cos_twice, close.cos_twice, atol=1e-3)
        np.testing.assert_allclose(found.sin_twice, close.sin_twice, atol=1e-3)
    assert np.isfinite([found.cos_twice, found.sin_twice, found.view_azimuth]).all()


@pytest.mark.thorough
def test_what_is_seen_edge_on_is_not_seen():
    """No zenith reaches 90 degrees, which captures refuse."""
    found = local_geometry(
        np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 1e-12], [0.0, 0.6, 0.8]]),
        np.broadcast_to(Z, (3, 3)),
        np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.8, -0.6]]),
    )
    assert found.turned_away.tolist() == [True, True, False]
    assert found.in_shadow.tolist() == [False, False, True]
    assert (found.view_zenith < 90.0).all()
    assert (found.light_zenith < 90.0).all()


def test_a_mirror_sends_light_from_where_it_says():
    normal, view = unit((0.2, 0.3, 0.9)), Z
    vector = mirror_direction(normal, view)
    np.testing.assert_allclose(np.cross(unit(vector + view), normal), 0.0, atol=1e-12)
    assert np.linalg.norm(vector) == pytest.approx(1.0)


# --- shapes -----------------------------------------------------------------------------------


def test_a_sphere_points_away_from_its_center():
    shape = as_shape(pb.importers.Sphere(50.0, 60.0, 40.0))
    rows, columns = np.array([50.0, 26.0, 50.0, 95.0]), np.array([60.0, 60.0, 84.0, 60.0])
    found = shape.normals(rows, columns, 1)
    np.testing.assert_allclose(found[0], [0.0, 0.0, 1.0])
    np.testing.assert_allclose(found[1], [0.0, 0.6, 0.8])  # above the center: up
    np.testing.assert_allclose(found[2], [0.6, 0.0, 0.8])
    assert np.isnan(found[3]).all()


@pytest.mark.thorough
def test_squares_that_the_outline_cuts_are_outside():
    shape = as_shape((pb.importers.Sphere(50.0, 60.0, 40.0),))
    at = np.array([50.0]), np.array([98.0])
    assert np.isfinite(shape.normals(*at, 1)).all()
    assert np.isnan(shape.normals(*at, 8)).all()


@settings(deadline=None, max_examples=50)
@given(
    st.floats(-500.0, 2000.0),
    st.floats(-500.0, 2000.0),
    st.floats(5.0, 800.0),
    st.lists(st.floats(0.0, 6.28), min_size=4, max_size=12, unique=True),
)
def test_a_rim_tells_its_sphere(row, column, radius, around):
    around = np.sort(around)
    gaps = np.diff([*around, around[0] + 2.0 * np.pi])
    if gaps.max() > 3.0 or np.min(gaps) < 0.05:
        return  # points on one side only tell little
    rim = np.stack([row + radius * np.sin(around), column + radius * np.cos(around)], -1)
    found = fit_sphere(rim)
    np.testing.assert_allclose(
        [found.row, found.column, found.radius], [row, column, radius], atol=1e-4 * radius
    )


@pytest.mark.thorough
@each(
    ("rim", "said"),
    [
        (np.ones((3, 2)), "rim: it has 3 points; mark four points or more"),
        (np.ones((4, 3)), "rim: it is no list of points"),
        ("abc", "there is no such file"),
        ([[0, 0], [0, 100], [100, 0], [100, 100], [50, 50]], "off the best circle"),
    ],
)
def test_points_that_are_no_rim_are_refused(rim, said):
    with pytest.raises(CaptureError, match=re.escape(said)):
        fit_sphere(rim)


def test_normals_over_a_square_are_averaged_and_gaps_spread():
    values = np.broadcast_to(Z, (4, 6, 3)).copy()
    values[:2, :2] = [[[0.6, 0.0, 0.8], [-0.6, 0.0, 0.8]]] * 2
    values[3, 5] = 0.0
    found = NormalMap(values).normals(np.array([0.5, 2.5]), np.array([0.5, 4.5]), 2)
    np.testing.assert_allclose(found[0], Z, atol=1e-12)
    assert np.isnan(found[1]).all()


@each(
    ("make", "said"),
    [
        (lambda: pb.importers.Sphere(1.0, 2.0, 0.5), "Sphere: radius: it is 0.5; give 1 <= value"),
        (lambda: pb.importers.Sphere("a", 2.0, 5.0), "Sphere: row: it is 'a'"),
        (
            lambda: pb.importers.Spheres((3.0,)),
            "3.0 is no sphere; give Sphere(row, column, radius)",
        ),
        (lambda: pb.importers.Direction(0.0, 0.0, 0.0), "it points nowhere"),
        (lambda: pb.importers.Direction(np.nan, 0.0, 0.0), "Direction: x: it is nan"),
        (lambda: pb.importers.Position(0.0, 0.0, -1.0), "it is behind the surface"),
        (lambda: pb.importers.Highlight(-1.0, 2.0), "Highlight: row: it is -1.0"),
        (lambda: NormalMap(np.ones((2, 2, 2))), "normals: it holds float64 of shape (2, 2, 2)"),
        (lambda: NormalMap("none.npy"), "none.npy: there is no such file"),
    ],
)
def test_a_mistake_is_told_with_its_mend(make, said):
    with pytest.raises(CaptureError, match=re.escape(said)):
        make()
