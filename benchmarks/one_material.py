"""The layout that calibrations are measured on: one material, one color, 40 views.

The degree of polarization and intensity by the paper's scene with four facets on the way out: four
parameters of the material, three of the noise.
"""

import dataclasses

import xarray as xr

import polar_bayes as pb

FACETS = pb.physics.FacetQuadrature(along=2, across=2)
SCENE = dataclasses.replace(
    pb.setups.SETUPS["paper"].scene,
    surface=pb.RoughSurface(pb.Beckmann(), pb.PointSource(), FACETS),
)


def layout() -> xr.Dataset:
    return pb.simulate("leaf", seed=1, protocol=pb.simulation.Protocol(views=40, wavelengths=()))
