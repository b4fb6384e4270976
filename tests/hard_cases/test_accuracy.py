"""Closed forms agree with 50-digit arithmetic to 1e-10 in double and 1e-4 in single precision."""

import itertools

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from cases import each
from digits import BOUND, assert_accurate, digitwise, exactly, grid
from hard_cases import multiprecision as twin
from hard_cases.catalogue import MATERIALS, WAVELENGTH, Material, every_case
from optics import light_of, one_by_one, stokes_of

from polar_bayes.physics.coat import ClearCoat, CoatStack, ThinFilm
from polar_bayes.physics.dispersion import Cauchy, Sellmeier
from polar_bayes.physics.facets import FacetQuadrature, Microsurface
from polar_bayes.physics.geometry import Geometry, cos_degrees, mirror_facet, sin_degrees
from polar_bayes.physics.illumination import PointSource
from polar_bayes.physics.instrument import STEEPEST_ZENITH, BeamOverlap, tilted_direction
from polar_bayes.physics.microfacet import (
    GGX,
    AnisotropicSlopes,
    Beckmann,
    HeightCorrelatedShadowing,
    NoShadowing,
    SeparableShadowing,
)
from polar_bayes.physics.mixing import DopMixing, StokesMixing
from polar_bayes.physics.scene import Scene
from polar_bayes.physics.stack import Layer, Stack
from polar_bayes.physics.stokes import Light, LinearPolarization
from polar_bayes.physics.subsurface import Lambertian, body_loss, half_space_loss
from polar_bayes.physics.surface import RoughSurface, SmoothSurface

PRECISIONS = each("dtype", [np.float64, np.float32], quick=1)

pytestmark = pytest.mark.usefixtures("fifty_digits")

reflect, transmit = jax.jit(Stack.reflection), jax.jit(Stack.transmission)


def unique_directions(dtype: type) -> tuple[list[str], np.ndarray]:
    cases = every_case(dtype, exact=True)
    first = [name.endswith("/ ordinary") for name in cases.names]
    return list(itertools.compress(cases.names, first)), cases.directions[first]


def geometry_of(directions: np.ndarray) -> Geometry:
    view, light, azimuth = (np.ascontiguousarray(column)[:, None] for column in directions.T)
    return Geometry(view, np.zeros_like(view), light, azimuth)


@PRECISIONS
def test_fresnel(dtype: type) -> None:
    angle, index = grid(
        dtype,
        [0.0, 1e-6, 0.01, 1.0, 30.0, 56.3, 56.309932474020215, 60.0, 80.0, 89.0, 89.99],
        [1.0, 1.0 + 1e-6, 1.0001, 1.01, 1.2, 1.33, 1.5, 2.0, 2.42],
    )
    truth = map(twin.interface, digitwise(twin.cosine)(angle), exactly(index))
    truth = twin.Interface(*np.array(list(truth), object).T)
    c, b = cos_degrees(angle), sin_degrees(angle) ** 2
    stack = Stack(jnp.asarray(index))
    power, relative = stack.reflection(c, b), stack.relative_reflection(c, b)
    passing = stack.transmission(c, b)
    for value, true in (
        (power.mean, truth.mean),
        (power.contrast * b, truth.difference),
        (stack.scale * relative.mean, truth.mean),
        (stack.scale * relative.contrast * b, truth.difference),
        (passing.mean, truth.transmitted),
        (relative.contrast * b / relative.mean, truth.reflected_polarization),
        (-passing.contrast * b / passing.mean, truth.exit_polarization),
    ):
        assert_accurate(value, true, dtype, angle, index)


@PRECISIONS
def test_hemisphere(dtype: type) -> None:
    """Slopes and curvatures are tested with Fresnel."""
    index = np.array([1.0, 1.0 + 1e-6, 1.001, 1.2, 1.33, 1.5, 2.0, 2.42], dtype)
    truth = 1 - digitwise(twin.hemispherical_reflection)(exactly(index))
    stack = Stack(jnp.asarray(index))
    assert_accurate(stack.hemispherical_transmission(), truth, dtype, index)
    assert_accurate(stack.escape(), truth / exactly(index) ** 2, dtype, index)


