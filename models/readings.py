"""The second half of every model: from the parameters of a material to the readings."""

from collections.abc import Mapping

import numpyro
from jaxtyping import Array
from numpyro import distributions as dist
from polar_bayes.models.axes import over_axes

from polar_bayes.observation.data import Observations
from polar_bayes.observation.links import AbstractLink, noise_parameters
from polar_bayes.physics.scene import Scene


def declare_readings(
    parameters: Mapping[str, Array],
    data: Observations,
    scene: Scene,
    priors: Mapping[str, dist.Distribution],
    links: Mapping[str, AbstractLink],
) -> None:
    """Declare the instrument, the noise, and how the readings scatter around eq. 1.

    Args:
        parameters: The material's parameters by name, each (...[, wavelength]).
        data: The capture as arrays.
        scene: The optics; what it reads beyond `parameters` is sampled here.
        priors: A distribution for every parameter.
        links: For each recorded variable, how it scatters.
    """
    # The instrument and the noise: one value for the whole capture, shared by all its patches.
    instrument = {
        name: numpyro.sample(name, priors[name])
        for name in scene.parameters
        if name not in parameters
    }
    noise = {name: numpyro.sample(name, priors[name]) for name in noise_parameters(links)}

    parameters = {**parameters, **instrument}
    if scene.dispersion is not None and data.geometry.wavelength is not None:
        # The law's coefficients are what is sampled; the index is what is asked for.
        wavelength = data.geometry.wavelength[..., 0]
        with over_axes(data, without=("view",)):
            index = scene.dispersion.index(parameters, wavelength)
            numpyro.deterministic("refractive_index", index[..., None])

    # What would be recorded without noise (eq. 1), and how the readings scatter around it.
    prediction = scene.predict(parameters, data.geometry)
    with over_axes(data):
        for name, link in links.items():
            numpyro.deterministic(f"{name}_mean", link.center(name, prediction, noise))
            likelihood = link.distribution(name, prediction, data, noise).mask(data.valid)
            numpyro.sample(name, likelihood, obs=link.reading(data.readings[name]))
