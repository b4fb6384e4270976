"""Spectra as Gaussian processes over wavelength (the paper's section 2).

The refractive index, the logarithm of the absorption, or both are smooth functions of wavelength:
a level, and a departure from it whose size (amplitude) and smoothness (length) are inferred with
it. Neighboring wavelengths share information, and wavelengths that were not measured have a
posterior too (`polar_bayes.inference.predict_spectrum`).
"""

import dataclasses

import jax.numpy as jnp
import numpyro
from jaxtyping import Array, Float
from numpyro import distributions as dist

from polar_bayes.models.hierarchical import check_members, check_pooled, draw_pooled
from polar_bayes.models.sites import (
    Links,
    Priors,
    constant_axes,
    declare_readings,
    draw,
    draw_independent,
    material_parameters,
    over_axes,
)
from polar_bayes.models.spectral_process import (
    SPECTRA,
    SpectralProcess,
    check_capture,
    check_processes,
    check_spectra,
    spectrum_around,
    wavelengths_of,
    weight_scale,
)
from polar_bayes.observation.data import Observations
from polar_bayes.physics.scene import Scene
from polar_bayes.priors import support_bounds
from polar_bayes.repr_html import HTMLRepr

PER_PATCH = ("wavelength", "view")


@dataclasses.dataclass(frozen=True)
class GpSpectral(HTMLRepr):
    """Spectra of one material, or of many patches, as Gaussian processes over wavelength.

    Args:
        coupled: Which of refractive_index and absorption are processes; the other, if the scene
            reads it, is free at every wavelength.
        process: The process of all of them, or a tuple with one for each.
        pooled: Parameters whose values (for spectra: levels) patches draw from one population.

    Raises:
        FitError: A name is no spectrum, or processes and names do not pair.
    """

    coupled: tuple[str, ...] = SPECTRA
    process: SpectralProcess | tuple[SpectralProcess, ...] = dataclasses.field(
        default_factory=SpectralProcess
    )
    pooled: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_pooled(self.pooled, where="GpSpectral")
        check_spectra(self.coupled)
        check_processes(self.coupled, self.process)

    def process_of(self, name: str) -> SpectralProcess:
        """Return the process of one spectrum."""
        if isinstance(self.process, tuple):
            return self.process[self.coupled.index(name)]
        return self.process

    def __call__(self, data: Observations, scene: Scene, priors: Priors, links: Links) -> None:
        """Declare the generative model of a capture with a wavelength axis."""
        check_capture(self.coupled, data, scene)
        check_members(self.pooled, data, scene)
        parameters = {}
        for name in material_parameters(scene):
            if name in self.coupled:
                parameters[name] = self._spectrum(name, data, priors)
            elif name in self.pooled:
                parameters[name] = draw_pooled(name, data, priors, without=constant_axes(name))
            else:
                parameters[name] = draw_independent(name, data, priors)

        declare_readings(parameters, data, scene, priors, links)

    def _spectrum(
        self, name: str, data: Observations, priors: Priors
    ) -> Float[Array, "... wavelength"]:
        """Sample one spectrum, separately for each patch."""
        process, wavelength = self.process_of(name), wavelengths_of(data)

        # Amplitude and length of the variation over wavelength: one each for the capture.
        amplitude = numpyro.sample(f"{name}_amplitude", priors[f"{name}_amplitude"])
        length = None
        if process.fits_length:
            length = numpyro.sample(f"{name}_length", priors[f"{name}_length"])

        # The level of this body, and the departure from it.
        knot_wavelengths = process.knot_wavelengths(wavelength)
        widening = weight_scale(name, amplitude * process.scales(length, knot_wavelengths))
        if name in self.pooled:
            level = draw_pooled(f"{name}_level", data, priors, without=PER_PATCH)
        with over_axes(data, without=PER_PATCH):
            if name not in self.pooled:
                level = draw(f"{name}_level", priors[f"{name}_level"], data)
            weights = numpyro.sample(
                f"{name}_weights", dist.Normal(0.0, widening).to_event(1), infer={"auxiliary": True}
            )
        patches = [size for axis, size in data.dims if axis not in PER_PATCH]
        standard = (weights / widening).reshape(*patches, -1)
        departure = process.values(standard, length, knot_wavelengths, wavelength)
        departure = departure - jnp.mean(departure, axis=-1, keepdims=True)
        prior = f"{name}_level_location" if name in self.pooled else f"{name}_level"
        spectrum = spectrum_around(name, level, amplitude, departure, support_bounds(priors[prior]))
        with over_axes(data, without=("view",)):
            return numpyro.deterministic(name, spectrum)


gp_spectral = GpSpectral()
