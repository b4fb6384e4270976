"""What is believed before any data: one NumPyro distribution for every named parameter.

The table is written once and read by every model. A caller replaces any row with any NumPyro
distribution of the right support: `priors={"refractive_index": dist.Normal(1.5, 0.02)}` is
refused (an index below 1 is possible under it), `dist.TruncatedNormal(1.5, 0.02, low=1.0)` is
not. Distributions are made of Python numbers, so that importing this file creates no array and
the fit chooses the precision.
"""

import math
from typing import override

from jaxtyping import Array
from numpyro import distributions as dist

from polar_bayes.cards import Card, Grid
from polar_bayes.physics.notation import notation
from polar_bayes.priors.describe import describe_prior
from polar_bayes.priors.half_normal import HalfNormal


class Beta(dist.Beta):
    """The Beta distribution, two Python numbers until it is used."""

    # NumPyro's own turns them into an array at once, in the precision of that moment: a table of
    # priors would start the array library on import and stay in single precision for ever.

    def __init__(
        self,
        concentration1: float,
        concentration0: float,
        *,
        validate_args: bool | None = None,
    ) -> None:
        self.concentration1, self.concentration0 = concentration1, concentration0
        dist.Distribution.__init__(self, validate_args=validate_args)

    @override
    def sample(self, key: Array, sample_shape: tuple[int, ...] = ()) -> Array:
        return dist.Beta(self.concentration1, self.concentration0).sample(key, sample_shape)

    @override
    def log_prob(self, value: Array) -> Array:
        return dist.Beta(self.concentration1, self.concentration0).log_prob(value)


class Priors(dict[str, dist.Distribution]):
    """A dictionary of priors that a notebook shows with their numbers."""

    def _repr_html_(self) -> str:
        rows = tuple((n, notation(n).meaning, describe_prior(x)) for n, x in self.items())
        return Card("Priors", (), (Grid(("parameter", "meaning", "prior"), rows),))._repr_html_()


_ROWS: dict[str, dist.Distribution] = {
    # The material: the paper, section 2.
    "roughness": dist.HalfNormal(0.2),
    "subsurface_fraction": Beta(2.0, 2.0),
    "absorption": dist.LogNormal(-1.0, 0.5),
    "refractive_index": dist.TruncatedNormal(1.45, 0.15, low=1.2, high=2.0),
    # The material, in scenes with more parts: a second roughness, a body's own color, a law of
    # dispersion (for lengths in micrometers), a coat, a film (nm).
    "roughness_across": dist.HalfNormal(0.2),
    "roughness_azimuth": dist.Normal(0.0, 45.0),
    "albedo": Beta(2.0, 2.0),
    "polarized_fraction": Beta(2.0, 2.0),
    "cauchy_a": dist.TruncatedNormal(1.44, 0.15, low=1.2, high=2.0),
    "cauchy_b": dist.LogNormal(math.log(0.005), 0.5),
    "sellmeier_strength": dist.TruncatedNormal(1.05, 0.4, low=0.4, high=3.0),
    "sellmeier_resonance": dist.TruncatedNormal(0.011, 0.004, low=0.0, high=0.03),
    "coat_refractive_index": dist.TruncatedNormal(1.5, 0.05, low=1.2, high=2.0),
    "coat_absorbance": dist.HalfNormal(0.2),
    "film_refractive_index": dist.TruncatedNormal(1.45, 0.1, low=1.2, high=2.0),
    "film_thickness": dist.LogNormal(math.log(200.0), 0.7),
    # How far the normal leans from the stated one: that of a sample laid down by eye.
    "normal_tilt_x": dist.Normal(0.0, 2.0),
    "normal_tilt_y": dist.Normal(0.0, 2.0),
    # Populations of materials or patches (models/hierarchical.py): the paper, section 2, for the
    # index; for the others the location is believed as one material is, and two members may well
    # differ by half a unit of log or log odds.
    "roughness_location": dist.HalfNormal(0.2),
    "roughness_spread": dist.HalfNormal(0.5),
    "subsurface_fraction_location": Beta(2.0, 2.0),
    "subsurface_fraction_spread": dist.HalfNormal(0.5),
    "absorption_location": dist.LogNormal(-1.0, 0.5),
    "absorption_spread": dist.HalfNormal(0.5),
    "refractive_index_location": dist.TruncatedNormal(1.45, 0.2, low=1.2, high=2.0),
    "refractive_index_spread": dist.HalfNormal(0.1),
    # Spectra (models/gp_spectral.py). The level is believed as one color is. Of 58 measured
    # dielectrics, n(450 nm) - n(650 nm) is .011 in the median, and .006 to .029 for nine in ten;
    # amplitudes of .02 to .03 and lengths of 300 to 400 nm explain them best. The presets' log a
    # varies by 0 to 1 over the visible, in bands of pigments some tens of nm wide.
    "refractive_index_level": dist.TruncatedNormal(1.45, 0.15, low=1.2, high=2.0),
    "refractive_index_level_location": dist.TruncatedNormal(1.45, 0.2, low=1.2, high=2.0),
    "refractive_index_level_spread": dist.HalfNormal(0.1),
    "refractive_index_amplitude": dist.LogNormal(math.log(0.02), 0.7),
    "refractive_index_length": dist.LogNormal(math.log(300.0), 0.5),
    "absorption_level": dist.LogNormal(-1.0, 0.5),
    "absorption_level_location": dist.LogNormal(-1.0, 0.5),
    "absorption_level_spread": dist.HalfNormal(0.5),
    "absorption_amplitude": dist.LogNormal(math.log(0.5), 0.5),
    "absorption_length": dist.LogNormal(math.log(60.0), 0.5),
    # The instrument: what a careful set-up leaves unknown.
    "dolp_gain": Beta(10.0, 1.5),
    "channel_gain_ratio": dist.LogNormal(0.0, 0.1),
    "leakage": HalfNormal(0.01),
    "dark_level": dist.Normal(0.0, 0.001),
    "angle_zero": dist.Normal(0.0, 0.75),
    "beam_overlap_zenith": dist.TruncatedNormal(80.0, 5.0, low=45.0, high=89.0),
    # No set-up is free of smooth errors of some percent: a prior that allows none would let a
    # few lucky readings claim an accuracy that no goniometer has.
    "discrepancy_amplitude": dist.LogNormal(math.log(0.08), 0.5),
    "discrepancy_weights": dist.Normal(0.0, 1.0).expand([4]).to_event(1),
    # The noise: scales that the data themselves determine. None may reach zero: where the scene
    # can match a few readings exactly, a scale of zero would have infinite posterior density.
    "concentration_scale": dist.LogNormal(math.log(200.0), 1.0),
    "logit_scale": dist.LogNormal(math.log(0.15), 1.0),
    "normal_scale": dist.LogNormal(math.log(0.03), 1.0),
    "stokes_scale": dist.LogNormal(math.log(0.01), 1.0),
    "stokes_error_factor": dist.LogNormal(math.log(1.5), 0.7),
    "exposure": dist.LogNormal(0.0, 3.0),
    "intensity_scale": dist.LogNormal(math.log(0.02), 1.0),
}

