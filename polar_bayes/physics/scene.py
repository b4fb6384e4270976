"""A scene: the optics and the instrument that turn material parameters into predicted readings."""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import ClassVar, override

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from polar_bayes.errors import SceneError
from polar_bayes.physics.coat import AbstractCoat, CoatStack, ThinFilm
from polar_bayes.physics.dispersion import AbstractDispersion
from polar_bayes.physics.facets import FacetQuadrature
from polar_bayes.physics.geometry import Geometry
from polar_bayes.physics.illumination import PointSource
from polar_bayes.physics.input_quantities import AbstractInputQuantity
from polar_bayes.physics.instrument import (
    AbstractInstrumentTerm,
    AngleZero,
    BeamOverlap,
    ChannelGain,
    DarkLevel,
    Discrepancy,
    DolpGain,
    Instrument,
    Leakage,
    TiltedNormal,
)
from polar_bayes.physics.microfacet import Beckmann, HeightCorrelatedShadowing
from polar_bayes.physics.mixing import AbstractMixing, DopMixing, StokesMixing
from polar_bayes.physics.part import MATERIAL, Parameters, check_part, notation, parameters_of
from polar_bayes.physics.stack import Stack
from polar_bayes.physics.stokes import Light, degree_of_linear_polarization, to_stokes
from polar_bayes.physics.subsurface import AbstractSubsurface, Depolarizer, Lambertian, Unpolarized
from polar_bayes.physics.surface import (
    AbstractSurface,
    Interface,
    InternalReflection,
    RoughSurface,
    SmoothSurface,
)
from polar_bayes.repr_html import HTMLRepr, Row, Table

MATERIAL_PARAMETERS = tuple(MATERIAL)


