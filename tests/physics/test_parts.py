"""Parts of a scene: what each reads, what is simpler than it, and which settings are refused."""

import dataclasses

import jax.numpy as jnp
import pytest
from cases import each
from optics import BEAM, EVERYTHING, GROOVED, directions

import polar_bayes as pb
from polar_bayes.physics.coat import ClearCoat, CoatStack, ThinFilm
from polar_bayes.physics.dispersion import Cauchy, Sellmeier
from polar_bayes.physics.facets import FacetQuadrature
from polar_bayes.physics.illumination import Disc, PointSource, SunAndSky, UniformSky
from polar_bayes.physics.instrument import (
    Analyzer,
    AngleZero,
    BeamOverlap,
    ChannelGain,
    DarkLevel,
    Discrepancy,
    DolpGain,
    Instrument,
    Leakage,
    Saturation,
    TiltedNormal,
)
from polar_bayes.physics.microfacet import (
    GGX,
    AnisotropicSlopes,
    HeightCorrelatedShadowing,
    IsotropicSlopes,
    SeparableShadowing,
)
from polar_bayes.physics.mixing import DopMixing
from polar_bayes.physics.phase_function import HenyeyGreenstein
from polar_bayes.physics.scene import MATERIAL_PARAMETERS, SCENES, Scene
from polar_bayes.physics.second_bounce import TwoBounceSurface
from polar_bayes.physics.second_passage import TwoFacetPassage
from polar_bayes.physics.stokes import LinearPolarization
from polar_bayes.physics.subsurface import Depolarizer, Lambertian, TurbidMedium, Unpolarized
from polar_bayes.physics.surface import (
    InternalReflection,
    RoughExit,
    RoughPassage,
    RoughSurface,
    SmoothExit,
    SmoothSurface,
)

PLATE, FILM, LACQUER = SmoothSurface(), ThinFilm(), ClearCoat()
TERMS = (AngleZero(), DolpGain(), ChannelGain(), Leakage(), DarkLevel(), BeamOverlap())
TERMS += (Discrepancy(), Analyzer(30.0), Saturation(1.0))

READ = [
    (SCENES["paper"], "roughness subsurface_fraction absorption refractive_index"),
    (SCENES["camera"], "roughness subsurface_fraction refractive_index dolp_gain"),
    (
        SCENES["goniometer"],
        "subsurface_fraction refractive_index angle_zero channel_gain_ratio leakage "
        "discrepancy_amplitude discrepancy_weights",
    ),
    (
        dataclasses.replace(SCENES["camera"], normal=TiltedNormal()),
        "roughness subsurface_fraction refractive_index normal_tilt_x normal_tilt_y dolp_gain",
    ),
    (
        EVERYTHING,  # the material's in their order, then the light, then the instrument
        "roughness subsurface_fraction roughness_across roughness_azimuth albedo cauchy_a cauchy_b "
        "coat_refractive_index coat_absorbance film_refractive_index film_thickness light_degree "
        "light_angle angle_zero beam_overlap_zenith dolp_gain",
    ),
    (
        Scene(RoughSurface(), coat=CoatStack((FILM, ClearCoat(1.5)))),
        "roughness refractive_index coat_absorbance film_refractive_index film_thickness",
    ),
    (Scene(PLATE, coat=ClearCoat(1.5, 0.0)), "refractive_index"),
    (Scene(PLATE, dispersion=Sellmeier(("b",), (0.01,))), "b"),
    (Instrument(TERMS), " ".join(name for term in TERMS for name in term.parameters)),
    (Depolarizer(phase_function=HenyeyGreenstein("anisotropy")), "absorption anisotropy"),
    (TurbidMedium("polarized_fraction"), "absorption polarized_fraction"),
    (AnisotropicSlopes(30.0), "roughness roughness_across"),
    (GROOVED, "roughness roughness_across roughness_azimuth"),
    (Sellmeier(("b", 0.2, 1.0), (0.006, "c", 103.0)), "b c"),
    (Cauchy("a", 0.0, "c"), "a c"),
    (ClearCoat("lacquer_index", "lacquer_absorbance"), "lacquer_index lacquer_absorbance"),
    (PointSource(LinearPolarization(0.5, 10.0)), ""),
]


@each(("part", "names"), READ, ids=lambda x: x if isinstance(x, str) else type(x).__name__)
def test_a_part_reads_these_parameters_in_this_order(part: object, names: str) -> None:
    assert part.parameters == tuple(names.split())
    if isinstance(part, Scene):
        material = [name for name in part.parameters if name in MATERIAL_PARAMETERS]
        assert material == [name for name in MATERIAL_PARAMETERS if name in part.parameters]
        own = () if part.instrument is None else part.instrument.parameters
        assert part.optical_parameters == part.parameters[: len(part.parameters) - len(own)]


