"""Six captures from easy to hard, on which methods are measured but not tuned.

The first two are smooth plates, three parameters; the others have a rough surface over a body,
seven. The last two are hard: the degree of polarization alone says next to nothing of absorption,
and near Brewster's angle an index below explains it as well as one above.
"""

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import xarray as xr
from one_material import SCENE

import polar_bayes as pb
from polar_bayes.simulation import MirrorScan

PLATE = pb.Scene(pb.SmoothSurface(), pb.Unpolarized(), pb.StokesMixing())
SIGNED = {"q": pb.links.StokesLink(stated_errors=True)}


@dataclasses.dataclass(frozen=True)
class Case:
    """One capture.

    Args:
        preset: Material.
        scene: Optics that simulate and that are fitted.
        protocol: Where to look from.
        links: How readings scatter; None for those of the paper.
        keep: Variables that were read; all where empty.
        truth: Values that replace the preset's.
    """

    preset: str
    scene: pb.Scene
    protocol: pb.simulation.Protocol
    links: Mapping[str, Any] | None = None
    keep: tuple[str, ...] = ()
    truth: Mapping[str, float] = MappingProxyType({})

    def capture(self, seed: int) -> xr.Dataset:
        """Readings of known truth."""
        drawn = pb.simulate(
            self.preset,
            scene=self.scene,
            links=self.links,
            protocol=self.protocol,
            parameters=dict(self.truth),
            seed=seed,
        )
        every = ("dop", "q", "u", "intensity")
        return drawn.drop_vars(
            [n for n in every if n in drawn and self.keep and n not in self.keep]
        )


ONE_COLOR: dict[str, Any] = {"wavelengths": ()}

CASES: Mapping[str, Case] = MappingProxyType(
    {
        "smooth glass, 40 views": Case(
            "glass", PLATE, MirrorScan(views=40, largest_view_zenith=78.0, **ONE_COLOR), SIGNED
        ),
        "smooth glass, 6 views": Case(
            "glass", PLATE, MirrorScan(views=6, largest_view_zenith=78.0, **ONE_COLOR), SIGNED
        ),
        "leaf, 40 views": Case("leaf", SCENE, pb.simulation.Protocol(views=40, **ONE_COLOR)),
        "glossy, fraction near 0": Case(
            "plastic",
            SCENE,
            pb.simulation.Protocol(views=24, **ONE_COLOR),
            truth=MappingProxyType({"subsurface_fraction": 0.01}),
        ),
        "few grazing views, DoP alone": Case(
            "fruit",
            SCENE,
            MirrorScan(views=8, smallest_view_zenith=70.0, largest_view_zenith=86.0, **ONE_COLOR),
            keep=("dop",),
        ),
        "two views at Brewster's angle": Case(
            "glass",
            PLATE,
            MirrorScan(views=2, smallest_view_zenith=55.0, largest_view_zenith=57.0, **ONE_COLOR),
            SIGNED,
            truth=MappingProxyType({"subsurface_fraction": 0.05, "refractive_index": 1.40}),
        ),
    }
)
"""Captures from easy to hard, by name."""
