"""Value, gradient and Hessian are finite in every hard case, in both precisions."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import each
from digits import assert_finite
from hard_cases.catalogue import (
    DIRECTIONS,
    EFFECTS,
    INSTRUMENTS,
    MATERIALS,
    ORDINARY,
    SPANS,
    WAVELENGTH,
    Material,
    every_case,
    every_effect,
    random_directions,
    random_parameter,
)
from jaxtyping import Array
from optics import BEAM, GROOVED, stokes_of

from polar_bayes.physics.coat import BackFace, ClearCoat, CoatStack, ThinFilm
from polar_bayes.physics.dispersion import Cauchy, Sellmeier
from polar_bayes.physics.facets import FacetQuadrature
from polar_bayes.physics.geometry import Geometry
from polar_bayes.physics.illumination import Disc, SunAndSky, UniformSky
from polar_bayes.physics.instrument import (
    Analyzer,
    BeamOverlap,
    Instrument,
    Saturation,
    TiltedNormal,
)
from polar_bayes.physics.microfacet import (
    GGX,
    Beckmann,
    HeightCorrelatedShadowing,
    SeparableShadowing,
)
from polar_bayes.physics.mixing import DopMixing, StokesMixing
from polar_bayes.physics.phase_function import HenyeyGreenstein
from polar_bayes.physics.scene import SCENES, Scene
from polar_bayes.physics.second_bounce import TwoBounceSurface
from polar_bayes.physics.second_passage import TwoFacetPassage
from polar_bayes.physics.subsurface import Depolarizer, Lambertian, TurbidMedium, Unpolarized
from polar_bayes.physics.surface import (
    InternalReflection,
    RoughPassage,
    RoughSurface,
    SmoothExit,
    SmoothSurface,
)

READINGS = ("dop", "q", "u", "intensity")


FEW = FacetQuadrature(along=5, across=4)
FEWEST = FacetQuadrature(along=2, across=1)  # where rays of a source and back inside need facets

# A new part belongs into one of these scenes; every state of the catalogue then meets it.
EFFECT_SCENES = {
    "lacquered grooves under a polarized beam": Scene(
        RoughSurface(Beckmann(), BEAM, FEW, GROOVED, HeightCorrelatedShadowing()),
        Lambertian("albedo", InternalReflection()),
        StokesMixing(),
        ClearCoat(),
        Instrument((BeamOverlap(),)),
        normal=TiltedNormal(),
    ),
    "grooves under a sky, with a film": Scene(
        RoughSurface(
            GGX(),
            UniformSky(),
            FEWEST,
            GROOVED,
            HeightCorrelatedShadowing(),
            way_out=RoughPassage(),
        ),
        Depolarizer(),
        DopMixing(signed=True),
        ThinFilm(),
        normal=TiltedNormal(),
    ),
    "grooves under a disc, of their own color": Scene(
        RoughSurface(Beckmann(), Disc(5.0), FEW, GROOVED, way_out=SmoothExit()),
        Depolarizer(internal_reflection=None),
        StokesMixing(),
        dispersion=Sellmeier(),
    ),
    "a plate under film and coat": Scene(
        SmoothSurface(BEAM, BackFace(absorbance=0.1)),
        Unpolarized("albedo", InternalReflection()),
        StokesMixing(),
        CoatStack((ThinFilm(), ClearCoat())),
        Instrument((Analyzer(30.0), Saturation(0.5))),
        Cauchy(),
        TiltedNormal(),
    ),
    "grooves that light each other": Scene(
        TwoBounceSurface(Beckmann(), quadrature=FacetQuadrature(3, 2), slopes=GROOVED),
        Lambertian(),
        StokesMixing(),
    ),
    "grooves that light each other under a sky": Scene(
        TwoBounceSurface(GGX(), UniformSky(), FEWEST, GROOVED, SeparableShadowing()),
        Lambertian(),
        StokesMixing(),
    ),
    "a turbid body": Scene(SmoothSurface(BEAM), TurbidMedium("polarized_fraction"), StokesMixing()),
    "a turbid body under grooves both ways": Scene(
        RoughSurface(Beckmann(), BEAM, FEWEST, GROOVED, way_out=RoughPassage()),
        TurbidMedium("polarized_fraction"),
        StokesMixing(),
    ),
    "sun and sky on a body that scatters forwards": Scene(
        RoughSurface(GGX(), SunAndSky("sky_radiance"), FEWEST, way_out=TwoFacetPassage()),
        Depolarizer(phase_function=HenyeyGreenstein("anisotropy")),
        StokesMixing(),
    ),
}

ALL_SCENES = (
    SCENES
    | EFFECT_SCENES
    | {
        "GGX, point": Scene(
            RoughSurface(GGX()), Depolarizer(phase_function=HenyeyGreenstein()), StokesMixing()
        ),
        "facets both ways": Scene(
            RoughSurface(quadrature=FEW, way_out=RoughPassage()), Depolarizer(), StokesMixing()
        ),
        "facets both ways, disc": Scene(
            RoughSurface(GGX(), Disc(15.0), FEWEST, way_out=RoughPassage()),
            Depolarizer(phase_function=HenyeyGreenstein()),
            DopMixing(signed=True),
        ),
        "facets both ways, sky": Scene(
            RoughSurface(Beckmann(), UniformSky(), FEWEST, way_out=TwoFacetPassage()),
            Depolarizer(phase_function=HenyeyGreenstein()),
            StokesMixing(),
        ),
        "two bounces": Scene(
            TwoBounceSurface(quadrature=FEW), Depolarizer(), DopMixing(signed=True)
        ),
        "two bounces, sky": Scene(
            TwoBounceSurface(GGX(), UniformSky(), FacetQuadrature(3, 2)),
            Lambertian(),
            StokesMixing(),
        ),
        "GGX, sky": Scene(RoughSurface(GGX(), UniformSky()), Lambertian(), StokesMixing()),
        "Beckmann, sky": Scene(
            RoughSurface(Beckmann(), UniformSky()), Depolarizer(), DopMixing(signed=True)
        ),
        "Beckmann, disc": Scene(
            RoughSurface(Beckmann(), Disc(half_width=5.0)), Depolarizer(), StokesMixing()
        ),
    }
)


def size(name: str) -> int:
    """Columns that a parameter takes."""
    return np.size(INSTRUMENTS["perfect"].get(name, 0.0))


def rows(scene: Scene, dtype: type) -> tuple[list[str], np.ndarray]:
    """Names, and one row of inputs for each: directions, then the scene's parameters.

    Cases of the first scenes come with every state of the instrument, those of the others with
    every effect. All scenes get as many rows: operations of one shape compile once.
    """
    cases, count = every_case(dtype), len(INSTRUMENTS)
    total = count * len(cases.names)
    if scene in EFFECT_SCENES.values():
        effects = every_effect(dtype, total)
        columns = [effects.directions, *(effects.parameters[n][:, None] for n in scene.parameters)]
        return effects.names, np.concatenate(columns, axis=1)
    material = dict(zip(Material._fields, cases.materials.T, strict=True))
    columns = [np.tile(cases.directions, (count, 1))]
    for name in scene.parameters:
        if name in material:
            columns.append(np.tile(material[name], count)[:, None])
        else:
            settings = [np.atleast_1d(state[name]).astype(dtype) for state in INSTRUMENTS.values()]
            columns.append(np.repeat(settings, len(cases.names), axis=0))
    return cases.names * count, np.concatenate(columns, axis=1)


def readings(scene: Scene, row: Array) -> Array:
    """Return all readings of one view, from one row of inputs."""
    color = jnp.asarray([WAVELENGTH], row.dtype) if scene in EFFECT_SCENES.values() else None
    geometry = Geometry(row[0:1], jnp.zeros_like(row[0:1]), row[1:2], row[2:3], color)
    parameters, start = {}, 3
    for name in scene.parameters:
        piece = row[start : start + size(name)]
        parameters[name] = piece if size(name) > 1 else piece[0]
        start += size(name)
    predicted = scene.predict(parameters, geometry)
    return jnp.concatenate([predicted[name] for name in READINGS])


RUNS = [(name, dtype) for name in ALL_SCENES for dtype in (np.float64, np.float32)]
# Every state of the catalogue meets it: an instrument with all its terms, where numbers end sooner.
# The other parts are in scenes that compile longer.
FIRST = ("goniometer", np.float32)


@each(("name", "dtype"), sorted(RUNS, key=FIRST.__ne__), quick=1)
def test_value_gradient_and_hessian_are_finite(name: str, dtype: type) -> None:
    check_finite(name, *rows(ALL_SCENES[name], dtype))


BATCH = 600
"""Rows that are in memory together, a third of the catalogue's."""