@dataclasses.dataclass(frozen=True)
class Scene(HTMLRepr):
    """Optics and instrument as parts; parts that are None are absent from compiled programs.

    Args:
        surface: SmoothSurface() or RoughSurface(...).
        subsurface: Unpolarized(), Lambertian(), Depolarizer(), TurbidMedium(), or None for no
            light from below.
        mixing: DopMixing() or StokesMixing(); needed with a subsurface, and only then.
        coat: ClearCoat(), ThinFilm(), CoatStack((...)), or None for a bare surface.
        instrument: Instrument((...)), or None for a perfect one.
        dispersion: Cauchy() or Sellmeier(), whose parameters then replace `refractive_index`; or
            None for one index per wavelength.
        normal: TiltedNormal(), where the stated normal may be wrong; or None where it is right.

    Raises:
        SceneError: A part is of the wrong kind, one is missing beside another, or light enters a
            body under filmed facets as through a plane.
    """

    surface: AbstractSurface
    subsurface: AbstractSubsurface | None = None
    mixing: AbstractMixing | None = None
    coat: AbstractCoat | None = None
    instrument: Instrument | None = None
    dispersion: AbstractDispersion | None = None
    normal: TiltedNormal | None = None

    ledger: ClassVar[object | None] = None
    """Record of how the scene was chosen; see `polar_bayes.choose_effects`."""

    def __post_init__(self) -> None:
        check_part(self.surface, "surface", AbstractSurface, "SmoothSurface() or RoughSurface()")
        for name, kind, allowed in (
            ("subsurface", AbstractSubsurface, "Unpolarized(), Lambertian(), Depolarizer()"),
            ("mixing", AbstractMixing, "DopMixing(), StokesMixing()"),
            ("coat", AbstractCoat, "ClearCoat(), ThinFilm(), CoatStack((...))"),
            ("instrument", Instrument, "Instrument((DolpGain(), ...))"),
            ("dispersion", AbstractDispersion, "Cauchy(), Sellmeier()"),
            ("normal", TiltedNormal, "TiltedNormal()"),
        ):
            if getattr(self, name) is not None:
                check_part(getattr(self, name), name, kind, f"{allowed} or None")
        if self.mixing is not None and self.subsurface is None:
            hint = "give a subsurface, such as Depolarizer(), or leave mixing=None"
            raise SceneError("there is no subsurface to mix", where="mixing", hint=hint)
        if self.subsurface is not None and self.mixing is None:
            what = "nothing says how its light adds to the surface's"
            hint = "give mixing=StokesMixing() or DopMixing(), or leave subsurface=None"
            raise SceneError(what, where="subsurface", hint=hint)
        way_out = self.surface.way_out if isinstance(self.surface, RoughSurface) else None
        plane = way_out is not None and not way_out.both_ways
        if plane and self.subsurface is not None and _has_film(self.coat):
            what = "facets under a thin film reflect what a plane under it lets in, up to 4% twice"
            hint = "give the surface way_out=RoughPassage(), which makes no light"
            where = f"way_out: {way_out!r} with ThinFilm"
            raise UnsuitablePartsError(what, where=where, hint=hint)

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters that the scene reads: the material's first."""
        index = ("refractive_index",) if self.dispersion is None else self.dispersion.parameters
        optics = parameters_of(self.surface, self.subsurface, self.mixing)
        rest = parameters_of(self.coat, self.normal, self.instrument)
        read = tuple(dict.fromkeys((*optics, *index, *rest)))
        material = tuple(name for name in MATERIAL_PARAMETERS if name in read)
        return (*material, *(name for name in read if name not in MATERIAL_PARAMETERS))

    @property
    def terms(self) -> tuple[AbstractInstrumentTerm, ...]:
        """Terms of the instrument; empty for a perfect one."""
        return () if self.instrument is None else self.instrument.terms

    @property
    def optical_parameters(self) -> tuple[str, ...]:
        """Names of the parameters that are not the instrument's."""
        instrument = () if self.instrument is None else self.instrument.parameters
        return tuple(name for name in self.parameters if name not in instrument)

    @override
    def extra_tables(self) -> tuple[Table, ...]:
        rows = tuple(Row(name, notation(name)) for name in self.parameters)
        columns = ("parameter", "symbol", "meaning", "unit")
        return (Table(columns, rows, prose=columns),)

    def light(self, parameters: Mapping[str, ArrayLike], geometry: Geometry) -> Light:
        """Return the light that reaches the viewer, before any instrument.

        Args:
            parameters: Material parameters by name; more than the scene reads may be given.
                Shape (...), which must broadcast with the leading axes of the geometry.
            geometry: Directions. Shape (..., view), degree.

        Returns:
            Light of shape (..., view).

        Raises:
            SceneError: A material parameter that the scene reads is missing.
        """
        per_view = self._per_view(parameters, self.optical_parameters, geometry)
        return self._optics(per_view, geometry)

    def stokes(self, parameters: Mapping[str, ArrayLike], geometry: Geometry) -> Array:
        """Return the Stokes vector S0, S1, S2 that reaches the viewer, before any instrument.

        Args:
            parameters: Material parameters by name. Shape (...), 1.
            geometry: Directions. Shape (..., view), degree.

        Returns:
            Stokes vectors for unit irradiance; unit radiance under a disc or sky.
            Shape (..., view, 3).

        Raises:
            SceneError: A material parameter that the scene reads is missing.
        """
        return to_stokes(self.light(parameters, geometry))

    def predict(self, parameters: Mapping[str, ArrayLike], geometry: Geometry) -> dict[str, Array]:
        """Return readings as the instrument records them, without noise.

        Args:
            parameters: Material and instrument parameters by name. Shape (...);
                `discrepancy_weights` has a trailing axis over its basis. With `exposure`, recorded
                over predicted intensity, no reading is brighter than a full scale of 1.
            geometry: Directions as read off. Shape (..., view), degree.

        Returns:
            `dop`, `q`, `u` and `intensity`, each (..., view).

        Raises:
            SceneError: A parameter that the scene reads is missing.
        """
        return self.record(parameters, geometry, self.arriving(parameters, geometry))

    def arriving(self, parameters: Mapping[str, ArrayLike], geometry: Geometry) -> Light:
        """Return the light that reaches the instrument, in the directions that it really has.

        Args:
            parameters: As `predict` takes them.
            geometry: Directions as read off. Shape (..., view), degree.

        Returns:
            Light of shape (..., view).

        Raises:
            SceneError: A parameter that the scene reads is missing.
        """
        per_view = self._per_view(parameters, self.parameters, geometry)
        true = geometry if self.instrument is None else self.instrument.aim(per_view, geometry)
        return self._optics(per_view, true)

    def record(
        self, parameters: Mapping[str, ArrayLike], geometry: Geometry, light: Light
    ) -> dict[str, Array]:
        """Return readings, without noise, of the light that reaches the instrument.

        Args:
            parameters: As `predict` takes them.
            geometry: Directions as read off. Shape (..., view), degree.
            light: As `arriving` returns it. Shape (..., view).

        Returns:
            As `predict` returns them.

        Raises:
            SceneError: A parameter that the scene reads is missing.
        """
        if self.instrument is not None:
            names = *self.parameters, *(("exposure",) if "exposure" in parameters else ())
            per_view = self._per_view(parameters, names, geometry)
            light = self.instrument.record(per_view, geometry, light)
        intensity, q, u = jnp.broadcast_arrays(*light)
        dop = degree_of_linear_polarization(q, u)
        return _computed_once({"dop": dop, "q": q, "u": u, "intensity": intensity})

    def has(self, term: type[AbstractInstrumentTerm]) -> bool:
        """Return whether the instrument has a term of a type.

        Args:
            term: Class of the term, such as DarkLevel.

        Returns:
            False too where there is no instrument.
        """
        return any(isinstance(part, term) for part in self.terms)

    def without(self, term: type[AbstractInstrumentTerm]) -> "Scene":
        """Return the scene with one instrument term removed.

        Args:
            term: Class of the term, such as DarkLevel.

        Returns:
            A new scene; its instrument is None when no term is left.

        Raises:
            SceneError: The scene has no such term.
        """
        rest = tuple(part for part in self.terms if not isinstance(part, term))
        if len(rest) == len(self.terms):
            present = ", ".join(type(part).__name__ for part in self.terms) or "none"
            hint = f"name one of its instrument terms: {present}"
            raise SceneError(f"the scene has no {term.__name__}", where="without", hint=hint)
        return self._with_terms(rest)

    def known_to(self, quantities: Iterable[AbstractInputQuantity]) -> "Scene":
        """Return the scene with these input quantities added, except those it has.

        Args:
            quantities: What the set-up is known to, such as `LightZenith()`.

        Returns:
            A new scene; the quantities follow the other terms of its instrument.
        """
        own = {type(term) for term in self.terms}
        added = (each for each in quantities if type(each) not in own)
        return self._with_quantities((*self.terms, *added))

    @property
    def perfectly_known(self) -> "Scene":
        """The scene without input quantities."""
        others = (x for x in self.terms if not isinstance(x, AbstractInputQuantity))
        return self._with_quantities(tuple(others))

    def _with_terms(self, terms: tuple[AbstractInstrumentTerm, ...]) -> "Scene":
        return dataclasses.replace(self, instrument=Instrument(terms) if terms else None)

    def _with_quantities(self, terms: tuple[AbstractInstrumentTerm, ...]) -> "Scene":
        """The scene with other input quantities, which are no effects: its ledger stays true."""
        if terms == self.terms:
            return self
        found = self._with_terms(terms)
        if self.ledger is not None:
            object.__setattr__(found, "ledger", self.ledger)
        return found

    def _optics(self, parameters: Parameters, geometry: Geometry) -> Light:
        """Return light in the stated frame of the viewer, for parameters with a view axis."""
        geometry = geometry.resolved()
        if self.normal is None:
            return self._material(parameters, geometry)
        inside, turn = self.normal.enter(parameters, geometry)
        return self.normal.leave(self._material(parameters, inside), turn)

    def _material(self, parameters: Parameters, geometry: Geometry) -> Light:
        """Return surface, body and their mixture, in directions from the true normal."""
        if self.dispersion is not None:
            index = self.dispersion.index(parameters, self._wavelength(geometry))
            parameters = {**parameters, "refractive_index": index}
        layers = () if self.coat is None else self.coat.layers(parameters, geometry.wavelength)
        stack = Stack(parameters["refractive_index"], layers)
        light = self.surface.light(parameters, geometry, stack)
        if self.subsurface is not None and self.mixing is not None:
            interface = Interface(self.surface, stack)
            subsurface = self.subsurface.light(parameters, geometry, interface)
            light = self.mixing.mix(parameters["subsurface_fraction"], light, subsurface)
        return _computed_once(Light(*jnp.broadcast_arrays(*light)))

    def _neutral_quantities(self) -> dict[str, float]:
        known = (term for term in self.terms if isinstance(term, AbstractInputQuantity))
        return {name: value for term in known for name, value in term.neutral.items()}

    def _wavelength(self, geometry: Geometry) -> Array:
        if geometry.wavelength is None:
            what = "a law of dispersion needs a wavelength, and there is none"
            hint = "give the geometry a wavelength in nm, or the capture such a coordinate"
            raise SceneError(what, where="dispersion", hint=hint)
        return geometry.wavelength

    def _per_view(
        self, parameters: Mapping[str, ArrayLike], names: tuple[str, ...], geometry: Geometry
    ) -> dict[str, Array]:
        """Return the scene's parameters in one precision, each with a trailing view axis."""
        # A Python number takes the precision of the arrays beside it.
        # Who does not know of an input quantity, such as a model of the user's own, has none.
        parameters = {**self._neutral_quantities(), **parameters}
        missing = [name for name in names if name not in parameters]
        if missing:
            hint = f"this scene reads {', '.join(names)}"
            raise SceneError(f"{', '.join(missing)} missing", where="parameters", hint=hint)
        dtype = jnp.result_type(geometry.dtype, *(parameters[name] for name in names))
        return {name: jnp.asarray(parameters[name], dtype)[..., None] for name in names}


