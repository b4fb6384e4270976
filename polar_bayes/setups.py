"""Named set-ups: what a user would say about a measurement, as scene, links and limits.

`scene="goniometer"` in a fit picks one of these; every part of it can still be replaced.
"""

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType

from polar_bayes.errors import SceneError
from polar_bayes.observation.links import AbstractLink, BetaLink, StokesLink, StudentTLink
from polar_bayes.physics.scene import SCENES, Scene
from polar_bayes.repr_html import HTMLRepr


@dataclasses.dataclass(frozen=True)
class Setup(HTMLRepr):
    """One way to measure.

    Args:
        scene: The optics.
        links: For each variable that such a capture may hold, how it scatters.
        largest_view_zenith: Views beyond it are set aside and counted. Unit degree.
    """

    scene: Scene
    links: Mapping[str, AbstractLink]
    largest_view_zenith: float = 90.0


SETUPS: Mapping[str, Setup] = MappingProxyType(
    {
        "paper": Setup(SCENES["paper"], {"dop": BetaLink(), "intensity": StudentTLink()}),
        "camera": Setup(
            SCENES["camera"],
            {"q": StokesLink(), "u": StokesLink(), "intensity": StudentTLink()},
        ),
        # How much light fell on a place of a picture is known of no pixel by itself, so brightness
        # would tell nothing; its noise is known in every pixel.
        "picture": Setup(
            SCENES["picture"],
            {"q": StokesLink(stated_errors=True), "u": StokesLink(stated_errors=True)},
        ),
        # A laser beam grows longer than the sample towards grazing, each channel losing its own
        # share: beyond 78 degrees a plate's readings say more about its size than its index.
        "goniometer": Setup(
            SCENES["goniometer"],
            {"q": StokesLink(degrees_of_freedom=4.0, stated_errors=True)},
            largest_view_zenith=78.0,
        ),
    }
)


def find_setup(name: str) -> Setup:
    """The set-up of that name."""
    if not isinstance(name, str) or name not in SETUPS:
        raise SceneError(
            "no such scene",
            where=f"scene={name!r}",
            hint=f"give one of {', '.join(SETUPS)}, or a polar_bayes.Scene",
        )
    return SETUPS[name]