@PRECISIONS
def test_mirror_facet(dtype: type) -> None:
    """The turn of the s axis is measured against the squared sine: it passes through zero."""
    names, directions = unique_directions(dtype)
    truth = twin.Facet(*np.array([twin.facet(*each) for each in directions], object).T)
    found = mirror_facet(geometry_of(directions))
    # A facet without tilt is known to the rounding of the zenith angles, 1e-16 or 1e-7, squared.
    floor = 1e-30 if dtype == np.float64 else 1e-12
    assert_accurate(found.cos_incidence, truth.cos_incidence, dtype, names)
    assert_accurate(found.sin_squared, truth.sin_squared, dtype, names)
    assert_accurate(found.tan_squared_tilt, truth.tan_squared_tilt, dtype, names, floor=floor)
    assert_accurate(found.along_s, truth.along_s, dtype, names, size=truth.sin_squared)
    assert_accurate(found.across_s, truth.across_s, dtype, names, size=truth.sin_squared)


@PRECISIONS
def test_lean(dtype: type) -> None:
    """Directions to the rounding of the angles that go in, whatever the normal does.

    Close to the true normal an azimuth is known as well as the direction, so that its turn is
    measured against the sine of the angle from there; a sine that small is kept as it is.
    """
    names, directions = unique_directions(dtype)
    for tilts in ((0.0, 0.0), (1e-9, -1e-9), (3.0, -2.0), (30.0, 0.0), (-25.0, 20.0)):
        slopes = [jnp.tan(jnp.deg2rad(jnp.asarray(dtype(tilt)))) for tilt in tilts]
        normal = mp.matrix([*(mp.mpf(float(slope)) for slope in slopes), 1])
        normal /= mp.norm(normal)
        zenith, azimuth = directions[:, 1], directions[:, 2]
        found = tilted_direction(zenith, azimuth, *slopes)
        assert found.zenith.dtype == dtype
        for i, (down, around) in enumerate(zip(zenith, azimuth, strict=True)):
            light, s = (
                twin.ray(down, around),
                mp.matrix([-twin.sine(around), twin.cosine(around), 0]),
            )
            across = twin.cross_product(normal, light)
            cosine, sine = twin.dot(normal, light), mp.norm(across)
            truth = mp.degrees(mp.atan2(sine, cosine))
            truth = min(truth, max(mp.mpf(STEEPEST_ZENITH), mp.mpf(float(down))))
            at = f"{names[i]}, tilt {tilts}"
            assert abs(mp.mpf(float(found.zenith[i])) - truth) <= BOUND[dtype], at
            if sine > mp.mpf("1e-4"):
                along, aside = twin.dot(across, s), twin.dot(across, twin.cross_product(light, s))
                for turn, true in zip(
                    found.turn, (along**2 - aside**2, 2 * along * aside), strict=True
                ):
                    assert abs(mp.mpf(float(turn[i])) - true / sine**2) * sine <= BOUND[dtype], at


@PRECISIONS
@each("distribution", [Beckmann(), GGX()])
def test_distribution(distribution: Beckmann | GGX, dtype: type) -> None:
    """Where the density is within 1e-30 of its peak; below, Beckmann's stops falling."""
    exact_density, exact_shadowing = TWINS[distribution]
    slope, roughness = grid(
        dtype,
        [0.0, 1e-12, 1e-6, 1e-3, 0.01, 0.1, 1.0, 10.0, 1e4, 3e9],
        [0.0, 1e-5, 1e-3, 0.02, 0.1, 0.3, 1.0, 3.0],
    )
    pairs = exactly(slope), exactly(roughness)
    density, peak = exact_density(*pairs), exact_density(mp.mpf(0), pairs[1])
    bright = density > peak * mp.mpf("1e-30")
    found = np.asarray(distribution.density(slope, roughness))[bright]
    assert_accurate(found, density[bright], dtype, slope[bright], roughness[bright])
    shadowing = distribution.shadowing(slope, roughness)
    assert_accurate(shadowing, exact_shadowing(*pairs), dtype, slope, roughness)