SIMPLER = [
    *((term, (None,)) for term in TERMS),
    (LACQUER, (None,)),
    (CoatStack((FILM,)), (None,)),
    (CoatStack((FILM, LACQUER)), (CoatStack((LACQUER,)), CoatStack((FILM,)))),
    (LinearPolarization(), (None,)),
    (InternalReflection(), (None,)),
    (Lambertian(0.5, InternalReflection()), (Unpolarized(0.5, InternalReflection()),)),
    (TurbidMedium(), (Depolarizer(),)),
    (GROOVED, (IsotropicSlopes(),)),
    (HeightCorrelatedShadowing(), (SeparableShadowing(),)),
    (SeparableShadowing(), ()),
    (RoughExit(), (SmoothExit(),)),
    (SmoothExit(), ()),
    (TwoFacetPassage(), (RoughPassage(), RoughExit(), SmoothExit())),
    (SunAndSky(0.05), (PointSource(), UniformSky())),
    (
        TwoBounceSurface(GGX()),
        (
            RoughSurface(
                GGX(),
                quadrature=TwoBounceSurface().quadrature,
                shadowing=HeightCorrelatedShadowing(),
            ),
        ),
    ),
]


@each(("part", "simpler"), SIMPLER, ids=lambda x: str(x)[:40])
def test_what_is_simpler_than_a_part(part: object, simpler: tuple) -> None:
    assert part.simpler() == simpler


VIEW = directions(9.0, 0.0, 9.0)


def lit(**parts: object) -> None:
    """A plate with these parts, in light of no stated wavelength."""
    names = ("refractive_index", "film_refractive_index", "film_thickness", "cauchy_a", "cauchy_b")
    names += ("coat_refractive_index", "coat_absorbance")
    Scene(PLATE, **parts).stokes(dict.fromkeys(names, jnp.asarray(1.5)), VIEW)


