"""Every part that can be simpler is found, wherever it sits and whoever wrote it."""

import dataclasses
from typing import ClassVar, override

import pytest
from cases import each

import polar_bayes as pb
from polar_bayes.physics.instrument import AbstractInstrumentTerm
from polar_bayes.physics.part import Part
from polar_bayes.physics.scene import FULL_SCENES
from polar_bayes.physics.variants import effects_of, find_effects, parts_of, simplify, unseen_layers
from polar_bayes.setups import SETUPS

ROUGH = pb.Scene(
    surface=pb.RoughSurface(
        pb.GGX(),
        pb.Disc(5.0),
        slopes=pb.physics.AnisotropicSlopes(),
        shadowing=pb.physics.NoShadowing(),
        way_out=pb.physics.RoughPassage(),
    ),
    subsurface=pb.Lambertian(internal_reflection=pb.physics.InternalReflection()),
    mixing=pb.StokesMixing(),
    coat=pb.physics.CoatStack((pb.ThinFilm(), pb.ClearCoat())),
    instrument=pb.instrument.Instrument((pb.instrument.AngleZero(), pb.instrument.DarkLevel())),
)


@dataclasses.dataclass(frozen=True)
class Speckle(Part):
    @override
    def simpler(self) -> tuple[Part | None, ...]:
        return (None,)


@dataclasses.dataclass(frozen=True)
class Fog(AbstractInstrumentTerm):
    """A user's own term, with a part of its own."""

    density: float = 1.0
    speckle: Speckle | None = None

    parameters: ClassVar[tuple[str, ...]] = ("fog",)

    @override
    def simpler(self) -> tuple[Part | None, ...]:
        return (Fog(0.5 * self.density, self.speckle), None)


@dataclasses.dataclass(frozen=True)
class Body(pb.Unpolarized):
    @override
    def simpler(self) -> tuple[Part | None, ...]:
        return (None,)


@dataclasses.dataclass(frozen=True)
class Mistaken(pb.physics.NoShadowing):
    @override
    def simpler(self) -> tuple[Part | None, ...]:
        return (None,)


def named(scene: pb.Scene) -> dict[str, pb.Scene]:
    return {effect.name: effect.apply(scene) for effect in effects_of(scene)}


def test_every_replacement_of_every_part_is_an_effect() -> None:
    assert {effect.name: effect.path for effect in effects_of(ROUGH)} == {
        "Disc -> PointSource": "surface.illumination",
        "FacetQuadrature -> FacetQuadrature(along=5, across=4)": "surface.quadrature",
        "AnisotropicSlopes -> IsotropicSlopes": "surface.slopes",
        "Lambertian -> Unpolarized": "subsurface",
        "InternalReflection": "subsurface.internal_reflection",
        "ThinFilm": "coat.coats[0]",
        "ClearCoat": "coat.coats[1]",
        "AngleZero": "instrument.terms[0]",
        "DarkLevel": "instrument.terms[1]",
    }
    # Light does not enter a body under filmed facets as through a plane.
    bare = dataclasses.replace(ROUGH, coat=None)
    plane = {"RoughPassage -> RoughExit", "RoughPassage -> SmoothExit"}
    assert plane <= {effect.name for effect in effects_of(bare)}


def test_each_changes_one_part_and_leaves_the_rest() -> None:
    for effect in effects_of(ROUGH):
        simpler = effect.apply(ROUGH)
        gone = {part for _, part in parts_of(ROUGH)} - {part for _, part in parts_of(simpler)}
        assert effect.part in gone
        assert effect.replacement is None or effect.replacement in dict(
            (part, place) for place, part in parts_of(simpler)
        )


def test_a_part_of_the_user_s_own_takes_part() -> None:
    fog = Fog(speckle=Speckle())
    scene = pb.Scene(
        pb.SmoothSurface(), instrument=pb.instrument.Instrument((pb.instrument.DolpGain(), fog))
    )
    effects = named(scene)
    assert list(effects) == ["DolpGain", "Fog -> Fog(density=0.5)", "Fog", "Speckle"]
    assert effects["Fog -> Fog(density=0.5)"].instrument.terms[1] == Fog(0.5, Speckle())
    assert effects["Speckle"].instrument.terms[1] == Fog()
    assert effects["Fog"].instrument == pb.instrument.Instrument((pb.instrument.DolpGain(),))