PRIORS = Priors(_ROWS)
"""What is believed before any data, by the name of the parameter."""

RANGES: dict[str, tuple[float, float]] = {
    "roughness": (0.0, math.inf),
    "subsurface_fraction": (0.0, 1.0),
    "absorption": (0.0, math.inf),
    "refractive_index": (1.0, math.inf),
    "roughness_across": (0.0, math.inf),
    "albedo": (0.0, 1.0),
    "polarized_fraction": (0.0, 1.0),
    "cauchy_a": (1.0, math.inf),
    "cauchy_b": (0.0, math.inf),
    "sellmeier_strength": (0.0, math.inf),
    "sellmeier_resonance": (0.0, 0.1),
    "coat_refractive_index": (1.0, math.inf),
    "coat_absorbance": (0.0, math.inf),
    "film_refractive_index": (1.0, math.inf),
    "film_thickness": (0.0, math.inf),
    "roughness_location": (0.0, math.inf),
    "roughness_spread": (0.0, math.inf),
    "subsurface_fraction_location": (0.0, 1.0),
    "subsurface_fraction_spread": (0.0, math.inf),
    "absorption_location": (0.0, math.inf),
    "absorption_spread": (0.0, math.inf),
    "refractive_index_location": (1.0, math.inf),
    "refractive_index_spread": (0.0, math.inf),
    "refractive_index_level": (1.0, math.inf),
    "refractive_index_level_location": (1.0, math.inf),
    "refractive_index_level_spread": (0.0, math.inf),
    "refractive_index_amplitude": (0.0, math.inf),
    "refractive_index_length": (0.0, math.inf),
    "absorption_level": (0.0, math.inf),
    "absorption_level_location": (0.0, math.inf),
    "absorption_level_spread": (0.0, math.inf),
    "absorption_amplitude": (0.0, math.inf),
    "absorption_length": (0.0, math.inf),
    "dolp_gain": (0.0, 1.0),
    "beam_overlap_zenith": (0.0, 90.0),
    "channel_gain_ratio": (0.0, math.inf),
    "leakage": (0.0, math.inf),
    "discrepancy_amplitude": (0.0, math.inf),
    "concentration_scale": (0.0, math.inf),
    "logit_scale": (0.0, math.inf),
    "normal_scale": (0.0, math.inf),
    "stokes_scale": (0.0, math.inf),
    "stokes_error_factor": (0.0, math.inf),
    "exposure": (0.0, math.inf),
    "intensity_scale": (0.0, math.inf),
}
"""Physical range of a parameter; one that is not listed may take any real value."""