TWINS = {
    Beckmann(): (digitwise(twin.beckmann_density), digitwise(twin.beckmann_shadowing)),
    GGX(): (digitwise(twin.ggx_density), digitwise(twin.ggx_shadowing)),
}


@PRECISIONS
def test_body(dtype: type) -> None:
    absorption = np.array([0.0, 1e-4, 1e-3, 0.1, 1.0, 10.0, 1e3, 1e6], dtype)
    albedo = digitwise(twin.half_space_albedo)(exactly(absorption))
    escape = Stack(jnp.full_like(absorption, 1.5)).escape()
    inside = 1 - mp.mpf(float(escape[0]))
    behind = (1 - inside) * albedo / (1 - inside * albedo)
    assert_accurate(half_space_loss(absorption), 1 - albedo, dtype, absorption)
    # The floor of absorption is rounded to the precision before its square root is taken.
    assert_accurate(body_loss(absorption, escape), 1 - behind, dtype, absorption)


def mirrored_light(direction: np.ndarray, n: mp.mpf) -> tuple:
    """The facet between the directions; reflectance, q and u of what it mirrors."""
    facet = twin.facet(*direction)
    mirror = twin.interface(facet.cos_incidence, n)
    per_sine = mirror.reflected_polarization / facet.sin_squared if facet.sin_squared else 0
    return facet, (mirror.mean, per_sine * facet.along_s, -per_sine * facet.across_s)


def surface_truth(direction: np.ndarray, n: mp.mpf, roughness: mp.mpf) -> tuple:
    """Intensity, q and u of a Beckmann surface under a point source."""
    facet, (mean, q, u) = mirrored_light(direction, n)
    shown = twin.beckmann_density(facet.tan_squared_tilt, roughness)
    for zenith in direction[:2]:
        shown *= twin.beckmann_shadowing((twin.sine(zenith) / twin.cosine(zenith)) ** 2, roughness)
    return shown * mean / (4 * twin.cosine(direction[0])), q, u


@PRECISIONS
def test_scene_of_a_rough_surface(dtype: type) -> None:
    """Intensity against its own size, q and u against the degree of polarization."""
    names, directions, materials = every_case(dtype, exact=True)
    parameters = dict(zip(Material._fields, materials.T, strict=True))
    light = light_of(Scene(RoughSurface(Beckmann())), parameters, geometry_of(directions))
    roughness, _, _, n = exactly(materials.T)
    truth = list(map(surface_truth, directions, n, roughness))
    intensity, q, u = np.array(truth, object).T
    length = digitwise(mp.hypot)(q, u)
    assert_accurate(light.q, q, dtype, names, size=length)
    assert_accurate(light.u, u, dtype, names, size=length)
    # A highlight 1e-5 wide and 1e-30 of its peak bright is darker than any reading, and its
    # slope is squared before it is divided by the width.
    lit = intensity > TWINS[Beckmann()][0](mp.mpf(0), roughness) * mp.mpf("1e-25")
    lit &= (dtype == np.float64) | (roughness >= 1e-3)
    assert_accurate(light.intensity[lit], intensity[lit], dtype, np.array(names)[lit])


