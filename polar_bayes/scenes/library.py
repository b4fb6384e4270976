"""Candidate scenes: parts that the variables and the geometry of a capture allow.

A candidate takes one option of each slot: a surface with its source, a body or none, the systematic
errors of the instrument or none, and so on. Systematic errors are one option together: an unknown
angle zero without a discrepancy explains by a shifted angle what a smooth error has caused. Layers
that nobody sees, films and the back of a plate, are added to what was selected
(`polar_bayes.physics.variants.unseen_layers`).
"""

import dataclasses
from collections.abc import Collection, Iterator, Mapping
from types import MappingProxyType
from typing import Any

import xarray as xr

from polar_bayes.observation.links import AbstractLink, BetaLink, StokesLink, StudentTLink
from polar_bayes.physics.illumination import PointSource, UniformSky
from polar_bayes.physics.instrument import (
    AngleZero,
    ChannelGain,
    Discrepancy,
    Instrument,
    TiltedNormal,
)
from polar_bayes.physics.microfacet import GGX, Beckmann
from polar_bayes.physics.mixing import AbstractMixing, StokesMixing
from polar_bayes.physics.scene import WAY_OUT, Scene
from polar_bayes.physics.subsurface import Depolarizer, Lambertian, Unpolarized
from polar_bayes.physics.surface import RoughSurface, SmoothSurface
from polar_bayes.setups import SETUPS, Setup, is_mirrored

Choice = tuple[str, ...]
"""Option of each slot, by name; "" for an empty slot."""

SURFACES: Mapping[str, Any] = MappingProxyType(
    {
        "mirror": SmoothSurface(),
        "rough surface": RoughSurface(Beckmann(), PointSource(), WAY_OUT),
        "sky": RoughSurface(Beckmann(), UniformSky(), WAY_OUT),
        "rough GGX surface": RoughSurface(GGX(), PointSource(), WAY_OUT),
    }
)
OTHER_SLOPES = MappingProxyType({"rough surface": "rough GGX surface"})
"""Surfaces that differ only in their slopes; the second is an alternative, not an extension."""
BODIES: Mapping[str, Any] = MappingProxyType(
    {
        "unpolarized body": Unpolarized(),
        "Lambertian body": Lambertian(),
        "depolarizing body": Depolarizer(),
    }
)


@dataclasses.dataclass(frozen=True)
class SceneLibrary:
    """Options of each slot for one capture, the simplest first.

    Args:
        surfaces: Surfaces with their sources, by name.
        bodies: Bodies under the surface, by name; the first is the one that is added, the others
            are compared with it.
        mixing: How surface and body add up.
        others: Parts by the field of the scene and by name, each of which may be there or not.
    """

    surfaces: Mapping[str, Any]
    bodies: Mapping[str, Any]
    mixing: AbstractMixing
    others: Mapping[str, Mapping[str, Any]]

    @property
    def simplest(self) -> Choice:
        """The first surface without any other option."""
        return (next(iter(self.surfaces)), "", *("" for _ in self.others))

    def scene(self, choice: Choice) -> Scene:
        """Return the scene of a choice.

        Args:
            choice: The option of each slot: surface, body, then those of `others`.

        Returns:
            The scene.
        """
        surface, body, *rest = choice
        named = zip(self.others.items(), rest, strict=True)
        return Scene(
            surface=self.surfaces[surface],
            subsurface=self.bodies[body] if body else None,
            mixing=self.mixing if body else None,
            **{field: options[name] for (field, options), name in named if name},
        )

    def single_parts(self) -> Iterator[Scene]:
        """Return scenes that together contain every option.

        Yields:
            The simplest scene with each option in turn.
        """
        slots = (self.surfaces, self.bodies, *self.others.values())
        for slot, options in enumerate(slots):
            for name in options:
                choice = list(self.simplest)
                choice[slot] = name
                yield self.scene(tuple(choice))

    def extensions(self, choice: Choice) -> Iterator[Choice]:
        """Return choices with one part more, or with another surface.

        Args:
            choice: The option of each slot.

        Yields:
            Other choices.
        """
        yield from self._other_surfaces(choice)
        for slot, options in enumerate((self.bodies, *self.others.values()), start=1):
            if not choice[slot]:
                yield (*choice[:slot], next(iter(options)), *choice[slot + 1 :])

    def _other_surfaces(self, choice: Choice) -> Iterator[Choice]:
        for surface in self.surfaces:
            if surface != choice[0] and surface not in OTHER_SLOPES.values():
                yield (surface, *choice[1:])

    def other_bodies(self, choice: Choice) -> Iterator[Choice]:
        """Return choices with another body in place of the present one.

        Args:
            choice: The option of each slot.

        Yields:
            Other choices.
        """
        if choice[1]:
            yield from ((choice[0], body, *choice[2:]) for body in self.bodies if body != choice[1])

    def alternatives(self, choice: Choice) -> Iterator[Choice]:
        """Return choices with other slopes, body or surface, or with one part less.

        Args:
            choice: The option of each slot.

        Yields:
            Other choices.
        """
        for pair in OTHER_SLOPES.items():
            if choice[0] in pair and set(pair) <= set(self.surfaces):
                yield (pair[1 - pair.index(choice[0])], *choice[1:])
        yield from self.other_bodies(choice)
        for slot in range(1, len(choice)):
            if choice[slot]:
                yield (*choice[:slot], "", *choice[slot + 1 :])
        yield from self._other_surfaces(choice)


