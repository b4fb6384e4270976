"""Closed forms agree with 50-digit arithmetic to 1e-10 in double and 1e-4 in single precision."""

import mpmath as mp
import numpy as np
import pytest
from hard_cases import multiprecision as twin
from hard_cases.catalogue import MATERIALS, Material, every_case

from polar_bayes.physics import fresnel
from polar_bayes.physics.geometry import Geometry, cos_degrees, mirror_facet, sin_degrees
from polar_bayes.physics.microfacet import GGX, Beckmann
from polar_bayes.physics.mixing import DopMixing, StokesMixing
from polar_bayes.physics.scene import Scene
from polar_bayes.physics.subsurface import Lambertian, body_loss, half_space_loss
from polar_bayes.physics.surface import RoughSurface, SmoothSurface

BOUND = {np.float64: 1e-10, np.float32: 1e-4}
PRECISIONS = pytest.mark.parametrize("dtype", [np.float64, np.float32])


@pytest.fixture(autouse=True)
def fifty_digits() -> object:
    with mp.workdps(twin.DIGITS):
        yield


def relative_error(value: object, truth: list, floor: float = 1e-60) -> np.ndarray:
    """|value - truth| / max(|truth|, floor), in 50 digits; 0/0 counts as no error."""
    errors = []
    for one, true in zip(np.asarray(value).ravel().tolist(), truth, strict=True):
        gap, size = abs(mp.mpf(one) - true), max(abs(true), mp.mpf(floor))
        errors.append(float(gap / size) if gap else 0.0)
    return np.array(errors)


def assert_accurate(
    value: object, truth: list, dtype: type, names: list[str], floor: float = 1e-60
) -> None:
    assert np.asarray(value).dtype == dtype
    error = relative_error(value, truth, floor)
    worst = int(np.argmax(error))
    assert error[worst] <= BOUND[dtype], f"{error[worst]:.1e} at {names[worst]}"


def unique_directions(dtype: type) -> tuple[list[str], np.ndarray]:
    cases = every_case(dtype)
    first = [i for i, name in enumerate(cases.names) if name.endswith("/ ordinary")]
    return [cases.names[i] for i in first], cases.directions[first]


def geometry_of(directions: np.ndarray) -> Geometry:
    view, light, azimuth = (np.ascontiguousarray(column)[:, None] for column in directions.T)
    return Geometry(view, np.zeros_like(view), light, azimuth)


@PRECISIONS
def test_fresnel(dtype: type) -> None:
    angles = np.array(
        [0.0, 1e-6, 0.01, 1.0, 30.0, 56.3, 56.309932474020215, 60.0, 80.0, 89.0, 89.99], dtype
    )
    indices = np.array([1.0, 1.0 + 1e-6, 1.0001, 1.01, 1.2, 1.33, 1.5, 2.0, 2.42], dtype)
    angle, index = (grid.ravel() for grid in np.meshgrid(angles, indices))
    names = [f"{a} degrees, n = {n}" for a, n in zip(angle, index, strict=True)]
    truth = [
        twin.interface(twin.cosine(a), mp.mpf(float(n))) for a, n in zip(angle, index, strict=True)
    ]
    c, b = cos_degrees(angle), sin_degrees(angle) ** 2
    mean, contrast = fresnel.reflection(c, b, index)
    relative_mean, relative_contrast = fresnel.relative_reflection(c, b, index)
    step = fresnel.index_step(index)
    reflected = fresnel.reflection_polarization(c, b, index)
    for value, field in (
        (mean, "mean"),
        (contrast * b, "difference"),
        (step * relative_mean, "mean"),
        (step * relative_contrast * b, "difference"),
        (fresnel.transmission(c, index), "transmitted"),
        (reflected, "reflected_polarization"),
        (fresnel.exit_polarization(c, b, index), "exit_polarization"),
    ):
        assert_accurate(value, [getattr(one, field) for one in truth], dtype, names)


@PRECISIONS
def test_hemisphere(dtype: type) -> None:
    """Rounding only: the twin takes the same nodes. Their own error is tested with Fresnel."""
    indices = np.array([1.0, 1.0 + 1e-6, 1.001, 1.2, 1.33, 1.5, 2.0, 2.42], dtype)
    names = [f"n = {n}" for n in indices]
    nodes = [mp.mpf(float(x)) for x in fresnel.HEMISPHERE_COSINES]
    weights = [mp.mpf(float(w)) for w in fresnel.HEMISPHERE_WEIGHTS]
    truth = [twin.hemispherical_reflection(mp.mpf(float(n)), nodes, weights) for n in indices]
    inside = [1 - (1 - fe) / mp.mpf(float(n)) ** 2 for fe, n in zip(truth, indices, strict=True)]
    assert_accurate(fresnel.hemispherical_reflection(indices), truth, dtype, names)
    assert_accurate(fresnel.internal_reflection(indices), inside, dtype, names)
    assert_accurate(fresnel.escape(indices), [1 - one for one in inside], dtype, names)


