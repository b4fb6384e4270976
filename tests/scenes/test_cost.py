"""What is switched off is absent from the compiled program: operations are counted, not timed."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import each

import polar_bayes as pb
from polar_bayes.physics.boundary import (
    Medium,
    medium,
    reflection,
    reflection_shape,
    transmission,
)
from polar_bayes.physics.geometry import cos_degrees, mirror_facet, sin_degrees
from polar_bayes.physics.stokes import Light, degree_of_linear_polarization
from polar_bayes.physics.variants import effects_of, simplify
from polar_bayes.scenes.posterior_change import compile_and_count, run_seconds

GEOMETRY = pb.Geometry.from_degrees(
    view_zenith=np.linspace(5.0, 80.0, 16),
    view_azimuth=np.full(16, 170.0),
    light_zenith=np.full(16, 45.0),
    light_azimuth=np.zeros(16),
    wavelength=np.full(16, 550.0),
)
PLAIN = pb.Scene(
    surface=pb.RoughSurface(
        quadrature=pb.physics.FacetQuadrature(5, 4), way_out=pb.physics.SmoothExit()
    ),
    subsurface=pb.Unpolarized(),
    mixing=pb.StokesMixing(),
)
# The compiler repeats a few operations on single numbers in one loop or another (0.3 %); the least
# effect, a gain of the polarization, adds 0.6 %.
SAME = 0.004

# Values at which an effect that is on changes nothing, or next to nothing.
NEUTRAL = {
    "roughness": 0.2,
    "roughness_across": 0.2,
    "subsurface_fraction": 0.3,
    "refractive_index": 1.5,
    "cauchy_a": 1.5,
    "cauchy_b": 1e-9,
    "coat_refractive_index": 1.0,
    "coat_absorbance": 0.0,
    "film_refractive_index": 1.0,
    "film_thickness": 0.0,
    "angle_zero": 0.0,
    "beam_overlap_zenith": 89.0,
    "channel_gain_ratio": 1.0,
    "dark_level": 0.0,
    "degree": 0.0,
    "discrepancy_amplitude": 0.0,
    "discrepancy_weights": np.zeros(3),
    "dolp_gain": 1.0,
    "leakage": 0.0,
}


def rough(**parts) -> pb.Scene:
    surface = dataclasses.replace(PLAIN.surface, **parts)
    return dataclasses.replace(PLAIN, surface=surface)


def recorded(term) -> pb.Scene:
    return dataclasses.replace(PLAIN, instrument=pb.instrument.Instrument((term,)))


# One effect switched on in each.
ON = {
    "polarized light": rough(
        illumination=pb.PointSource(pb.physics.LinearPolarization("degree", 0.0))
    ),
    "two roughnesses": rough(slopes=pb.physics.AnisotropicSlopes()),
    "rough way out": rough(way_out=pb.physics.RoughExit()),
    "correlated shadowing": rough(shadowing=pb.physics.HeightCorrelatedShadowing()),
    "polarized body": dataclasses.replace(PLAIN, subsurface=pb.Lambertian()),
    "internal reflection": dataclasses.replace(
        PLAIN, subsurface=pb.Unpolarized(internal_reflection=pb.physics.InternalReflection())
    ),
    "clear coat": dataclasses.replace(PLAIN, coat=pb.ClearCoat()),
    "thin film": dataclasses.replace(rough(way_out=pb.physics.RoughPassage()), coat=pb.ThinFilm()),
    **{
        term.__name__: recorded(term())
        for term in (
            pb.instrument.AngleZero,
            pb.instrument.BeamOverlap,
            pb.instrument.ChannelGain,
            pb.instrument.DarkLevel,
            pb.instrument.Discrepancy,
            pb.instrument.DolpGain,
            pb.instrument.Leakage,
        )
    },
    "analyzer": recorded(pb.instrument.Analyzer(0.0)),
}


def by_hand(parameters, geometry):
    """The plain scene without scenes: Fresnel's laws, Beckmann's facets, a white body."""
    roughness, fraction, index = (
        jnp.asarray(parameters[name])[..., None]
        for name in ("roughness", "subsurface_fraction", "refractive_index")
    )
    roughness, _ = jnp.broadcast_arrays(roughness, geometry.view_zenith)
    facets = pb.Beckmann()
    facet = mirror_facet(geometry)
    views, lights = (
        (cos_degrees(zenith), sin_degrees(zenith))
        for zenith in (geometry.view_zenith, geometry.light_zenith)
    )
    seen = [facets.shadowing((sin / cos) ** 2, roughness) for cos, sin in (views, lights)]
    air = Medium(jnp.ones(()), facet.cos_incidence)
    inside = medium(index, facet.cos_incidence**2)
    mirrored = reflection(air, inside, facet.sin_squared)
    shape = reflection_shape(air, inside, facet.sin_squared)
    density = facets.density(facet.tan_squared_tilt, roughness)
    brightness = density * (seen[0] * seen[1]) / (4.0 * views[0])
    polarized = shape.contrast / shape.mean
    surface = Light(
        brightness * mirrored.mean,
        polarized * facet.along_s,
        -polarized * facet.across_s,
    )
    ways = []
    for cos, sin in (lights, views):
        ways.append(transmission(Medium(jnp.ones(()), cos), medium(index, cos**2), sin**2).mean)
    body = 1.0 / np.pi * (lights[0] * ways[0]) * ways[1]
    nothing = jnp.zeros_like(body)
    mixed = pb.StokesMixing().mix(fraction, surface, Light(body, nothing, nothing))
    # The compiler is kept from computing them anew for each reader, as it is in a scene.
    intensity, q, u = jax.lax.optimization_barrier(tuple(jnp.broadcast_arrays(*mixed)))
    dop = degree_of_linear_polarization(q, u)
    return jax.lax.optimization_barrier({"dop": dop, "q": q, "u": u, "intensity": intensity})


def operations(predict, names) -> float:
    """Count operations of values and derivatives of all readings by all parameters."""
    parameters = {name: jnp.asarray(NEUTRAL[name]) for name in names}

    def weighed(parameters, weights):
        predicted = predict(parameters, GEOMETRY)
        return sum(jnp.sum(weights[name] * values) for name, values in predicted.items())

    weights = {name: jnp.ones(16) for name in ("dop", "q", "u", "intensity")}
    return compile_and_count(jax.value_and_grad(weighed), parameters, weights)[1]


@pytest.fixture(scope="module")
def plain() -> float:
    return operations(PLAIN.predict, PLAIN.parameters)


def test_a_scene_with_everything_off_is_the_bare_formula_and_nothing_else(plain: float) -> None:
    parameters = {name: NEUTRAL[name] for name in PLAIN.parameters}
    expected = by_hand(parameters, GEOMETRY)
    for name, values in PLAIN.predict(parameters, GEOMETRY).items():
        np.testing.assert_allclose(values, expected[name], rtol=1e-12, atol=1e-14)
    assert plain == pytest.approx(operations(by_hand, PLAIN.parameters), rel=SAME)


@pytest.mark.thorough
@each("name", ON)
def test_an_effect_costs_when_it_is_on_and_leaves_nothing_when_it_is_off(
    name: str, plain: float
) -> None:
    """Left out, an effect gives the plain scene; multiplied by zero, it would show here."""
    scene = simplest = ON[name]
    # A part that a film needs can be left out only after the film.
    while effects := effects_of(simplest):
        off = {effect.key_path: effect for effect in effects}.values()
        simplest = simplify(simplest, off)
    assert simplest == PLAIN
    assert operations(scene.predict, scene.parameters) > (1.0 + SAME) * plain


@pytest.mark.thorough
def test_an_index_of_its_own_costs_less_than_a_law_of_dispersion(plain: float) -> None:
    scene = dataclasses.replace(PLAIN, dispersion=pb.physics.Cauchy())
    assert operations(scene.predict, scene.parameters) > plain


def test_costs_are_counted_and_timed() -> None:
    small, large = (
        compile_and_count(lambda x: jnp.sum(jnp.exp(x @ x)), jnp.ones((size, size)))
        for size in (4, 256)
    )
    assert large[1] > 1000.0 * small[1] > 0.0
    assert small[2] > 0.0
    quick, slow = run_seconds(
        [lambda: small[0](jnp.ones((4, 4))), lambda: large[0](jnp.ones((256, 256)))]
    )
    assert 0.0 < quick < slow