ALONE = {"xla_disable_hlo_passes": "fusion"}
"""Each operation is compiled once: fused into all that read it, those of a film compile for minutes
and need more memory than a machine has."""

# Points drawn at random, of all scenes together.
POINTS = 65_000


@pytest.mark.thorough
@each(("name", "dtype"), RUNS)
def test_random_points_are_finite(name: str, dtype: type) -> None:
    scene, generator = ALL_SCENES[name], np.random.default_rng(25)
    count = POINTS // len(ALL_SCENES)
    columns = [random_directions(count, generator)]
    for parameter in scene.parameters:
        if parameter in SPANS:
            columns.append(random_parameter(parameter, count, generator)[:, None])
        else:
            usual = np.atleast_1d(INSTRUMENTS["ordinary"][parameter])
            columns.append(np.tile(usual, (count, 1)))
    # The last number before 90 degrees belongs to the contract, 90 itself does not.
    inputs = np.concatenate(columns, axis=1).astype(dtype)
    inputs[:, :2] = np.minimum(inputs[:, :2], np.nextafter(dtype(90.0), dtype(0.0)))
    check_finite(name, [str(row) for row in inputs], inputs)


def check_finite(name: str, names: list[str], inputs: np.ndarray) -> None:
    """Every row of one scene, in one precision."""
    scene, dtype = ALL_SCENES[name], inputs.dtype
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

    # All rows at once, and the programs of all scenes, would need more memory than a machine has.
    # One program, which the other test finds on the disk, takes all parts: the last is filled up.
    program = jax.jit(jax.vmap(derivatives), compiler_options=ALONE)
    length = len(inputs)
    filled = np.resize(inputs, (-(-length // BATCH) * BATCH, inputs.shape[1]))
    parts = [jax.device_get(program(part)) for part in filled.reshape(-1, BATCH, inputs.shape[1])]
    results = [np.concatenate(each)[:length] for each in zip(*parts, strict=True)]
    program.clear_cache()
    assert_finite(results, names, dtype)


# What rounding adds to the degree of polarization, as docs/conventions.md says: under unpolarized
# light in multiples of the precision; under a fully polarized beam, whose light is a small
# difference where a mirror extinguishes it, in all.
UNPOLARIZED, POLARIZED = 4.0, {np.float64: 3e-14, np.float32: 3e-4}


@pytest.mark.thorough
@each(("name", "dtype"), RUNS)
def test_light_is_possible(name: str, dtype: type) -> None:
    """S0 >= |S|: no reading of an ideal instrument is more than fully polarized, or negative."""
    scene = dataclasses.replace(ALL_SCENES[name], instrument=None)
    _, inputs = rows(ALL_SCENES[name], dtype)
    start, parameters = 3, {}
    for parameter in ALL_SCENES[name].parameters:
        parameters[parameter] = inputs[:, start]
        start += size(parameter)
    view, light, azimuth = (jnp.asarray(column)[:, None] for column in inputs[:, :3].T)
    color = jnp.full_like(view, WAVELENGTH)
    geometry = Geometry(view, jnp.zeros_like(view), light, azimuth, color)
    stokes = np.asarray(stokes_of(scene, parameters, geometry))[:, 0]
    assert stokes.dtype == dtype
    assert np.all(stokes[:, 0] >= 0.0)
    above = UNPOLARIZED * np.finfo(dtype).eps
    if "light_degree" in parameters:
        above = POLARIZED[dtype]
    # Squares of darker light leave single precision.
    length = np.hypot(*stokes.astype(np.float64)[:, 1:].T)
    assert np.all(length <= stokes[:, 0] * (1.0 + above) + 1e-300)


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
    read = {name for scene in EFFECT_SCENES.values() for name in scene.parameters}
    assert read == set(ORDINARY) | set(Material._fields)
    assert {name for changes in EFFECTS.values() for name in changes} <= read
