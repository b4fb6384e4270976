"""Turbid half space: against five codes, the laws it obeys, and finite where it is hard."""

import itertools
from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import each
from digits import assert_finite, grid
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import Array
from optics import read

from polar_bayes.physics.geometry import cos_degrees, sin_degrees
from polar_bayes.physics.half_space import CLEAREST, Ray, refract, scatter

BATCH = 512
MONTE_CARLO = "vmc_coated_turbid.csv"


@jax.jit
def scatter_each(azimuth, cos_v, sin_v, cos_l, sin_l, i, q, u, a, p, n):
    return jnp.stack(scatter(Ray(cos_l, sin_l), Ray(cos_v, sin_v), azimuth, (i, q, u), a, p, n))


def in_batches(function: Callable, *columns: np.ndarray) -> np.ndarray:
    """Rows in groups of one size, so that a function compiles once for all tables."""
    columns = np.broadcast_arrays(*columns)
    rows = columns[0].size
    size = -(-rows // BATCH) * BATCH
    padded = [jnp.asarray(np.resize(column, size), float) for column in columns]
    groups = [slice(start, start + BATCH) for start in range(0, size, BATCH)]
    return np.concatenate([function(*(c[g] for c in padded)) for g in groups], axis=-1)[:, :rows]


def transmittance(degrees: np.ndarray, n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Half the sum and half the difference of Fresnel's transmittances for s and p."""
    cosine = np.cos(np.deg2rad(degrees))
    root = np.sqrt(n**2 - np.sin(np.deg2rad(degrees)) ** 2)
    s = 4.0 * cosine * root / (cosine + root) ** 2
    p = 4.0 * n**2 * cosine * root / (n**2 * cosine + root) ** 2
    return 0.5 * (s + p), 0.5 * (s - p)


def refracted(degrees: np.ndarray, n: np.ndarray) -> Ray:
    return refract(sin_degrees(degrees), cos_degrees(degrees), n)


def let_out(stokes: np.ndarray, view: np.ndarray, n: np.ndarray) -> np.ndarray:
    """The way out of `scatter`: Stokes vector inside to outside."""
    e0, e1 = transmittance(view, n)
    i, q, u = stokes
    return np.stack([i * e0 + q * e1, i * e1 + q * e0, u * np.sqrt(e0**2 - e1**2)]) / n**2


def under_beam(n, albedo, fraction, light, view, azimuth) -> np.ndarray:
    """Stokes vector outside for unit irradiance on the interface."""
    beam, seen = refracted(light, n), refracted(view, n)
    t0, t1 = transmittance(light, n)
    material = (1.0 / albedo - 1.0, fraction, n)
    found = in_batches(scatter_each, azimuth, *seen, *beam, t0, t1, 0.0 * t0, *material)
    return let_out(found, view, n)


def under_sky(n, albedo, fraction, view) -> np.ndarray:
    """Stokes vector outside for a sky of unit radiance: all its beams together.

    Scattering goes once or twice around with azimuth, which these two sum up to nothing.
    """
    node, weight = np.polynomial.legendre.leggauss(12)
    cosine = (0.5 * (node + 1.0)) ** 2
    irradiance = np.pi * (0.5 * (node + 1.0)) * weight * cosine
    light = np.rad2deg(np.arccos(cosine))[:, None, None]
    columns = (n, albedo, fraction, light, view, np.array([[45.0], [135.0]]))
    columns = np.broadcast_arrays(*columns)
    beams = under_beam(*(column.ravel() for column in columns)).reshape(3, *columns[0].shape)
    i, q, _ = np.einsum("sbav,b->sv", beams, irradiance)
    return np.stack([i, q, 0.0 * i])


def differences(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Relative in intensity; absolute in the signed, normalized components."""
    return np.concatenate([found[:1] / true[:1] - 1.0, (found / found[0] - true / true[0])[1:]])


def subsets(*columns: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    keys = np.stack(columns, axis=1)
    for key in np.unique(keys, axis=0):
        yield key, np.all(keys == key, axis=1)


def loses_light(table: np.ndarray) -> np.ndarray:
    """Rows of a clear, polarizing body: the table's README says why."""
    return (table[1] == 0.99) & (table[2] == 1.0)


def test_beams_agree_with_the_monte_carlo() -> None:
    """Per index, albedo and fraction: q and u within .0025 rms, intensity within .6 %.

    The table's standard errors are about as large. Where it loses light, its polarization is met
    within .015 rms, and its intensity is not asked.
    """
    table = read(MONTE_CARLO)
    table = table[:, table[3] >= 0.0]
    n, albedo, fraction, light = table[:4]
    error = differences(under_beam(n, albedo, fraction, light, *table[6:8]), table[8:11])
    for key, rows in subsets(n, albedo, fraction, loses_light(table)):
        intensity, q, u = np.sqrt(np.mean(error[:, rows] ** 2, axis=1))
        assert max(q, u) < (0.015 if key[3] else 0.0025), key
        assert key[3] or intensity < 0.006, key


def test_the_monte_carlo_loses_light_only_where_it_is_excused() -> None:
    table = read(MONTE_CARLO)
    table = table[:, table[3] >= 0.0]
    lost = transmittance(table[3], table[0])[0] - table[4] - table[5]
    assert np.all(np.abs(lost[~loses_light(table)]) < 0.004)
    assert np.all(lost[loses_light(table)] > 0.04)


def test_a_sky_agrees_with_the_monte_carlo() -> None:
    table = read(MONTE_CARLO)
    table = table[:, (table[3] < 0.0) & ~loses_light(table)]
    n, albedo, fraction = table[:3]
    error = differences(under_sky(n, albedo, fraction, table[6]) / np.pi, table[8:11])
    for key, rows in subsets(n, albedo, fraction):
        intensity, q, _ = np.sqrt(np.mean(error[:, rows] ** 2, axis=1))
        assert intensity < 0.006, key
        assert q < 0.003, key


def test_beams_agree_with_doubling() -> None:
    """All four Stokes parameters, 36 directions, index 1 to 2, albedo to .9999."""
    n, albedo, fraction, light, view, azimuth, *stokes = read("doubling_coated_rayleigh.csv")
    found = under_beam(n, albedo, fraction, light, view, azimuth)
    error = np.abs(differences(found, np.stack(stokes)))
    assert np.all(error < np.array([[0.0015], [0.0013], [0.0013]]))
    # Without circular polarization from the interface, and with little Rayleigh scattering.
    assert np.all(error[:, (n == 1.0) | (fraction == 0.5)] < 4e-4)


def test_beams_agree_with_radiative_transfer_without_an_interface() -> None:
    albedo, fraction, light, view, azimuth, *stokes = read("sasktran2_semiinfinite_rayleigh_n1.csv")
    found = under_beam(np.ones_like(albedo), albedo, fraction, light, view, 180.0 - azimuth)
    error = np.abs(differences(found, np.stack(stokes)))
    assert np.all(error < np.array([[4e-4], [2e-4], [2e-4]]))


def test_a_sky_agrees_with_a_renderer() -> None:
    """The table holds all light, with what the interface reflects; 4 of its standard errors."""
    n, albedo, fraction, view, s0, s1, _, _, error_0, error_1, _ = read(
        "eradiate_coated_rayleigh_uniform.csv"
    )
    e0, e1 = transmittance(view, n)
    found = under_sky(n, albedo, fraction, view)
    intensity, q = found[0] + 1.0 - e0, found[1] - e1
    assert np.all(np.abs(intensity - s0) < 4.0 * error_0)
    assert np.all(np.abs(q - s1) < 4.0 * error_1)
    np.testing.assert_allclose(q / intensity, s1 / s0, atol=0.002)


def hemisphere(*columns: np.ndarray) -> tuple[list[np.ndarray], Callable]:
    """View zenith angles for every row, and the integral over them times 2 mu dmu."""
    node, weight = np.polynomial.legendre.leggauss(16)
    cosine = (0.5 * (node + 1.0)) ** 2
    zenith = np.repeat(np.rad2deg(np.arccos(cosine)), columns[0].size)
    tiled = [np.tile(column, cosine.size) for column in columns]
    weight = weight * cosine * (node + 1.0)
    return [zenith, *tiled], lambda values: weight @ values.reshape(cosine.size, -1)


def test_albedo_agrees_with_adding_doubling() -> None:
    """Of a beam along the normal and of a sky, with the interface's own reflection."""
    table = read("iad_semiinfinite_albedo.csv")
    n, _, albedo, normal, diffuse = table[:5, table[1] == 0.0]
    (view, ns, albedos), integral = hemisphere(n, albedo)
    none = np.zeros_like(view)
    found = np.pi * integral(under_beam(ns, albedos, none, none, view, 180.0)[0])
    np.testing.assert_allclose(found + ((n - 1.0) / (n + 1.0)) ** 2, normal, rtol=1e-3)
    found = integral(under_sky(ns, albedos, none, view)[0])
    reflected = integral(1.0 - transmittance(view, ns)[0])
    # A black body behind the interface reflects .0009 more than the table's.
    np.testing.assert_allclose(found + reflected, diffuse, rtol=0.01)


def test_light_is_neither_made_nor_lost() -> None:
    """A clear body returns what entered, but for the floor of absorption; a dark one returns less.

    Light is returned the more often, the higher the index: so it is absorbed the more.
    """
    n, fraction, light, absorption = grid(
        float, [1.0, 1.33, 2.0], [0.0, 0.5, 1.0], [0.0, 50.0, 80.0], [CLEAREST, 0.1, 10.0]
    )
    (view, ns, fractions, lights, albedos), integral = hemisphere(
        n, fraction, light, 1.0 / (1.0 + absorption)
    )
    # Orders 1 and 2 around the normal cancel in the mean of four azimuths.
    azimuths = (45.0, 135.0, 225.0, 315.0)
    outside = sum(under_beam(ns, albedos, fractions, lights, view, az)[0] for az in azimuths)
    returned = np.pi / 4.0 * integral(outside) / transmittance(light, n)[0]
    assert np.all(returned < 1.0)
    assert np.all(returned > 0.0)
    clear = absorption == CLEAREST
    assert np.all(returned[clear & (n == 1.0)] > 0.96)
    assert np.all(returned[clear & (n == 2.0)] > 0.86)
    assert np.all(returned[absorption == 10.0] < 0.035)


def mueller(light: float, view: float, azimuth: float, *material: float) -> np.ndarray:
    """3 x 3 matrix inside, from (I, Q, U) that enter to those that leave."""
    entering = np.eye(3)
    rays = [np.full(3, x) for x in (*refracted(view, 1.5), *refracted(light, 1.5))]
    return in_batches(scatter_each, azimuth, *rays, *entering, *material, 1.5)


zenith, turn = st.floats(0.0, 89.9), st.floats(-180.0, 180.0)
materials = st.tuples(st.floats(0.0, 20.0), st.floats(0.0, 1.0))


@given(light=zenith, view=zenith, azimuth=turn, material=materials)
@settings(deadline=None, max_examples=25)
def test_viewer_and_light_may_change_places(light, view, azimuth, material) -> None:
    """Helmholtz, for every polarization: the matrix is transposed."""
    there = mueller(light, view, azimuth, *material)
    back = mueller(view, light, -azimuth, *material)
    np.testing.assert_allclose(there, back.T, rtol=1e-9, atol=1e-11 * there[0, 0])


@given(light=zenith, view=zenith, azimuth=turn, material=materials)
@settings(deadline=None, max_examples=25)
def test_the_other_side_of_the_plane_is_a_mirror_image(light, view, azimuth, material) -> None:
    left, right = (mueller(light, view, side * azimuth, *material) for side in (1.0, -1.0))
    sign = np.diag([1.0, 1.0, -1.0])
    np.testing.assert_allclose(left, sign @ right @ sign, rtol=1e-9, atol=1e-11 * left[0, 0])


@given(light=zenith, view=zenith, azimuth=turn, absorption=st.floats(0.0, 20.0))
@settings(deadline=None, max_examples=25)
def test_without_rayleigh_scattering_inner_light_is_unpolarized(light, view, azimuth, absorption):
    found = mueller(light, view, azimuth, absorption, 0.0)
    np.testing.assert_allclose(found[1:], 0.0, atol=1e-15)
    np.testing.assert_array_equal(found[:, 2], 0.0)


@given(light=zenith, view=zenith, azimuth=turn, fraction=st.floats(0.0, 1.0))
@settings(deadline=None, max_examples=25)
def test_a_black_body_scatters_once(light, view, azimuth, fraction) -> None:
    """Rayleigh's law from vectors: a dipole along the field, seen through two analyzers."""

    def frame(ray: Ray, turned: float) -> np.ndarray:
        x, y = np.cos(np.deg2rad(turned)), np.sin(np.deg2rad(turned))
        direction = np.array([ray.sine * x, ray.sine * y, ray.cosine])
        s = np.array([-y, x, 0.0])
        return np.stack([s, np.cross(s, direction)])

    beam, seen = refracted(light, 1.5), refracted(view, 1.5)
    amplitude = frame(seen, 0.0) @ frame(beam, azimuth).T
    coherency = np.array([np.eye(2), np.diag([1.0, -1.0]), np.eye(2)[::-1]])
    law = 0.75 * np.einsum(
        "kij,il,jm,nlm->kn", coherency, amplitude, amplitude, coherency, optimize=True
    )
    law = fraction * law + (1.0 - fraction) * np.diag([1.0, 0.0, 0.0])
    found = mueller(light, view, azimuth, 1e7, fraction)
    expected = 1e-7 / (4.0 * np.pi * float(beam.cosine + seen.cosine)) * law
    np.testing.assert_allclose(found, expected, atol=1e-6 * expected[0, 0])


@pytest.mark.thorough
def test_absorption_has_a_floor_and_nothing_may_be_turned_back() -> None:
    rays = [jnp.array([0.7]), jnp.array([0.7])]
    entering = tuple(jnp.array([x]) for x in (0.9, 0.1, 0.0))

    def light(absorption: float, n: float | None) -> np.ndarray:
        index = None if n is None else jnp.array([n])
        azimuth, material = jnp.array([150.0]), (jnp.array([absorption]), jnp.array([0.5]))
        return np.stack(
            jax.jit(scatter)(Ray(*rays), Ray(*rays), azimuth, entering, *material, index)
        )

    np.testing.assert_array_equal(light(0.0, 1.5), light(CLEAREST, 1.5))
    np.testing.assert_allclose(light(0.3, None), light(0.3, 1.0), rtol=1e-5)
    assert light(0.3, None)[0] < light(0.3, 1.5)[0]


@pytest.mark.thorough
def test_materials_broadcast_against_views() -> None:
    view, azimuth = np.array([0.0, 30.0, 60.0]), np.array([180.0, 90.0, 30.0])
    absorption, n = np.array([[0.1], [2.0]]), np.array([[1.4], [1.6]])
    seen, beam = refracted(view, n), refracted(40.0 + 0.0 * view, n)
    few = jax.jit(scatter)(beam, seen, azimuth, (1.0, 0.1, 0.05), absorption, 0.5, n)
    each = np.broadcast_arrays(absorption + 0.0 * view, n + 0.0 * view)
    many = jax.jit(scatter)(beam, seen, azimuth, (1.0, 0.1, 0.05), each[0], 0.5, each[1])
    np.testing.assert_allclose(few, many, rtol=1e-12)


@pytest.mark.thorough
@each("dtype", [np.float32, np.float64])
def test_value_gradient_and_hessian_are_finite(dtype: type) -> None:
    """At both ends of every input, together; a Hessian times a vector hides nothing.

    Double precision, whose range is wider, takes the gradient alone: the Hessian compiles slowly.
    """
    directions = [
        (0.0, 0.0, 180.0), (0.0, 30.0, 180.0), (30.0, 0.0, 0.0), (1e-6, 1e-6, 90.0),
        (45.0, 45.0, 180.0), (60.0, 60.0, 0.0), (90.0, 20.0, 45.0), (20.0, 90.0, 180.0),
        (90.0, 90.0, 180.0), (90.0, 90.0, 0.0), (-10.0, 40.0, 530.0),
    ]  # fmt: skip
    materials = itertools.product(
        (0.0, CLEAREST, 0.3, 1e4), (0.0, 0.5, 1.0), (1.0, 1.0 + 1e-6, 1.01, 1.5, 2.42)
    )
    polarizations = ((0.0, 0.0), (0.6, 0.8))
    rows = itertools.product(materials, directions, polarizations)
    inputs = np.array([(*d, *polarization, *m) for m, d, polarization in rows], dtype)
    generator = np.random.default_rng(3)
    weights = jnp.asarray(generator.normal(size=3), dtype)
    tangent = jnp.asarray(generator.normal(size=inputs.shape[1]), dtype)

    def total(row: Array) -> tuple[Array, Array]:
        view, light, azimuth, q, u, a, p, n = (row[i : i + 1] for i in range(8))
        seen, beam = refracted(view, n), refracted(light, n)
        from_beam = scatter(beam, seen, azimuth, (jnp.ones_like(q), q, u), a, p, n)
        values = jnp.concatenate(from_beam)
        return values @ weights, values

    def derivatives(row: Array) -> tuple[Array, ...]:
        gradient = jax.grad(total, has_aux=True)
        if dtype == np.float64:
            return gradient(row)[::-1]
        slope, curvature, values = jax.jvp(gradient, (row,), (tangent,), has_aux=True)
        return values, slope, curvature

    results = jax.jit(jax.vmap(derivatives))(jnp.asarray(inputs))
    assert_finite(results, inputs, dtype)
    intensity, q, u = results[0].T
    assert np.all(np.hypot(q, u) <= intensity * (1.0 + 1e-3))