@pytest.mark.thorough
def test_what_holds_nothing_any_more_is_left_out_too() -> None:
    bare = simplify(ROUGH, [e for e in effects_of(ROUGH) if e.path.startswith(("inst", "coat"))])
    assert bare.instrument is None
    assert bare.coat is None
    without = named(pb.Scene(pb.SmoothSurface(), Body(), pb.StokesMixing()))["Body"]
    assert without == pb.Scene(pb.SmoothSurface())


@each(
    ("scene", "layers"),
    [
        (pb.Scene(pb.SmoothSurface()), ["water film", "thin film", "back face"]),
        (SETUPS["goniometer"].scene, ["water film", "thin film", "back face"]),
        # What scatters in a body, or on facets, is no transparent plate.
        (SETUPS["picture"].scene, ["water film", "thin film"]),
        (SETUPS["camera"].scene, ["water film", "thin film"]),
        (pb.Scene(pb.SmoothSurface(), coat=pb.ClearCoat()), ["back face"]),
        (pb.Scene(pb.SmoothSurface(back=pb.physics.BackFace())), ["water film", "thin film"]),
        (ROUGH, []),
    ],
)
def test_layers_that_nobody_sees_are_offered_where_a_scene_has_nothing(scene, layers) -> None:
    offered = unseen_layers(scene, has_wavelength=True)
    assert [each.name for each in offered] == layers
    for each_layer in offered:
        assert set(scene.parameters) <= set(each_layer.apply(scene).parameters)
    without = [each.name for each in unseen_layers(scene, has_wavelength=False)]
    assert without == [name for name in layers if name != "thin film"]


def test_a_part_and_what_is_inside_it_go_together() -> None:
    both = [effect for effect in effects_of(ROUGH) if effect.path.startswith("subsurface")]
    assert simplify(ROUGH, both).subsurface == pb.Unpolarized()
    assert simplify(ROUGH, both[:1]).subsurface == pb.Unpolarized(
        internal_reflection=pb.physics.InternalReflection()
    )


@pytest.mark.thorough
@each("scene", [ROUGH, *FULL_SCENES.values()])
def test_no_two_effects_share_a_name_or_a_scene(scene: pb.Scene) -> None:
    effects = effects_of(scene)
    assert len({effect.name for effect in effects}) == len(effects)
    assert len({effect.apply(scene) for effect in effects}) == len(effects)
    assert scene not in {effect.apply(scene) for effect in effects}


@pytest.mark.thorough
def test_equal_names_get_their_place() -> None:
    coats = (pb.ClearCoat("upper", "lacquer"), pb.ClearCoat())
    scene = pb.Scene(pb.SmoothSurface(), coat=pb.physics.CoatStack(coats))
    effects = named(scene)
    assert list(effects) == ["coat.coats[0]: ClearCoat", "coat.coats[1]: ClearCoat"]
    assert effects["coat.coats[0]: ClearCoat"].coat == pb.physics.CoatStack(coats[1:])


def test_a_replacement_that_does_not_fit_is_refused() -> None:
    with pytest.raises(pb.SceneError, match="RoughSurface: shadowing: None is no such part"):
        effects_of(pb.Scene(pb.RoughSurface(shadowing=Mistaken())))


@each(
    ("word", "found"),
    [
        ("AngleZero", ["AngleZero"]),
        ("subsurface", ["Lambertian -> Unpolarized"]),
        ("Disc", ["Disc -> PointSource"]),
        ("instrument.terms[1]", ["DarkLevel"]),
    ],
)
def test_an_effect_has_a_name_a_class_and_a_path(word: str, found: list[str]) -> None:
    assert [effect.name for effect in find_effects(word, effects_of(ROUGH), "keep")] == found


def test_an_unknown_effect_is_refused_with_the_names() -> None:
    with pytest.raises(pb.SceneError, match=r"drop='Fogg': the scene has no such effect; give one"):
        find_effects("Fogg", effects_of(ROUGH), "drop")


@pytest.mark.thorough
def test_every_set_up_has_a_scene_with_everything_on() -> None:
    assert set(FULL_SCENES) == set(SETUPS)