def _computed_once[T](values: T) -> T:
    """The same values; XLA's CPU compiler would fuse the optics into all that reads them."""
    return jax.lax.optimization_barrier(values)


class UnsuitablePartsError(SceneError):
    """Two parts are incompatible, although each is valid with other parts."""


def _has_film(coat: AbstractCoat | None) -> bool:
    """Return whether a coat is a thin film, or a stack that contains one."""
    if isinstance(coat, CoatStack):
        return any(_has_film(each) for each in coat.coats)
    return isinstance(coat, ThinFilm)


# --- Scenes by name, as they are used and with every effect on that such a set-up may have --------


# Twenty facets for the way out of the body: DoP within 0.0005 and brightness within 0.15 % of 400
# facets for every roughness up to 0.5 and zenith up to 85 degrees (tests/physics/test_scenes.py).
WAY_OUT = FacetQuadrature(along=5, across=4)

# Eighty facets, where the number of facets itself is to be judged.
MANY_FACETS = FacetQuadrature(along=10, across=8)

_PAPER = Scene(
    surface=RoughSurface(Beckmann(), PointSource(), WAY_OUT),
    subsurface=Depolarizer(),
    mixing=DopMixing(),
)

SCENES: dict[str, Scene] = {
    # Equation 1 as printed: unsigned degrees of polarization, one fraction for all views.
    "paper": _PAPER,
    "polarimeter": _PAPER,
    # A camera with a polarizer: Stokes vectors add; its extinction ratio is finite.
    "camera": Scene(
        surface=RoughSurface(Beckmann(), PointSource(), WAY_OUT),
        subsurface=Lambertian(),
        mixing=StokesMixing(),
        instrument=Instrument((DolpGain(),)),
    ),
    # One picture, read without its brightness: how rough the surface is cannot be told apart from
    # how much of its light falls towards the camera, so that a smooth one stands for any.
    "picture": Scene(surface=SmoothSurface(), subsurface=Lambertian(), mixing=StokesMixing()),
    # A goniometer on a polished plate: the whole reflected beam is caught, s and p in turn.
    "goniometer": Scene(
        surface=SmoothSurface(),
        subsurface=Unpolarized(),
        mixing=StokesMixing(),
        # No DarkLevel: over angle it looks like the unpolarized body, which is there already.
        instrument=Instrument((AngleZero(), ChannelGain(), Leakage(), Discrepancy())),
    ),
}

_FULL_SURFACE = RoughSurface(
    Beckmann(), PointSource(), MANY_FACETS, shadowing=HeightCorrelatedShadowing()
)

FULL_SCENES: dict[str, Scene] = {
    **dict.fromkeys(
        ("paper", "polarimeter"),
        dataclasses.replace(
            _PAPER, surface=_FULL_SURFACE, instrument=Instrument((AngleZero(), DarkLevel()))
        ),
    ),
    "camera": dataclasses.replace(
        SCENES["camera"],
        surface=_FULL_SURFACE,
        subsurface=Lambertian(internal_reflection=InternalReflection()),
        instrument=Instrument((AngleZero(), DolpGain(), DarkLevel())),
    ),
    "picture": dataclasses.replace(
        SCENES["picture"],
        subsurface=Lambertian(internal_reflection=InternalReflection()),
        instrument=Instrument((DolpGain(),)),
    ),
    "goniometer": dataclasses.replace(
        SCENES["goniometer"],
        instrument=Instrument(
            (AngleZero(), BeamOverlap(), ChannelGain(), Leakage(), Discrepancy())
        ),
    ),
}
"""The named scenes with all effects, from which `polar_bayes.choose_effects` starts."""
