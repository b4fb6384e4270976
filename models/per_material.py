"""One material at a time: section 2 of the paper.

A material is its roughness, subsurface fraction, absorption and refractive index. The last two
change with color, so a capture with a wavelength axis has one of each per wavelength. The scene
turns them into what the instrument would record (eq. 1), the links say how readings scatter.
"""

from collections.abc import Mapping

import numpyro
from numpyro import distributions as dist
from polar_bayes.models.axes import draw, over_axes

from polar_bayes.observation.data import Observations
from polar_bayes.observation.links import AbstractLink, noise_parameters
from polar_bayes.physics.scene import MATERIAL_PARAMETERS, Scene

SPECTRAL = ("absorption", "refractive_index")


def per_material(
    data: Observations,
    scene: Scene,
    priors: Mapping[str, dist.Distribution],
    links: Mapping[str, AbstractLink],
) -> None:
    """Declare the story of one capture.

    Args:
        data: The capture as arrays; a leading axis (material, patch) repeats the material.
        scene: The optics; it says which parameters it reads.
        priors: A distribution for every parameter of the scene and the links.
        links: For each recorded variable, how it scatters.
    """
    # The material: only what the scene reads is sampled.
    parameters = {}
    for name in (name for name in MATERIAL_PARAMETERS if name in scene.parameters):
        shared = ("view",) if name in SPECTRAL else ("view", "wavelength")
        with over_axes(data, without=shared):
            parameters[name] = draw(name, priors[name], data)

    # The instrument and the noise: one value for the whole capture.
    for name in scene.parameters:
        if name not in parameters:
            parameters[name] = numpyro.sample(name, priors[name])
    noise = {name: numpyro.sample(name, priors[name]) for name in noise_parameters(links)}

    # What would be recorded without noise (eq. 1), and how the readings scatter around it.
    prediction = scene.predict(parameters, data.geometry)
    with over_axes(data):
        for name, link in links.items():
            numpyro.deterministic(f"{name}_mean", link.center(name, prediction, noise))
            likelihood = link.distribution(name, prediction, data, noise).mask(data.valid)
            numpyro.sample(name, likelihood, obs=link.reading(data.readings[name]))
