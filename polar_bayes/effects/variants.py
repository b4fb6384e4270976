"""Every way to make a scene simpler by one effect, and scenes with several of them left out.

There is no list of effects: whatever part says in `simpler` what may stand in its place takes
part, wherever it sits in a scene and whoever wrote it.
"""

import dataclasses
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from polar_bayes.errors import SceneError
from polar_bayes.physics.part import Part
from polar_bayes.physics.scene import Scene

Place = tuple[str | int, ...]
"""The way from a scene to a part: names of fields, and positions in tuples."""


@dataclasses.dataclass(frozen=True)
class Effect:
    """One part of a scene, and one thing that may stand in its place."""

    name: str
    place: Place
    part: Part
    replacement: Part | None

    @property
    def path(self) -> str:
        """Where the part sits, as text: `surface.shadowing`, `instrument.terms[0]`."""
        return _path(self.place)

    def apply(self, scene: Scene) -> Scene:
        """The scene without this effect; see `simplify`."""
        return simplify(scene, [self])


def effects_of(scene: Scene) -> tuple[Effect, ...]:
    """Every effect of a scene, in the order of its fields."""
    found: dict[Scene, tuple[Place, Part, Part | None]] = {}
    for place, part in parts_of(scene):
        for replacement in part.simpler():
            simpler = simplify(scene, [Effect("", place, part, replacement)])
            if simpler != scene and len(place) >= len(found.get(simpler, ((),))[0]):
                found[simpler] = place, part, replacement
    short = [_name(part, replacement) for _, part, replacement in found.values()]
    return tuple(
        Effect(
            name if short.count(name) == 1 else f"{_path(place)}: {name}", place, part, replacement
        )
        for name, (place, part, replacement) in zip(short, found.values(), strict=True)
    )


def simplify(scene: Scene, effects: Iterable[Effect]) -> Scene:
    """The scene without some of its effects."""
    chosen = {effect.place: effect for effect in effects}
    parts = {
        field.name: _rebuilt(getattr(scene, field.name), (field.name,), chosen)
        for field in dataclasses.fields(Scene)
    }
    if parts["subsurface"] is None:
        parts["mixing"] = None
    return Scene(**parts)


def find_effects(word: str, effects: Iterable[Effect], where: str) -> tuple[Effect, ...]:
    """The effects that a user means by one word."""
    effects = tuple(effects)
    named = tuple(effect for effect in effects if effect.name == word)
    meant = named or tuple(
        effect for effect in effects if word in (type(effect.part).__name__, effect.path)
    )
    if not meant:
        known = ", ".join(effect.name for effect in effects) or "none: nothing can be left out"
        raise SceneError(
            "the scene has no such effect", where=f"{where}={word!r}", hint=f"give one of {known}"
        )
    return meant


def parts_of(value: object, place: Place = ()) -> Iterator[tuple[Place, Part]]:
    """Every part inside a value, itself included, outermost first, and where it sits."""
    if isinstance(value, Part):
        yield place, value
    for step, inner in _inside(value):
        yield from parts_of(inner, (*place, step))


def _inside(value: object) -> Iterator[tuple[str | int, object]]:
    if isinstance(value, tuple):
        yield from enumerate(value)
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        for field in dataclasses.fields(value):
            if field.init:
                yield field.name, getattr(value, field.name)


def _rebuilt(value: Any, place: Place, effects: Mapping[Place, Effect]) -> Any:
    """The value with replacements put in, outermost first."""
    effect = effects.get(place)
    if effect is not None and value == effect.part:
        value = effect.replacement
    inner = dict(_inside(value))
    changed = {}
    for step, old in inner.items():
        new = _rebuilt(old, (*place, step), effects)
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


def _path(place: Place) -> str:
    steps = (f"[{step}]" if isinstance(step, int) else f".{step}" for step in place)
    return "".join(steps).removeprefix(".")