@PRECISIONS
@each("mixing", [StokesMixing(), DopMixing(), DopMixing(signed=True)], quick=1)
def test_scene_of_a_plate_over_a_diffuse_body(mixing, dtype):
    """q and u against the degree of polarization of the stronger part."""
    names, directions, materials = every_case(dtype, exact=True)
    keep = materials[:, 0] == dtype(0.1)
    directions, materials = directions[keep], materials[keep]
    scene = Scene(SmoothSurface(), Lambertian(albedo=0.5), mixing)
    parameters = dict(zip(Material._fields, materials.T, strict=True))
    light = light_of(scene, parameters, geometry_of(directions))
    truth = []
    for direction, (_, b, _, n) in zip(directions, exactly(materials), strict=True):
        _, first = mirrored_light(direction, n)
        cos_view, cos_light = map(twin.cosine, direction[:2])
        out, into = twin.interface(cos_view, n), twin.interface(cos_light, n)
        brightness = cos_light * into.transmitted * out.transmitted / (2 * mp.pi)
        second = brightness, -out.exit_polarization, mp.mpf(0)
        # The tip of the degree of polarization is rounded off at 1e-12; and a trace of the other
        # part, eps^1.25, moves the share where a fraction comes close to that trace.
        trace = float(np.finfo(dtype).eps) ** 1.25 / max(min(b, 1 - b), mp.mpf("1e-30"))
        size = max(mp.hypot(first[1], first[2]), abs(second[1]))
        slack = (BOUND[dtype] + (trace if 0 < b < 1 else 0)) * size + mp.mpf("2e-12")
        truth.append((*mixed(mixing, b, first, second), slack))
    intensity, q, u, slack = np.array(truth, object).T
    named = list(itertools.compress(names, keep))
    assert_accurate(light.q, q, dtype, named, size=slack, bound=1.0)
    assert_accurate(light.u, u, dtype, named, size=slack, bound=1.0)
    assert_accurate(light.intensity, intensity, dtype, named)


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


# --- layers, grooves, polarized light, color ------------------------------------------------------

# Minus the log of the least light that leaves a coat.
DEEPEST = {np.float64: 106.0, np.float32: 13.0}

LAYERED = (
    # index and 2 pi thickness/wavelength of a film; index and absorbance of a coat; the body
    (1.38, 2.6, 1.45, 0.2, 1.5),
    (1.38, 0.0, 1.45, 0.0, 1.5),
    (1.5, 30.0, 1.5, 0.0, 1.5),
    (1.0, 2.6, 1.0, 0.2, 1.5),
    (1.5**0.5, 0.25 * np.pi / 1.5**0.5, 1.5, 0.0, 1.5),
    (1.38, np.pi / 1.38, 1.45, 50.0, 2.42),
    (2.4, 1.3, 1.6, 1.0, 1.2),
    (1.38, 110.0, 1.7, 0.3, 1.001),
    (1.45, 2.6, 1.0 + 1e-6, 0.2, 1.0 + 1e-6),
)


@PRECISIONS
def test_layers(dtype: type) -> None:
    """s, p and the product of their fields, reflected and passed, against the larger of s and p.

    Fields cancel between layers: what is reflected is measured against the square of the strongest
    field at any boundary. The phase of the thick film, 220, has 220 roundings, which leaves 2e-3 in
    single precision, so that only double is tested; so are paths on which a coat lets pass less
    than is kept, e^-106 or e^-13. The product of fields under a film on a coat counts
    circular light as unpolarized, which costs up to 8e-4 of the light that arrives.
    """
    zeniths = np.array([0.0, 1e-3, 30.0, 56.3, 80.0, 89.0, 89.9], dtype)
    cosines, b = cos_degrees(zeniths), sin_degrees(zeniths) ** 2
    for case in LAYERED:
        film, wavenumber, coat, absorbance, n = (jnp.asarray(dtype(x)) for x in case)
        layers = (Layer(film, wavenumber=2.0 * wavenumber), Layer(coat, absorbance))
        stack = Stack(n, layers)
        found = [one_by_one(law(stack, cosines, b)) for law in (reflect, transmit)]
        exact = exactly(np.array(case, dtype))
        for i, zenith in enumerate(zeniths):
            square = twin.sine(zenith) ** 2
            depth = exact[3] / mp.sqrt(1 - square / exact[2] ** 2)
            if depth > DEEPEST[dtype] or (dtype == np.float32 and wavenumber > 50.0):
                continue
            truth = twin.coated(square, [tuple(exact[:2])], *exact[2:])
            media = (mp.mpf(1), exact[0], exact[2], exact[4])
            fields = [
                abs(field)
                for above, below in itertools.pairwise(media)
                for field in twin.boundary(square, above, [], below).reflected
            ]
            sizes = max(fields) ** 2, max(truth[1].s, truth[1].p)
            for power, true, size in zip(found, truth, sizes, strict=True):
                allowed = [size, size, 1e-3 / BOUND[dtype]]
                assert_accurate(power[:, i], true, dtype, [(case, zenith)] * 3, size=allowed)