@PRECISIONS
def test_mirror_facet(dtype: type) -> None:
    """The turn of the s axis is measured against the squared sine: it passes through zero."""
    names, directions = unique_directions(dtype)
    truth = [twin.facet(*direction) for direction in directions]
    found = mirror_facet(geometry_of(directions))
    for field in ("cos_incidence", "sin_squared"):
        assert_accurate(getattr(found, field), [getattr(one, field) for one in truth], dtype, names)
    # A facet without tilt is known to the rounding of the zenith angles, 1e-16 or 1e-7, squared.
    floor = 1e-30 if dtype == np.float64 else 1e-12
    tilt = [one.tan_squared_tilt for one in truth]
    assert_accurate(found.tan_squared_tilt, tilt, dtype, names, floor)
    for field in ("along_s", "across_s"):
        error = [
            abs(mp.mpf(value) - getattr(one, field)) / one.sin_squared if one.sin_squared else 0
            for value, one in zip(
                np.asarray(getattr(found, field)).ravel().tolist(), truth, strict=True
            )
        ]
        assert max(error) <= BOUND[dtype], names[int(np.argmax(error))]


@PRECISIONS
@pytest.mark.parametrize("distribution", [Beckmann(), GGX()])
def test_distribution(distribution: Beckmann | GGX, dtype: type) -> None:
    """Where the density is within 1e-30 of its peak; below, Beckmann's stops falling."""
    kind = type(distribution).__name__.lower()
    tan_squared = np.array([0.0, 1e-12, 1e-6, 1e-3, 0.01, 0.1, 1.0, 10.0, 1e4, 3e9], dtype)
    roughness = np.array([0.0, 1e-5, 1e-3, 0.02, 0.1, 0.3, 1.0, 3.0], dtype)
    tan_squared, roughness = (g.ravel() for g in np.meshgrid(tan_squared, roughness))
    names = [f"tan^2 {t}, r {r}" for t, r in zip(tan_squared, roughness, strict=True)]
    pairs = [
        (mp.mpf(float(t)), mp.mpf(float(r))) for t, r in zip(tan_squared, roughness, strict=True)
    ]
    density = [getattr(twin, f"{kind}_density")(*pair) for pair in pairs]
    peak = [getattr(twin, f"{kind}_density")(mp.mpf(0), pair[1]) for pair in pairs]
    error = relative_error(distribution.density(tan_squared, roughness), density)
    bright = np.array([d > p * mp.mpf("1e-30") for d, p in zip(density, peak, strict=True)])
    assert np.max(error[bright]) <= BOUND[dtype], names[int(np.argmax(error * bright))]
    shadowing = [getattr(twin, f"{kind}_shadowing")(*pair) for pair in pairs]
    assert_accurate(distribution.shadowing(tan_squared, roughness), shadowing, dtype, names)


@PRECISIONS
def test_body(dtype: type) -> None:
    absorption = np.array([0.0, 1e-4, 1e-3, 0.1, 1.0, 10.0, 1e3, 1e6], dtype)
    index = np.full_like(absorption, 1.5)
    names = [f"a = {a}" for a in absorption]
    albedo = [twin.half_space_albedo(mp.mpf(float(a))) for a in absorption]
    inside = mp.mpf(float(fresnel.internal_reflection(index)[0]))
    behind = [(1 - inside) * rd / (1 - inside * rd) for rd in albedo]
    assert_accurate(half_space_loss(absorption), [1 - rd for rd in albedo], dtype, names)
    # The floor of absorption is rounded to the precision before its square root is taken.
    assert_accurate(
        body_loss(absorption, fresnel.escape(index)), [1 - rb for rb in behind], dtype, names
    )


def surface_truth(direction: np.ndarray, n: mp.mpf, roughness: mp.mpf) -> tuple:
    """Intensity, q and u of a Beckmann surface under a point source."""
    facet = twin.facet(*direction)
    fresnel_ = twin.interface(facet.cos_incidence, n)
    slopes = [(twin.sine(z) / twin.cosine(z)) ** 2 for z in direction[:2]]
    shown = twin.beckmann_density(facet.tan_squared_tilt, roughness)
    for slope in slopes:
        shown *= twin.beckmann_shadowing(slope, roughness)
    shown /= 4 * twin.cosine(direction[0])
    per_sine = fresnel_.reflected_polarization / facet.sin_squared if facet.sin_squared else 0
    return shown * fresnel_.mean, per_sine * facet.along_s, -per_sine * facet.across_s