NO_SUCH = "is no such part; give"
REFUSED = [
    (lambda: FacetQuadrature(along=0), "FacetQuadrature: .* is no number of nodes; give a whole"),
    (lambda: FacetQuadrature(across=65), "FacetQuadrature: .* is no number of nodes; give a whole"),
    (lambda: FacetQuadrature(along=2.5), "FacetQuadrature: .* is no number of nodes; give a whole"),
    (lambda: Cauchy(a=0.9), "Cauchy: a: 0.9 is neither a number from 1 to 3"),
    (lambda: Cauchy(b="not a name"), "Cauchy: b: 'not a name' is neither"),
    (lambda: Cauchy(c=2.0), "Cauchy: c: 2.0 is neither a number from -1 to 1"),
    (lambda: Sellmeier((1.0, 0.2), (0.01,)), "Sellmeier: .* do not pair; give two tuples of"),
    (lambda: Sellmeier((), ()), "Sellmeier: .* do not pair"),
    (lambda: Sellmeier(1.0, 0.01), "Sellmeier: .* do not pair"),
    (lambda: Sellmeier((-1.0,), (0.01,)), "Sellmeier: strengths: -1.0 is neither"),
    (lambda: Sellmeier((1.0,), (-0.01,)), "Sellmeier: resonances: -0.01 is neither"),
    (lambda: lit(dispersion=Cauchy()), "dispersion: .* needs a wavelength, and there is none; g"),
    (lambda: RoughSurface(UniformSky()), rf"distribution: .* {NO_SUCH} Beckmann\(\) or GGX\(\)"),
    (lambda: RoughSurface(illumination=GGX()), rf"{NO_SUCH} PointSource\(\), Disc\(5.0\) or Unif"),
    (lambda: RoughSurface(quadrature=32), rf"{NO_SUCH} FacetQuadrature\(along=6, across=5\)"),
    (lambda: RoughSurface(slopes=0.1), rf"slopes: 0.1 {NO_SUCH} IsotropicSlopes\(\) or Aniso"),
    (lambda: RoughSurface(shadowing=None), rf"shadowing: None {NO_SUCH} SeparableShadowing\(\), N"),
    (lambda: RoughSurface(way_out="rough"), rf"way_out: 'rough' {NO_SUCH} RoughExit\(\) or Smoot"),
    (lambda: SmoothSurface(UniformSky()), rf"SmoothSurface: beam: UniformSky\(\) {NO_SUCH}"),
    (lambda: SmoothSurface(back="black"), rf"back: 'black' {NO_SUCH} BackFace\(\)"),
    (lambda: Disc(0.0), "Disc: half_width=.* give degrees from 0.01 to 90"),
    (lambda: Disc(91.0), "Disc: half_width=.* give degrees from 0.01 to 90"),
    (lambda: Disc(float("nan")), "Disc: half_width=.* give degrees from 0.01 to 90"),
    (lambda: TwoBounceSurface(illumination=Disc(5.0)), "has no second bounce; give PointSource"),
    (lambda: TwoBounceSurface(illumination=BEAM), "has no second bounce; give PointSource"),
    (lambda: Lambertian(-0.1), "albedo: -0.1 is neither a number from 0 to 1 nor a para"),
    (lambda: Unpolarized(1.5), "albedo: 1.5 is neither a number from 0 to 1 nor a para"),
    (lambda: Lambertian(float("nan")), "albedo: nan is neither a number from 0 to 1 nor a para"),
    (lambda: TurbidMedium(1.5), "TurbidMedium: polarized_fraction: 1.5 is neither"),
    (lambda: HenyeyGreenstein(0.95), "HenyeyGreenstein: anisotropy: 0.95 is neither"),
    (lambda: AnisotropicSlopes(400.0), "AnisotropicSlopes: azimuth: 400.0 is neither a number"),
    (lambda: ClearCoat(0.5), "ClearCoat: refractive_index: 0.5 is neither a number from 1 to"),
    (lambda: ClearCoat(absorbance=-1.0), "ClearCoat: absorbance: -1.0 is neither a number fr"),
    (lambda: ClearCoat("two words"), "ClearCoat: refractive_index: 'two words' is neither"),
    (lambda: ThinFilm(True), "ThinFilm: refractive_index: True is neither"),
    (lambda: ThinFilm(thickness_nm=float("nan")), "ThinFilm: thickness_nm: nan is neither"),
    (lambda: CoatStack(LACQUER), f"CoatStack: .* {NO_SUCH} a tuple: CoatStack"),
    (lambda: CoatStack((LACQUER, None)), f"CoatStack: None {NO_SUCH} coats"),
    (
        lambda: CoatStack((LACQUER, ClearCoat(1.5))),
        r"CoatStack: two coats read coat_absorbance; name the parameters apart: ClearCoat\(",
    ),
    (lambda: lit(coat=FILM), "ThinFilm: fringes .*; give the geometry a wavelength"),
    (lambda: lit(coat=CoatStack((LACQUER, FILM))), "ThinFilm: fringes .*; give the geometry a wa"),
    (lambda: LinearPolarization(1.5), "LinearPolarization: degree: 1.5 is neither a number fr"),
    (lambda: LinearPolarization(1.0, 200.0), "LinearPolarization: angle: 200.0 is neither"),
    (lambda: LinearPolarization("a b"), "LinearPolarization: degree: 'a b' is neither"),
    (lambda: PointSource(0.5), f"PointSource: polarization: 0.5 {NO_SUCH} Linear"),
    (lambda: PointSource(UniformSky()), "PointSource: polarization: .* is no such part"),
    (lambda: Analyzer("angle"), "Analyzer: 'angle' is no angle; give degrees, or a tuple"),
    (lambda: Analyzer((0.0, "x")), "Analyzer: 'x' is no angle"),
    (lambda: Analyzer(1e3), "Analyzer: angle: 1000.0 is neither a number from -360 to 360"),
    (lambda: Saturation(0.0), "Saturation: level=0.0 is no full scale; give a number above 0"),
    (lambda: Saturation(float("nan")), "Saturation: level=nan is no full scale"),
    (lambda: Saturation("full"), "Saturation: level='full' is no full scale"),
    (lambda: Discrepancy(basis=0), "Discrepancy: .* make no smooth function"),
    (lambda: Discrepancy(basis=2.5), "Discrepancy: .* make no smooth function"),
    (lambda: Discrepancy(length=0.0), "Discrepancy: .* make no smooth function"),
    (lambda: Instrument(DolpGain()), "Instrument: .* is no tuple of instrument terms; write"),
    (lambda: Instrument([DolpGain()]), "Instrument: .* is no tuple of instrument terms; write"),
    (lambda: Instrument((DolpGain,)), "Instrument: .* is no tuple of instrument terms; write"),
    (lambda: Instrument(("DolpGain",)), "Instrument: .* is no tuple of instrument terms; write"),
    (lambda: Instrument((DolpGain(), DolpGain())), "repeat one; give each term once"),
    (lambda: TiltedNormal(tilt_x=61.0), "TiltedNormal: tilt_x: 61.0 is neither a number from"),
    (lambda: TiltedNormal(tilt_y="two degrees"), "TiltedNormal: tilt_y: 'two degrees' is nei"),
    (lambda: Scene(PLATE, normal=5.0), rf"normal: 5.0 {NO_SUCH} TiltedNormal\(\) or None"),
    (lambda: Scene(GGX()), rf"surface: GGX\(\) {NO_SUCH} SmoothSurface\(\) or Ro"),
    (lambda: Scene(PLATE, "lambertian"), f"subsurface: 'lambertian' {NO_SUCH} Unpolar"),
    (lambda: Scene(PLATE, mixing=Lambertian()), rf"mixing: .* {NO_SUCH} DopMixing\(\)"),
    (lambda: Scene(PLATE, instrument=DolpGain()), r"instrument: .* give Instrument\(\(DolpGain\("),
    (lambda: Scene(PLATE, coat="clear"), rf"coat: 'clear' {NO_SUCH} ClearCoat\(\), ThinFilm\(\)"),
    (lambda: Scene(PLATE, dispersion="C"), r"dispersion: .* give Cauchy\(\), Sellmeier\(\) or No"),
    (lambda: Scene(PLATE, mixing=DopMixing()), "mixing: there is no subsurface to mix; give a sub"),
    (lambda: Scene(PLATE, Depolarizer()), "subsurface: nothing says how .* give mixing=Stokes"),
]


@each(("make", "message"), REFUSED, ids=lambda x: x if isinstance(x, str) else "")
def test_settings_that_make_no_sense_are_refused(make: object, message: str) -> None:
    with pytest.raises(pb.SceneError, match=message):
        make()