@PRECISIONS
def test_scene_in_polarized_light(dtype: type) -> None:
    """Every direction of the catalogue, bare and under film and coat, against the brightness.

    Near Brewster's angle hardly any p light is reflected: errors are measured against the
    reflectance of unpolarized light, whose rounding remains.
    """
    names, directions = unique_directions(dtype)
    geometry = geometry_of(directions)
    geometry = geometry._replace(wavelength=np.full_like(geometry.view_zenith, WAVELENGTH))
    beam = PointSource(LinearPolarization("light_degree", "light_angle"))
    film, coat = (1.38, 230.0), (1.45, 0.2)
    for layers in (None, CoatStack((ThinFilm(*film), ClearCoat(*coat)))):
        scene = Scene(SmoothSurface(beam), coat=layers)
        for degree, angle in ((0.0, 0.0), (0.6, 30.0), (1.0, 90.0), (1.0, -45.0)):
            parameters = {
                "refractive_index": dtype(1.5),
                "light_degree": dtype(degree),
                "light_angle": dtype(angle),
            }
            found = stokes_of(scene, parameters, geometry)[:, 0]
            share, turn = mp.mpf(float(dtype(degree))), 2.0 * angle
            for i, (view, light, azimuth) in enumerate(directions):
                b = twin.facet(view, light, azimuth).sin_squared
                if layers is None:
                    s, p = twin.boundary(b, mp.mpf(1), [], mp.mpf(1.5)).reflected
                    powers = twin.Powers(abs(s) ** 2, abs(p) ** 2, mp.re(s * mp.conj(p)))
                else:
                    n, thickness, m, absorbance = exactly(np.array([*film, *coat], dtype))
                    wavenumber = 2 * mp.pi * thickness / mp.mpf(WAVELENGTH)
                    powers, _ = twin.coated(b, [(n, wavenumber)], m, absorbance, mp.mpf(1.5))
                truth = twin.mirrored(
                    powers,
                    (view, 0.0),
                    (light, azimuth),
                    share * twin.cosine(turn),
                    share * twin.sine(turn),
                )
                size = np.full(3, (powers.s + powers.p) / 2)
                assert_accurate(found[i], truth, dtype, [names[i]] * 3, size=size)