@PRECISIONS
def test_scene_of_a_rough_surface(dtype: type) -> None:
    """Intensity against its own size, q and u against the degree of polarization."""
    cases = every_case(dtype)
    parameters = dict(zip(Material._fields, cases.materials.T, strict=True))
    light = Scene(RoughSurface(Beckmann())).light(parameters, geometry_of(cases.directions))
    for i, name in enumerate(cases.names):
        roughness, _, _, n = (mp.mpf(float(value)) for value in cases.materials[i])
        intensity, q, u = surface_truth(cases.directions[i], n, roughness)
        length = mp.sqrt(q**2 + u**2)
        for value, true in ((light.q[i, 0], q), (light.u[i, 0], u)):
            assert abs(mp.mpf(float(value)) - true) <= BOUND[dtype] * length, name
        # A highlight 1e-5 wide and 1e-30 of its peak bright is darker than any reading, and its
        # slope is squared before it is divided by the width.
        peak = twin.beckmann_density(mp.mpf(0), roughness)
        if intensity > mp.mpf("1e-25") * peak and (dtype == np.float64 or roughness >= 1e-3):
            error = abs(mp.mpf(float(light.intensity[i, 0])) - intensity)
            assert error <= BOUND[dtype] * intensity, name


@PRECISIONS
@pytest.mark.parametrize("mixing", [StokesMixing(), DopMixing(), DopMixing(signed=True)])
def test_scene_of_a_plate_over_a_diffuse_body(
    mixing: StokesMixing | DopMixing, dtype: type
) -> None:
    """q and u against the degree of polarization of the stronger part."""
    cases = every_case(dtype)
    keep = [i for i, name in enumerate(cases.names) if cases.materials[i, 0] == dtype(0.1)]
    directions, materials = cases.directions[keep], cases.materials[keep]
    scene = Scene(SmoothSurface(), Lambertian(albedo=0.5), mixing)
    parameters = dict(zip(Material._fields, materials.T, strict=True))
    light = scene.light(parameters, geometry_of(directions))
    for i, (direction, material) in enumerate(zip(directions, materials, strict=True)):
        _, b, _, n = (mp.mpf(float(value)) for value in material)
        facet = twin.facet(*direction)
        mirror = twin.interface(facet.cos_incidence, n)
        per_sine = mirror.reflected_polarization / facet.sin_squared if facet.sin_squared else 0
        first = mirror.mean, per_sine * facet.along_s, -per_sine * facet.across_s
        cos_view, cos_light = twin.cosine(direction[0]), twin.cosine(direction[1])
        out, into = twin.interface(cos_view, n), twin.interface(cos_light, n)
        brightness = cos_light * into.transmitted * out.transmitted / (2 * mp.pi)
        second = brightness, -out.exit_polarization, mp.mpf(0)
        intensity, q, u = mixed(mixing, b, first, second)
        size = max(mp.hypot(first[1], first[2]), abs(second[1]))
        # The tip of the degree of polarization is rounded off at 1e-12; and a trace of the other
        # part, eps^1.25, moves the share where a fraction comes close to that trace.
        trace = float(np.finfo(dtype).eps) ** 1.25 / max(min(b, 1 - b), mp.mpf("1e-30"))
        slack = (BOUND[dtype] + (trace if 0 < b < 1 else 0)) * size + mp.mpf("2e-12")
        name = cases.names[keep[i]]
        assert abs(mp.mpf(float(light.q[i, 0])) - q) <= slack, name
        assert abs(mp.mpf(float(light.u[i, 0])) - u) <= slack, name
        assert abs(mp.mpf(float(light.intensity[i, 0])) - intensity) <= (
            BOUND[dtype] * intensity
        ), name


def mixed(mixing: StokesMixing | DopMixing, b: mp.mpf, first: tuple, second: tuple) -> tuple:
    """Intensity, q and u of the mixture, by the definition."""
    intensity = (1 - b) * first[0] + b * second[0]
    if isinstance(mixing, StokesMixing):
        if not intensity:
            return intensity, first[1], first[2]
        parts = [(1 - b) * first[0] * first[k] + b * second[0] * second[k] for k in (1, 2)]
        return intensity, parts[0] / intensity, parts[1] / intensity
    if mixing.signed:
        return intensity, *((1 - b) * first[k] + b * second[k] for k in (1, 2))
    length = mp.hypot(first[1], first[2])
    total = (1 - b) * length + b * mp.hypot(second[1], second[2])
    if length < mp.mpf("1e-12"):
        return intensity, total, mp.mpf(0)
    return intensity, total * first[1] / length, total * first[2] / length


def test_every_material_of_the_catalogue_is_named_once() -> None:
    assert len(set(MATERIALS.values())) == len(MATERIALS)
