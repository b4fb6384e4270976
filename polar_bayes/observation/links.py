"""Likelihood links: how a recorded value scatters around the predicted one.

A link answers one question, `distribution`: given the prediction and what is known about each
view, where may the reading fall? The simulator draws from the same object that the fit
evaluates. Where a capture states how far its normals can be trusted (`normal_confidence`), the
links here lower their precision by that. A link of your own is one frozen dataclass with that
method (`polar_bayes.observation.noise.trusted_scale` lowers its precision too); the noise
parameters that it names in `parameters` get their priors from `polar_bayes.priors` or from the
caller.
"""

import abc
import dataclasses
from collections.abc import Mapping
from typing import ClassVar, override

import jax.numpy as jnp
from jaxtyping import Array, Float
from numpyro import distributions as dist

from polar_bayes.cards import Carded
from polar_bayes.errors import FitError
from polar_bayes.observation.data import Observations
from polar_bayes.observation.distributions import MeanConcentrationBeta, SensorStudentT
from polar_bayes.observation.noise import (
    ConcentrationSchedule,
    ScaleSchedule,
    trusted_precision,
    trusted_scale,
)
from polar_bayes.physics.geometry import cos_degrees

Prediction = Mapping[str, Float[Array, "... view"]]
Noise = Mapping[str, Float[Array, ""]]


@dataclasses.dataclass(frozen=True)
class AbstractLink(Carded, abc.ABC):
    """How one recorded variable scatters around its prediction."""

    observables: ClassVar[tuple[str, ...]]
    """The capture's variables that this link can describe."""
    parameters: ClassVar[tuple[str, ...]] = ()
    """The noise parameters that it reads, each sampled from its prior."""

    @property
    def reads_errors(self) -> bool:
        """True where it needs the standard errors that a capture states of its readings."""
        return False

    @abc.abstractmethod
    def distribution(
        self, name: str, prediction: Prediction, data: Observations, noise: Noise
    ) -> dist.Distribution:
        """The distribution of the reading `name`.

        Args:
            name: The capture's variable, one of `observables`.
            prediction: What the instrument would record without noise, each (..., view).
            data: Geometry, brightness and errors of the views; never the reading `name` itself.
            noise: The noise parameters, one for the whole capture.

        Returns:
            A NumPyro distribution of batch shape (..., view).
        """

    def center(self, name: str, prediction: Prediction, noise: Noise) -> Float[Array, "... view"]:
        """The reading without noise, in the unit of the reading."""
        return prediction[name]

    def reading(self, value: Float[Array, "... view"]) -> Float[Array, "... view"]:
        """The reading as the distribution takes it; unchanged unless a link says otherwise."""
        return value


@dataclasses.dataclass(frozen=True)
class _DopLink(AbstractLink):
    """Shared by the links of the unsigned degree of polarization: the margin at 0 and 1."""

    observables: ClassVar[tuple[str, ...]] = ("dop",)
    margin: float = 1e-4

    def __post_init__(self) -> None:
        if not 1e-6 <= self.margin <= 1e-3:
            raise FitError(
                f"margin is {self.margin}",
                where=type(self).__name__,
                mend="give a number from 1e-6 to 1e-3, the paper's range of epsilon",
            )

    @override
    def reading(self, value: Float[Array, "... view"]) -> Float[Array, "... view"]:
        # Readings of exactly 0 or 1 have density 0 or infinity; fits count how many there are.
        return jnp.clip(value, self.margin, 1.0 - self.margin)

    def _mean(self, prediction: Prediction) -> Float[Array, "... view"]:
        return jnp.clip(prediction["dop"], self.margin, 1.0 - self.margin)


@dataclasses.dataclass(frozen=True)
class BetaLink(_DopLink):
    r"""Beta noise of the degree of polarization, the paper's default.

    $$ \rho \sim Beta(\mu\kappa, (1-\mu)\kappa), \quad
       \mu = clip(\rho_{model}, \epsilon, 1-\epsilon) $$

    Args:
        margin: $\epsilon$, unit 1, range [1e-6, 1e-3].
        schedule: How $\kappa$ depends on brightness and angle.

    Source:
        The paper, section 2.
    """

    parameters: ClassVar[tuple[str, ...]] = ("concentration_scale",)
    schedule: ConcentrationSchedule = dataclasses.field(default_factory=ConcentrationSchedule)

    @override
    def distribution(
        self, name: str, prediction: Prediction, data: Observations, noise: Noise
    ) -> dist.Distribution:
        concentration = self.schedule.concentration(
            trusted_precision(noise["concentration_scale"], data.confidence),
            data.brightness,
            cos_degrees(data.geometry.view_zenith),
        )
        return MeanConcentrationBeta(self._mean(prediction), concentration)


@dataclasses.dataclass(frozen=True)
class LogitNormalLink(_DopLink):
    r"""Normal noise of the log odds of the degree of polarization.

    $$ logit(\rho) \sim Normal(logit(\mu), \sigma_\rho) $$

    Args:
        margin: $\epsilon$, unit 1, range [1e-6, 1e-3].

    Source:
        The paper, section 2.
    """

    parameters: ClassVar[tuple[str, ...]] = ("logit_scale",)

    @override
    def distribution(
        self, name: str, prediction: Prediction, data: Observations, noise: Noise
    ) -> dist.Distribution:
        mean = self._mean(prediction)
        log_odds = jnp.log(mean) - jnp.log1p(-mean)
        scale = trusted_scale(noise["logit_scale"], data.confidence)
        return dist.TransformedDistribution(
            dist.Normal(log_odds, scale), dist.transforms.SigmoidTransform()
        )


