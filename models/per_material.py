"""One material at a time: section 2 of the paper.

A material is its roughness, subsurface fraction, absorption and refractive index. The last two
change with color, so a capture with a wavelength axis has one of each per wavelength. The scene
turns them into what the instrument would record (eq. 1), the links say how readings scatter.
"""

from polar_bayes.models.sites import (
    Links,
    Priors,
    declare_readings,
    draw_independent,
    material_parameters,
)
from polar_bayes.observation.data import Observations
from polar_bayes.physics.scene import Scene


def per_material(data: Observations, scene: Scene, priors: Priors, links: Links) -> None:
    """Declare the generative model of one capture."""
    parameters = {name: draw_independent(name, data, priors) for name in material_parameters(scene)}

    declare_readings(parameters, data, scene, priors, links)