def scene_library(capture: xr.Dataset, variables: Collection[str] | None = None) -> SceneLibrary:
    """Return the parts that a capture allows.

    A mirror needs views in the mirror direction of the light; a rough surface under a point source
    in that direction sends the polarization of the mirror, so that it needs a fitted brightness. A
    sky is no candidate where the light is stated to be a beam. A leaning normal needs u.

    Args:
        capture: A validated Dataset of the capture schema.
        variables: Recorded variables that are fitted; by default those that the links of its set-up
            describe, or all that it holds where it names none.

    Returns:
        The options, with the body, mixing and instrument of the set-up that the capture names.
    """
    setup = named_setup(capture)
    described = capture.data_vars if setup is None else setup.links
    fitted = {str(n) for n in (described if variables is None else variables)} & set(capture)
    mirrored = is_mirrored(capture)
    surfaces = [
        *(["mirror"] if mirrored else []),
        *(["rough surface"] if "intensity" in fitted or not mirrored else []),
        *([] if has_beam(capture) else ["sky"]),
    ]
    surfaces += [OTHER_SLOPES[name] for name in surfaces if name in OTHER_SLOPES]
    mixing = setup.scene.mixing if setup else None
    return SceneLibrary(
        surfaces={name: SURFACES[name] for name in surfaces},
        bodies=_bodies(setup, bool({"intensity", "dop"} & fitted)),
        mixing=StokesMixing() if mixing is None else mixing,
        others={
            "instrument": {"systematic errors": _systematic_errors(setup)},
            **({"normal": {"leaning normal": TiltedNormal()}} if "u" in fitted else {}),
        },
    )


def named_setup(capture: xr.Dataset) -> Setup | None:
    """Return the set-up that a capture names, if its links suit the capture."""
    setup = SETUPS.get(str(capture.attrs.get("setup")))
    if setup is None:
        return None
    suited = [
        name
        for name, link in setup.links.items()
        if name in ("dop", "q", "u")
        and name in capture
        and (not link.reads_errors or f"{name}_error" in capture)
    ]
    return setup if suited else None


def default_links(capture: xr.Dataset) -> Mapping[str, AbstractLink] | None:
    """Return links for a capture that names no suitable set-up; None if it names one."""
    if named_setup(capture) is not None:
        return None
    links: dict[str, AbstractLink] = {
        name: StokesLink(degrees_of_freedom=4.0, stated_errors=f"{name}_error" in capture)
        for name in ("q", "u")
        if name in capture
    }
    if not links and "dop" in capture:
        links = {"dop": BetaLink()}
    if links and "intensity" in capture:
        links["intensity"] = StudentTLink()
    return links or None


def has_beam(capture: xr.Dataset) -> bool:
    """Return whether a capture states that its light is a beam, as a goniometer's is."""
    return capture.attrs.get("setup") == "goniometer" or "incident_levels" in capture.attrs


def _bodies(setup: Setup | None, shows_absorption: bool) -> Mapping[str, Any]:
    """Return bodies, the set-up's first; `Depolarizer` only if its absorption may show."""
    first = setup.scene.subsurface if setup else Lambertian()
    order = sorted(BODIES, key=lambda name: BODIES[name] != first)
    return {
        name: BODIES[name]
        for name in order
        if name != "depolarizing body" or shows_absorption or BODIES[name] == first
    }


def _systematic_errors(setup: Setup | None) -> Instrument:
    """Return terms of the set-up, unknown angle zero and gains, and a discrepancy."""
    # The discrepancy vanishes at normal incidence: what is the same at all angles is a gain.
    given = setup.scene.terms if setup else ()
    kinds = (AngleZero, ChannelGain, Discrepancy)
    others = (term for term in given if not isinstance(term, kinds))
    return Instrument((AngleZero(), ChannelGain(), *others, Discrepancy()))
