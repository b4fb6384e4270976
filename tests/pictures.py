"""Frames of a camera from the package's scenes, by vectors and field axes: no Stokes is turned.

Light of each piece of surface is a coherency matrix in space, from the scene's Stokes vector and
the axes of docs/conventions.md; a polarizer lets pass what lies along its axis. The azimuth of each
piece counts from a tangent of its own, drawn at random, which nothing must depend on.
"""

import numpy as np

import polar_bayes as pb

SCENE = pb.Scene(
    surface=pb.RoughSurface(pb.GGX(), way_out=pb.physics.SmoothExit()),
    subsurface=pb.Lambertian(),
    mixing=pb.StokesMixing(),
)
TRUTH = {"roughness": 0.4, "subsurface_fraction": 0.1, "refractive_index": 1.5}
SHAPE = (40, 48)
BALL = pb.importers.Sphere(19.3, 23.8, 17.5)  # no pixel faces the camera exactly
LAMP = pb.importers.Direction(0.4, 0.7, 0.8)
FULL = 1000.0
FOUR = (0.0, 45.0, 90.0, 135.0)
QUIET = pb.importers.Detector(saturation_level=FULL, gain=1e-6, read_noise=0.0, relative_error=0.0)
"""A detector without noise."""


def ball_normals(shape=SHAPE, ball=BALL):
    """Normals of a sphere in each pixel, NaN beside it."""
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    x, y = (columns - ball.column) / ball.radius, (ball.row - rows) / ball.radius
    square = x**2 + y**2
    z = np.sqrt(np.where(square < 1.0, 1.0 - square, np.nan))
    return np.where(np.isfinite(z)[..., None], np.stack([x, y, z], -1), np.nan)


def far(vector, shape=SHAPE):
    """One direction for all pixels."""
    vector = np.asarray(vector, float)
    return np.broadcast_to(vector / np.linalg.norm(vector), (*shape, 3))


def near(place, shape=SHAPE):
    """Directions from each pixel to a place, in pixels from the center of the frame."""
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    x, y = columns - (shape[1] - 1) / 2.0, (shape[0] - 1) / 2.0 - rows
    vector = np.asarray(place, float) - np.stack([x, y, 0.0 * x], -1)
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)


def unit(vector):
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)


def degrees_between(first, second):
    return np.rad2deg(np.arccos(np.clip(np.sum(first * second, -1), -1.0, 1.0)))


def geometry_of(normals, view, light, seed=0):
    """Zeniths and azimuths around each normal, counted from a random tangent."""
    tangent = unit(np.cross(normals, np.random.default_rng(seed).normal(size=normals.shape)))
    other = np.cross(normals, tangent)

    def azimuth(ray):
        return np.rad2deg(np.arctan2(np.sum(ray * other, -1), np.sum(ray * tangent, -1)))

    return pb.Geometry.from_degrees(
        view_zenith=degrees_between(normals, view),
        view_azimuth=azimuth(view),
        light_zenith=degrees_between(normals, light),
        light_azimuth=azimuth(light),
    )


def coherency(normals, view, light, scene=SCENE, truth=TRUTH):
    """Matrix of mean field products of the light of each pixel, (row, column, 3, 3); NaN beside."""
    lit = np.isfinite(normals).all(-1)
    lit &= (np.sum(np.where(lit[..., None], normals, 0.0) * light, -1) > 1e-3) & (
        np.sum(np.where(lit[..., None], normals, 0.0) * view, -1) > 1e-3
    )
    n, v, ray = normals[lit], view[lit], light[lit]
    S0, S1, S2 = np.moveaxis(np.asarray(scene.stokes(truth, geometry_of(n, v, ray))), -1, 0)
    s = unit(np.cross(n, v))
    second = np.cross(v, s)

    def product(a, b):
        return a[:, :, None] * b[:, None, :]

    found = np.full((*normals.shape[:2], 3, 3), np.nan)
    found[lit] = 0.5 * (
        (S0 + S1)[:, None, None] * product(s, s)
        + (S0 - S1)[:, None, None] * product(second, second)
        + S2[:, None, None] * (product(s, second) + product(second, s))
    )
    return found


def behind_polarizer(matrix, angle, view):
    """Light behind a polarizer whose axis is at an angle from the camera's x, in each pixel.

    The axis follows the ray through the lens: it is carried from z to the view by the rotation
    about the line at right angles to both (Rodrigues).
    """
    axis = np.array([np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle)), 0.0])
    z = np.array([0.0, 0.0, 1.0])
    about = np.cross(z, view)
    cosine = view[..., 2:]
    carried = (
        axis * cosine
        + np.cross(about, axis)
        + about * np.sum(about * axis, -1, keepdims=True) / (1.0 + cosine)
    )
    return np.einsum("yxi,yxij,yxj->yx", carried, matrix, carried)


def frames(angles, *, normals=None, view=None, light=None, full=FULL, **asked):
    """Frames in counts without noise; no light where there is no surface or it is not lit."""
    normals = ball_normals() if normals is None else normals
    shape = normals.shape[:2]
    view = far((0.0, 0.0, 1.0), shape) if view is None else view
    light = far((LAMP.x, LAMP.y, LAMP.z), shape) if light is None else light
    matrix = coherency(normals, view, light, **asked)
    passed = np.stack([behind_polarizer(matrix, angle, view) for angle in angles])
    # Half of full scale for the brightest place.
    return np.nan_to_num(passed * 0.5 * full / np.nanmax(passed))


def predicted(capture, where=...):
    """Readings of the scene at the capture's own directions, in the pixels of a mask."""
    names = ("view_zenith", "view_azimuth", "light_zenith", "light_azimuth")
    geometry = pb.Geometry.from_degrees(**{name: capture[name].values for name in names})
    said = SCENE.predict(TRUTH, geometry)
    return {name: np.asarray(values)[where] for name, values in said.items()}


def even(normal, shape=SHAPE):
    """One normal for all pixels."""
    return np.broadcast_to(unit(np.asarray(normal, float)), (*shape, 3))


def mosaic(frames, layout=((90.0, 45.0), (135.0, 0.0))):
    """The mosaic of four frames, each pixel behind its own polarizer."""
    found = np.zeros(frames[0].shape)
    for row, column in np.ndindex(2, 2):
        frame = frames[FOUR.index(layout[row][column])]
        found[row::2, column::2] = frame[row::2, column::2]
    return found
