"""Which effects a scene keeps: each is weighed alone, then all that may go are weighed together."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence

from polar_bayes.budget.linearized import Change
from polar_bayes.budget.scales import Reference, Scales
from polar_bayes.budget.variants import Effect, Place, find_effects, parts_of, simplify
from polar_bayes.errors import FitError, SceneError
from polar_bayes.physics.scene import Scene


@dataclasses.dataclass(frozen=True)
class Wishes:
    """What the user decided."""

    keep: tuple[Effect, ...] = ()
    drop: tuple[Effect, ...] = ()

    @classmethod
    def of(
        cls, effects: Sequence[Effect], keep: str | Iterable[str], drop: str | Iterable[str]
    ) -> "Wishes":
        """The effects that words mean."""
        kept, dropped = (
            tuple(effect for word in words for effect in find_effects(word, effects, where))
            for where, words in (("keep", _words(keep)), ("drop", _words(drop)))
        )
        for effect in dropped:
            if effect in kept:
                raise SceneError(
                    "it is both to keep and to drop", where=effect.name, mend="name it in one only"
                )
        return cls(kept, dropped)

    def hold(self, effect: Effect, full: Scene) -> bool:
        """Whether leaving out the effect would take away something that is to be kept."""
        rest = [part for _, part in parts_of(effect.apply(full))]
        return any(kept.part not in rest for kept in self.keep)


@dataclasses.dataclass(frozen=True, eq=False)
class Weighed:
    """Each effect left out alone of the scene with everything on."""

    whole: Reference
    changes: dict[Effect, Change]
    operations: dict[Effect, float]

    def size(self, effect: Effect) -> float:
        """The largest change of a judged parameter without the effect."""
        return self.whole.size(self.changes[effect])

    def by_place(self, effects: Iterable[Effect]) -> dict[Place, list[Effect]]:
        """Effects by the place of their part, the replacement of fewest operations first."""
        places: dict[Place, list[Effect]] = {}
        for effect in sorted(effects, key=self.operations.__getitem__):
            places.setdefault(effect.place, []).append(effect)
        return places


@dataclasses.dataclass(frozen=True, eq=False)
class Verdict:
    """What the rule comes to."""

    scene: Scene
    base: Reference
    combined: Change
    kept: dict[Effect, bool]
    reasons: dict[Effect, str]


def weigh(
    scales: Scales, full: Scene, effects: Sequence[Effect], parameters: tuple[str, ...] | None
) -> Weighed:
    """Leave out each effect alone."""
    whole = scales.reference(full, parameters)
    _check_names(whole, parameters or ())
    changes, operations = {}, {}
    for number, effect in enumerate(effects):
        density = scales.density(effect.apply(full))
        changes[effect] = whole.compare(density)
        operations[effect] = density.compiled.operations
        scales.progress("weighing effects", (number + 1) / len(effects))
    return Weighed(whole, changes, operations)


def decide(
    scales: Scales, full: Scene, weighed: Weighed, wishes: Wishes, tolerance: float
) -> Verdict:
    """Leave out together whatever may go."""
    forced = [options[0] for options in weighed.by_place(wishes.drop).values()]
    base = weighed.whole
    if forced:
        bare = simplify(full, forced)
        base = base.beside(scales.density(bare))
        if not base.peak.found:
            base = scales.reference(bare, base.names)
    free = [
        effect
        for effect in weighed.changes
        if weighed.size(effect) <= tolerance
        and effect.place not in {other.place for other in forced}
        and not wishes.hold(effect, full)
    ]
    chosen, combined, put_back = _go_together(
        lambda gone: base.compare(scales.density(simplify(full, [*forced, *gone]))),
        base,
        weighed,
        free,
        tolerance,
    )
    scene = simplify(full, [*forced, *chosen])
    replaced = {effect.place: effect for effect in (*forced, *chosen)}
    left = [part for _, part in parts_of(scene)]
    kept = {e: e.place not in replaced and e.part in left for e in weighed.changes}
    remarks = dict.fromkeys((*forced, *wishes.keep), "by your choice") | put_back
    for effect in kept.keys() - remarks.keys() - set(chosen):
        remarks[effect] = _remark(effect, replaced, kept[effect])
    reasons = {e: _reason(weighed, e, tolerance, remarks.get(e), kept[e]) for e in kept}
    return Verdict(scene, base, combined, kept, reasons)


def _go_together(
    without: Callable[[list[Effect]], Change],
    base: Reference,
    weighed: Weighed,
    free: list[Effect],
    tolerance: float,
) -> tuple[list[Effect], Change, dict[Effect, str]]:
    """The effects that may go together, what changes then, and why others came back."""
    waiting = weighed.by_place(free)
    put_back: dict[Effect, str] = {}
    while True:
        chosen = [options[0] for options in waiting.values() if options]
        combined = without(chosen)
        if base.size(combined) <= tolerance or not chosen:
            return chosen, combined, put_back
        worst = max(chosen, key=weighed.size)
        waiting[worst.place].remove(worst)
        put_back[worst] = f"with all others that could go, {base.says(combined)}"


def _remark(effect: Effect, replaced: Mapping[Place, Effect], kept: bool) -> str:
    """What decided about an effect that neither the user nor the rule picked."""
    if effect.place in replaced:
        return f"{replaced[effect.place].name} instead"
    return "" if kept else "it goes with the part around it"


def _reason(
    weighed: Weighed, effect: Effect, tolerance: float, remark: str | None, kept: bool
) -> str:
    """Why an effect stays or goes: what decided beside the rule, and what the rule saw."""
    size, change = weighed.size(effect), weighed.changes[effect]
    seen = weighed.whole.says(change)
    if size <= tolerance:
        which = "parameter" if weighed.whole.names is None else "judged parameter"
        seen = f"alone no {which} changes by more than {max(size, 0.001):.2g} sd"
        remark = remark or ("a part of it stays by your choice" if kept else "")
    lost = () if kept else weighed.whole.lost(change)
    unfitted = f"not fitted then: {', '.join(lost)}" if lost else ""
    return "; ".join(text for text in (remark, seen, unfitted) if text)


def _check_names(whole: Reference, parameters: Iterable[str]) -> None:
    density = whole.peak.density
    for name in parameters:
        if name not in density.labels and name not in density.sites:
            raise FitError(
                "the scene with everything on has no such parameter",
                where=f"parameters: {name!r}",
                mend=f"give any of {', '.join(dict.fromkeys(density.sites))}",
            )


def _words(names: str | Iterable[str]) -> tuple[str, ...]:
    return (names,) if isinstance(names, str) else tuple(names)