@PRECISIONS
@each("distribution", [Beckmann(), GGX()])
def test_density_of_grooves(distribution: Beckmann | GGX, dtype: type) -> None:
    """Down to 1e-20 of the peak; at 1e-30 the exponent alone, 69, takes 69 roundings of a slope.

    A slope in grooves a thousand times as steep as long is a difference of two slopes a thousand
    times as large: its bound is a thousand roundings more, times the steps in the exponent (46).
    """
    names, directions = unique_directions(dtype)
    geometry = geometry_of(directions)
    kind = type(distribution).__name__.lower()
    tilt = mirror_facet(geometry).tan_squared_tilt
    for along, across, azimuth in (
        (0.3, 0.3, 25.0),
        (0.1, 0.4, 25.0),
        (0.3, 0.1, 0.0),
        (1.0, 1e-3, 90.0),
    ):
        values = {"roughness": along, "roughness_across": across, "roughness_azimuth": azimuth}
        parameters = {key: jnp.asarray(dtype(value)) for key, value in values.items()}
        ellipse = AnisotropicSlopes("roughness_azimuth").ellipse(parameters, geometry)
        surface = Microsurface(distribution, SeparableShadowing(), FacetQuadrature(), ellipse)
        found = surface.density(geometry, tilt)
        assert found.dtype == dtype
        exact = [mp.mpf(float(parameters[key])) for key in values]
        peak = twin.groove_density(kind, mp.mpf(0), mp.mpf(0), *exact[:2])
        ratio = max(along, across) / min(along, across)
        steps = 46.0 if kind == "beckmann" else 4.0
        bound = max(BOUND[dtype], 4.0 * ratio * steps * float(np.finfo(dtype).eps))
        for i, (view, light, turn) in enumerate(directions):
            half = twin.ray(view, 0.0) + twin.ray(light, turn)
            x, y = half[0] / half[2], half[1] / half[2]
            cos, sin = twin.cosine(azimuth), twin.sine(azimuth)
            truth = twin.groove_density(kind, x * cos + y * sin, y * cos - x * sin, *exact[:2])
            if truth > peak * mp.mpf("1e-20"):
                error = abs(mp.mpf(float(found[i, 0])) - truth) / truth
                assert error <= bound, f"{names[i]}: {float(error):.1e}"


@PRECISIONS
def test_shadowing(dtype: type) -> None:
    shares = [1e-6, 1e-3, 0.3, 1.0 - 1e-6, 1.0]
    view, light = grid(dtype, shares, shares)
    v, l_ = exactly(view), exactly(light)
    for rule, truth in (
        (SeparableShadowing(), v * l_),
        (HeightCorrelatedShadowing(), 1 / (1 / v + 1 / l_ - 1)),
        (NoShadowing(), v / v),
    ):
        assert_accurate(rule.both(view, light), truth, dtype, view, light)


@PRECISIONS
def test_dispersion(dtype: type) -> None:
    colors = np.array([300.0, 450.0, 587.5618, 700.0, 2000.0], dtype)
    precision = {"any parameter": jnp.zeros((), dtype)}
    square = (exactly(colors) / 1000) ** 2
    a, b, c = exactly(np.array([1.45, 0.005, 1e-4], dtype))
    glass = Sellmeier((1.03961212, 0.231792344), (0.00600069867, 0.0200179144))
    pairs = exactly(np.array([glass.strengths, glass.resonances], dtype)).T
    for law, truth in (
        (Cauchy(1.45, 0.005, 1e-4), a + b / square + c / square**2),
        (Cauchy(1.45, 0.005), a + b / square),
        (glass, digitwise(mp.sqrt)(1 + sum(s * square / (square - r) for s, r in pairs))),
    ):
        assert_accurate(law.index(precision, colors), truth, dtype, colors)


@PRECISIONS
def test_overlap_of_the_beam(dtype: type) -> None:
    """Where the footprint fills the sample and far beyond; view and overlap up to 89.99 degrees."""
    zeniths = [0.0, 45.0, 79.9, 80.0, 80.1, 88.0, 89.99]
    view, fills = grid(dtype, zeniths, zeniths[1:])
    geometry = Geometry(view[:, None], *np.zeros((3, view.size, 1), dtype))
    light = Light(*jnp.ones((3, view.size, 1), dtype))
    found = BeamOverlap().record({"beam_overlap_zenith": fills[:, None]}, geometry, light)
    np.testing.assert_array_equal(found[1:], light[1:])
    ratio = digitwise(twin.cosine)(fills) / digitwise(twin.cosine)(view)
    truth = (1 + ratio**8) ** (-mp.mpf(1) / 8)
    assert_accurate(found.intensity, truth, dtype, view, fills)