@dataclasses.dataclass(frozen=True)
class NormalLink(AbstractLink):
    """Normal noise of one constant scale: the ablation that ignores bounds and brightness."""

    observables: ClassVar[tuple[str, ...]] = ("dop", "q", "u")
    parameters: ClassVar[tuple[str, ...]] = ("normal_scale",)

    @override
    def distribution(
        self, name: str, prediction: Prediction, data: Observations, noise: Noise
    ) -> dist.Distribution:
        scale = trusted_scale(noise["normal_scale"], data.confidence)
        return dist.Normal(prediction[name], scale)


@dataclasses.dataclass(frozen=True)
class StokesLink(AbstractLink):
    r"""Noise of the signed normalized Stokes parameters, free of the bias of an unsigned DoP.

    Where the capture states an error for each reading, the scale is `stokes_error_factor`
    times that error. Elsewhere it is the shot noise of a view, $\sigma_q = \sigma_1 /
    \sqrt{I/I_{\max}}$ with $\sigma_1$ = `stokes_scale`.

    Args:
        degrees_of_freedom: Of Student's t, which forgives single bad readings; None for
            normal noise. Range > 2.
        stated_errors: True where the capture states the error of every reading.
        least_brightness: Smallest $I/I_{\max}$ that counts in the shot noise. Range (0, 1].
    """

    observables: ClassVar[tuple[str, ...]] = ("q", "u")
    degrees_of_freedom: float | None = None
    stated_errors: bool = False
    least_brightness: float = 1e-3

    def __post_init__(self) -> None:
        if self.degrees_of_freedom is not None and not self.degrees_of_freedom > 2.0:
            raise FitError(
                f"degrees_of_freedom is {self.degrees_of_freedom}",
                where="StokesLink",
                mend="give a number above 2, or None for normal noise",
            )
        if not 0.0 < self.least_brightness <= 1.0:
            raise FitError(
                f"least_brightness is {self.least_brightness}",
                where="StokesLink",
                mend="give a number above 0 and up to 1",
            )

    @property
    @override
    def parameters(self) -> tuple[str, ...]:  # type: ignore[override]
        return ("stokes_error_factor",) if self.stated_errors else ("stokes_scale",)

    @property
    @override
    def reads_errors(self) -> bool:
        return self.stated_errors

    @override
    def distribution(
        self, name: str, prediction: Prediction, data: Observations, noise: Noise
    ) -> dist.Distribution:
        if self.stated_errors:
            if name not in data.errors:
                raise FitError(
                    f"the capture states no {name}_error",
                    where="StokesLink(stated_errors=True)",
                    mend="add that variable to the capture or use stated_errors=False",
                )
            scale = noise["stokes_error_factor"] * data.errors[name]
        else:
            brightness = jnp.maximum(data.brightness, self.least_brightness)
            scale = noise["stokes_scale"] / jnp.sqrt(brightness)
        scale = trusted_scale(scale, data.confidence)
        if self.degrees_of_freedom is None:
            return dist.Normal(prediction[name], scale)
        # As a bare number it would become double precision whatever the rest of the program is.
        freedom = jnp.asarray(self.degrees_of_freedom, jnp.result_type(scale))
        return dist.StudentT(freedom, prediction[name], scale)


@dataclasses.dataclass(frozen=True)
class StudentTLink(AbstractLink):
    r"""Student's t noise of the intensity, recorded by a sensor with a full scale.

    $$ I/I_{\max} \sim t_\nu(e S_0, \sigma), \quad \sigma = \sigma_0 (1 - e S_0)^{-\delta}
       \cos(\theta_v)^{-\zeta} $$

    The factor $e$ = `exposure` turns the scene's unit irradiance into the sensor's unit.
    Saturated readings count as "at least full scale".

    Args:
        degrees_of_freedom: $\nu$, unit 1, range [3, 7].
        schedule: How $\sigma$ depends on brightness and angle.

    Source:
        The paper, section 2; the stops of the sensor are ours.
    """

    observables: ClassVar[tuple[str, ...]] = ("intensity",)
    parameters: ClassVar[tuple[str, ...]] = ("exposure", "intensity_scale")
    degrees_of_freedom: float = 5.0
    schedule: ScaleSchedule = dataclasses.field(default_factory=ScaleSchedule)

    def __post_init__(self) -> None:
        if not 3.0 <= self.degrees_of_freedom <= 7.0:
            raise FitError(
                f"degrees_of_freedom is {self.degrees_of_freedom}",
                where="StudentTLink",
                mend="give a number from 3 to 7, the paper's range of nu",
            )

    @override
    def center(self, name: str, prediction: Prediction, noise: Noise) -> Float[Array, "... view"]:
        return noise["exposure"] * prediction[name]

    @override
    def distribution(
        self, name: str, prediction: Prediction, data: Observations, noise: Noise
    ) -> dist.Distribution:
        location = self.center(name, prediction, noise)
        scale = self.schedule.scale(
            noise["intensity_scale"], location, cos_degrees(data.geometry.view_zenith)
        )
        scale = trusted_scale(scale, data.confidence)
        return SensorStudentT(
            self.degrees_of_freedom, location, scale, data.saturated, data.full_scale
        )


def noise_parameters(links: Mapping[str, AbstractLink]) -> tuple[str, ...]:
    """The noise parameters that a set of links reads, each once, in the order of the links."""
    return tuple(dict.fromkeys(name for link in links.values() for name in link.parameters))
