"""Variants of a scene: without some effects, or with other parts.

There is no list of effects or of alternatives: every part whose `simpler` or `alternatives` gives
replacements has them, wherever it is in a scene and whoever wrote it. Layers that nobody sees, a
clear film or the back of a plate, are alternatives to a place where a scene has nothing.
"""

import dataclasses
import operator
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

from polar_bayes.errors import SceneError
from polar_bayes.physics.coat import BackFace, ClearCoat, ThinFilm
from polar_bayes.physics.part import Part
from polar_bayes.physics.scene import Scene, UnsuitablePartsError
from polar_bayes.physics.subsurface import Unpolarized
from polar_bayes.physics.surface import RoughPassage, RoughSurface, SmoothSurface

WATER_FILM = ClearCoat(1.333, 0.0)
"""A film of water, as on a wet leaf, a puddle or a plate with dew."""

KeyPath = tuple[str | int, ...]
"""Keys from a scene to a part: names of fields, and indices of tuples."""


@dataclasses.dataclass(frozen=True)
class Effect:
    """One part of a scene, or an empty place, and one replacement, simpler or alternative.

    Args:
        name: How it is called.
        key_path: Where the part is.
        part: What is there; None for nothing.
        replacement: What takes its place; None for nothing.
        needs: Replacements elsewhere, without which a scene refuses this one.
    """

    name: str
    key_path: KeyPath
    part: Part | None
    replacement: Part | None
    needs: tuple["Effect", ...] = ()

    @property
    def path(self) -> str:
        """The key path as text: `surface.shadowing`, `instrument.terms[0]`."""
        return _path(self.key_path)

    def apply(self, scene: Scene) -> Scene:
        """Return the scene without this effect; see `simplify`."""
        return simplify(scene, [self, *self.needs])


def effects_of(scene: Scene) -> tuple[Effect, ...]:
    """List every effect of a scene, in the order of its fields."""
    return _replacements(scene, operator.methodcaller("simpler"))


def alternatives_of(scene: Scene, *, has_wavelength: bool = True) -> tuple[Effect, ...]:
    """List parts of a scene with their alternatives, and layers that may be unseen."""
    found = _replacements(scene, operator.methodcaller("alternatives"))
    return (*found, *unseen_layers(scene, has_wavelength=has_wavelength))


def unseen_layers(scene: Scene, *, has_wavelength: bool) -> tuple[Effect, ...]:
    """Return films on the body and the back of a plate, if the scene has none there."""
    found = []
    if scene.coat is None:
        # Of a thick film the outer interface is all that polarization shows: only one whose index
        # is known can be told from a body.
        found.append(Effect("water film", ("coat",), None, WATER_FILM))
        if has_wavelength:
            found.append(Effect("thin film", ("coat",), None, ThinFilm(), _both_ways(scene)))
    # The body of a transparent plate scatters nothing; stray light may take its place.
    surface, is_clear = scene.surface, isinstance(scene.subsurface, Unpolarized | None)
    if isinstance(surface, SmoothSurface) and surface.back is None and is_clear:
        found.append(Effect("back face", ("surface", "back"), None, BackFace()))
    return tuple(found)


def _both_ways(scene: Scene) -> tuple[Effect, ...]:
    """Return what makes a body's light pass facets both ways, as it must under a thin film."""
    way = scene.surface.way_out if isinstance(scene.surface, RoughSurface) else None
    if way is None or way.both_ways or scene.subsurface is None:
        return ()
    return (Effect("facets both ways", ("surface", "way_out"), way, RoughPassage()),)


def _replacements(
    scene: Scene, offered: Callable[[Part], Iterable[Part | None]]
) -> tuple[Effect, ...]:
    """Yield every replacement that the parts of a scene offer, in the order of fields."""
    found: dict[Scene, tuple[KeyPath, Part, Part | None]] = {}
    for key_path, part in parts_of(scene):
        for replacement in offered(part):
            simpler = _applied(Effect("", key_path, part, replacement), scene)
            if simpler not in (scene, None) and len(key_path) >= len(found.get(simpler, ((),))[0]):
                found[simpler] = key_path, part, replacement
    short = [_name(part, replacement) for _, part, replacement in found.values()]
    return tuple(
        Effect(
            name if short.count(name) == 1 else f"{_path(key_path)}: {name}",
            key_path,
            part,
            replacement,
        )
        for name, (key_path, part, replacement) in zip(short, found.values(), strict=True)
    )


def _applied(effect: Effect, scene: Scene) -> Scene | None:
    """Return the scene without an effect; None if its parts would be incompatible."""
    try:
        return effect.apply(scene)
    except UnsuitablePartsError:
        return None


def simplify(scene: Scene, effects: Iterable[Effect]) -> Scene:
    """Return the scene without some of its effects."""
    chosen = {effect.key_path: effect for effect in effects}
    parts = {
        field.name: _rebuilt(getattr(scene, field.name), (field.name,), chosen)
        for field in dataclasses.fields(Scene)
    }
    if parts["subsurface"] is None:
        parts["mixing"] = None
    return Scene(**parts)


def find_effects(name: str, effects: Iterable[Effect], where: str) -> tuple[Effect, ...]:
    """Return the effects of a name: a class of a part, or a path."""
    effects = tuple(effects)
    found = tuple(effect for effect in effects if effect.name == name) or tuple(
        effect for effect in effects if name in (type(effect.part).__name__, effect.path)
    )
    if not found:
        known = ", ".join(effect.name for effect in effects) or "none: nothing can be left out"
        hint = f"give one of {known}"
        raise SceneError("the scene has no such effect", where=f"{where}={name!r}", hint=hint)
    return found


def parts_of(value: object, key_path: KeyPath = ()) -> Iterator[tuple[KeyPath, Part]]:
    """Yield every part inside a value, itself included, outermost first, with key paths."""
    if isinstance(value, Part):
        yield key_path, value
    for step, inner in _inside(value):
        yield from parts_of(inner, (*key_path, step))


def _inside(value: object) -> Iterator[tuple[str | int, object]]:
    if isinstance(value, tuple):
        yield from enumerate(value)
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        for field in dataclasses.fields(value):
            if field.init:
                yield field.name, getattr(value, field.name)


def _rebuilt(value: Any, key_path: KeyPath, effects: Mapping[KeyPath, Effect]) -> Any:
    """Return the value with replacements, outermost first."""
    effect = effects.get(key_path)
    if effect is not None and value == effect.part:
        value = effect.replacement
    inner = dict(_inside(value))
    changed = {}
    for step, old in inner.items():
        new = _rebuilt(old, (*key_path, step), effects)
        if new is not old:
            changed[step] = new
    if not changed:
        return value
    if isinstance(value, tuple):
        rest = (changed.get(step, old) for step, old in inner.items())
        return tuple(part for part in rest if part is not None)
    if len(inner) == 1 and () in changed.values():
        return None  # an instrument of no terms, a stack of no coats
    return dataclasses.replace(value, **{str(name): part for name, part in changed.items()})


def _name(part: Part, replacement: Part | None) -> str:
    before = type(part).__name__
    if replacement is None:
        return before
    after = type(replacement).__name__
    if after != before:
        return f"{before} -> {after}"
    differing = ", ".join(
        f"{name}={new!r}" for name, new in _inside(replacement) if new != getattr(part, str(name))
    )
    return f"{before} -> {after}({differing})"


def _path(key_path: KeyPath) -> str:
    steps = (f"[{step}]" if isinstance(step, int) else f".{step}" for step in key_path)
    return "".join(steps).removeprefix(".")
