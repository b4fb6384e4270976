"""Likelihood links: the distribution of a reading around its prediction.

A link has one method, `distribution`. The simulator draws from the distribution that the fit
evaluates. Where a capture states the confidence in its normals (`normal_confidence`), the links
multiply their precision by it. A user-defined link is a frozen dataclass with that method
(`polar_bayes.observation.links.scale_by_confidence` lowers its precision too); the noise parameters
in its `parameters` get their priors from `polar_bayes.priors` or from the caller.

Both schedules are bounded, because the printed formulas are not: a pixel at full scale would get
an infinite scale, and a view along the surface no concentration. The bounds are fields, which users
can change.
"""

import abc
import dataclasses
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar, override

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpyro import distributions as dist

from polar_bayes.errors import FitError
from polar_bayes.observation.data import Observations
from polar_bayes.observation.distributions import (
    MeanConcentrationBeta,
    SensorStudentT,
    StudentT,
)
from polar_bayes.physics.geometry import cos_degrees
from polar_bayes.repr_html import HTMLRepr

__all__ = [
    "BetaLink",
    "ConcentrationSchedule",
    "LogitNormalLink",
    "NormalLink",
    "ScaleSchedule",
    "StokesLink",
    "StudentTLink",
]

PerView = Float[Array, "... view"]
AnyPerView = PerView | Float[np.ndarray, "... view"]

# --- Noise against brightness and view angle (the paper's section 2) ------------------------------


SMOOTHING = 0.5
"""Width of the smooth bend at the least headroom, in units of the least headroom."""


@dataclasses.dataclass(frozen=True)
class ConcentrationSchedule(HTMLRepr):
    r"""Concentration of the degree of polarization, higher for bright, upright views.

    $$ \kappa = \kappa_{\min} + \kappa_{scale} (I/I_{\max})^\eta \cos(\theta_v)^\gamma $$

    Args:
        minimum: $\kappa_{\min}$, unit 1, range > 0.
        brightness_exponent: $\eta$, unit 1, range [0, 1]; the paper uses [0.5, 1].
        angle_exponent: $\gamma$, unit 1, range [0, 2].

    Raises:
        FitError: A field is outside its range.

    Source:
        The paper, section 2 (noise of the degree of polarization).
    """

    minimum: float = 5.0
    brightness_exponent: float = 0.75
    angle_exponent: float = 1.0

    def __post_init__(self) -> None:
        _check_range(self, "minimum", 1e-6, 1e12)
        _check_range(self, "brightness_exponent", 0.0, 1.0)
        _check_range(self, "angle_exponent", 0.0, 2.0)

    def concentration(self, scale: Array, brightness: PerView, cos_view: PerView) -> PerView:
        """Return each view's concentration, at least `minimum`, from recorded brightness."""
        gain = brightness**self.brightness_exponent * cos_view**self.angle_exponent
        return self.minimum + scale * gain


@dataclasses.dataclass(frozen=True)
class ScaleSchedule(HTMLRepr):
    r"""Scale of the intensity noise, which grows towards full scale and towards grazing.

    $$ \sigma = \sigma_0 (1 - I/I_{\max})^{-\delta} \cos(\theta_v)^{-\zeta} $$

    Args:
        headroom_exponent: $\delta$, unit 1, range [0, 1].
        angle_exponent: $\zeta$, unit 1, range [0, 1].
        least_headroom: Smallest $1 - I/I_{\max}$ that counts, approached smoothly; the factor
            stays below `least_headroom ** -headroom_exponent`. Unit 1, range (0, 1].
        least_cosine: Smallest cosine that counts (0.02 is 88.9 degrees). Unit 1, range (0, 1].

    Raises:
        FitError: A field is outside its range.

    Source:
        The paper, section 2 (noise of the intensity).
    """

    headroom_exponent: float = 0.5
    angle_exponent: float = 0.5
    least_headroom: float = 0.05
    least_cosine: float = 0.02

    def __post_init__(self) -> None:
        _check_range(self, "headroom_exponent", 0.0, 1.0)
        _check_range(self, "angle_exponent", 0.0, 1.0)
        _check_range(self, "least_headroom", 1e-6, 1.0)
        _check_range(self, "least_cosine", 1e-6, 1.0)

    def scale(self, base: Array, brightness: PerView, cos_view: PerView) -> PerView:
        """Return each view's scale, at least `base`, from predicted brightness."""
        # A smooth bound: a corner here would put a corner, not a peak, on top of the posterior
        # whenever a view is predicted close to full scale.
        width = SMOOTHING * self.least_headroom
        spare = (1.0 - brightness - self.least_headroom) / width
        headroom = self.least_headroom + width * jax.nn.softplus(spare)
        cosine = jnp.maximum(cos_view, self.least_cosine)
        # Not `headroom ** -exponent`: powers are computed one by one, exp and log are vectorized.
        growth = jnp.exp(-self.headroom_exponent * jnp.log(headroom))
        return base * growth * cosine**-self.angle_exponent


def precision_by_confidence(precision: Array, confidence: PerView | None) -> Array:
    """Multiply a precision by the confidence in the stated normal."""
    return precision if confidence is None else precision * confidence


def scale_by_confidence(scale: Array, confidence: PerView | None) -> Array:
    """Divide a noise scale by the square root of the confidence in the stated normal."""
    return scale if confidence is None else scale / jnp.sqrt(confidence)


def stated_errors(link: object, name: str, data: Observations) -> PerView:
    """Return the errors that a capture states for a variable; refuse a capture without them."""
    if name not in data.errors:
        what = f"the capture states no {name}_error"
        hint = "add that variable to the capture or use stated_errors=False"
        raise FitError(what, where=f"{type(link).__name__}(stated_errors=True)", hint=hint)
    return data.errors[name]


def _check_range(owner: object, field: str, low: float, high: float, note: str = "") -> None:
    value = getattr(owner, field)
    if not low <= value <= high:
        hint = f"give a number from {low:g} to {high:g}{note}"
        raise FitError(f"{field} is {value}", where=type(owner).__name__, hint=hint)


# --- Links ----------------------------------------------------------------------------------------


Prediction = Mapping[str, PerView]
Noise = Mapping[str, Float[Array, ""]]


@dataclasses.dataclass(frozen=True)
class AbstractLink(HTMLRepr, abc.ABC):
    """Distribution of one recorded variable around its prediction."""

    observables: ClassVar[tuple[str, ...]]
    """The capture's variables that this link can describe."""
    parameters: ClassVar[tuple[str, ...]] = ()
    """Noise parameters that the link reads, each of which is sampled from its prior."""

    @property
    def reads_errors(self) -> bool:
        """True if the link needs the standard errors that a capture states."""
        return False

    @abc.abstractmethod
    def distribution(
        self, name: str, prediction: Prediction, data: Observations, noise: Noise
    ) -> dist.Distribution:
        """Return the distribution of the reading `name`.

        Args:
            name: The capture's variable, one of `observables`.
            prediction: What the instrument would record without noise, each (..., view).
            data: Geometry, brightness and errors of the views; never the reading `name` itself.
            noise: The noise parameters, one for the whole capture.

        Returns:
            A NumPyro distribution of batch shape (..., view).
        """

    def center(self, name: str, prediction: Prediction, noise: Noise) -> PerView:
        """Return the noise-free reading, in the unit of the reading."""
        return prediction[name]

    def reading(self, value: AnyPerView) -> AnyPerView:
        """Return the reading in the form of the distribution; unchanged by default."""
        return value


@dataclasses.dataclass(frozen=True)
class _DopLink(AbstractLink):
    """Base class of links of the unsigned degree of polarization: the margin at 0 and 1."""

    observables: ClassVar[tuple[str, ...]] = ("dop",)
    margin: float = 1e-4

    def __post_init__(self) -> None:
        if not 1e-6 <= self.margin <= 1e-3:
            hint = "give a number from 1e-6 to 1e-3, the paper's range of epsilon"
            raise FitError(f"margin is {self.margin}", where=type(self).__name__, hint=hint)

    @override
    def reading(self, value: AnyPerView) -> AnyPerView:
        # Readings of exactly 0 or 1 have density 0 or infinity; fits count how many there are.
        return value.clip(self.margin, 1.0 - self.margin)

    def _mean(self, prediction: Prediction) -> PerView:
        return jnp.clip(prediction["dop"], self.margin, 1.0 - self.margin)


@dataclasses.dataclass(frozen=True)
class BetaLink(_DopLink):
    r"""Beta noise of the degree of polarization, the paper's default.

    $$ \rho \sim Beta(\mu\kappa, (1-\mu)\kappa), \quad
       \mu = clip(\rho_{model}, \epsilon, 1-\epsilon) $$

    Readings within the margin are censored at its end.

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
        scale = precision_by_confidence(noise["concentration_scale"], data.confidence)
        cos_view = cos_degrees(data.geometry.view_zenith)
        concentration = self.schedule.concentration(scale, data.brightness, cos_view)
        return MeanConcentrationBeta(self._mean(prediction), concentration, self.margin)


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
        scale = scale_by_confidence(noise["logit_scale"], data.confidence)
        share = dist.transforms.SigmoidTransform()
        return dist.TransformedDistribution(dist.Normal(log_odds, scale), share)


@dataclasses.dataclass(frozen=True)
class NormalLink(AbstractLink):
    """Normal noise of constant scale: an ablation that ignores bounds and brightness."""

    observables: ClassVar[tuple[str, ...]] = ("dop", "q", "u")
    parameters: ClassVar[tuple[str, ...]] = ("normal_scale",)

    @override
    def distribution(
        self, name: str, prediction: Prediction, data: Observations, noise: Noise
    ) -> dist.Distribution:
        scale = scale_by_confidence(noise["normal_scale"], data.confidence)
        return dist.Normal(prediction[name], scale)


@dataclasses.dataclass(frozen=True)
class StokesLink(AbstractLink):
    r"""Noise of signed normalized Stokes parameters, without the bias of an unsigned DoP.

    Where the capture states an error for each reading, the scale is `stokes_error_factor`
    times that error. Elsewhere it is the shot noise of a view,

    $$ s = \frac{\sigma_1}{\sqrt{I/I_{\max}}}, \quad
       q \sim \mathrm{Normal}\Big(\frac{q_0}{\sqrt{1+s^4}}, \frac{s}{\sqrt{1+2s^2}}\Big) $$

    with $\sigma_1$ = `stokes_scale`, and I the predicted intensity where that is fitted, else the
    recorded one. In light this is noise s around the prediction $q_0$. A view without light has
    any polarization, since its reading is a quotient of noise: in the dark the mean tends to zero
    and the variance to that of a point on the unit circle.

    Args:
        degrees_of_freedom: Of Student's t, which forgives single bad readings; None for
            normal noise. Range > 2.
        stated_errors: True where the capture states the error of every reading.
        least_brightness: Smallest $I/I_{\max}$ that counts in the shot noise. Range (0, 1].
    """

    observables: ClassVar[tuple[str, ...]] = ("q", "u")
    degrees_of_freedom: float | None = None
    stated_errors: bool = False
    least_brightness: float = 1e-9

    def __post_init__(self) -> None:
        if self.degrees_of_freedom is not None and not self.degrees_of_freedom > 2.0:
            what = f"degrees_of_freedom is {self.degrees_of_freedom}"
            hint = "give a number above 2, or None for normal noise"
            raise FitError(what, where="StokesLink", hint=hint)
        if not 0.0 < self.least_brightness <= 1.0:
            what = f"least_brightness is {self.least_brightness}"
            raise FitError(what, where="StokesLink", hint="give a number above 0 and up to 1")

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
            errors = stated_errors(self, name, data)
            location, scale = prediction[name], noise["stokes_error_factor"] * errors
        else:
            light = self._brightness(prediction, data, noise)
            square = noise["stokes_scale"] ** 2
            location = prediction[name] * light / jnp.hypot(light, square)
            scale = noise["stokes_scale"] / jnp.sqrt(light + 2.0 * square)
        scale = scale_by_confidence(scale, data.confidence)
        if self.degrees_of_freedom is None:
            return dist.Normal(location, scale)
        # As a bare number it would become double precision whatever the rest of the program is.
        freedom = jnp.asarray(self.degrees_of_freedom, jnp.result_type(scale))
        return StudentT(freedom, location, scale)

    def _brightness(self, prediction: Prediction, data: Observations, noise: Noise) -> PerView:
        """Return the light of each view over full scale, which sets its noise."""
        brightness = data.brightness
        if "exposure" in noise:
            # Not the reading, which is noise where there is no light. At full scale it bends
            # smoothly, since a corner there would put one on top of the posterior.
            predicted = noise["exposure"] * prediction["intensity"]
            larger = jnp.maximum(predicted, 1.0)  # the fourth power of a bright lobe may overflow
            bend = (predicted / larger) ** 4 + (1.0 / larger) ** 4
            brightness = predicted / larger * bend**-0.25
        return jnp.maximum(brightness, self.least_brightness)


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
        stated_errors: True where $\sigma$ is `stokes_error_factor` times the error that the capture
            states of each reading, in place of the schedule.

    Source:
        The paper, section 2; the stops of the sensor are ours.
    """

    observables: ClassVar[tuple[str, ...]] = ("intensity",)
    degrees_of_freedom: float = 5.0
    schedule: ScaleSchedule = dataclasses.field(default_factory=ScaleSchedule)
    stated_errors: bool = False

    def __post_init__(self) -> None:
        _check_range(self, "degrees_of_freedom", 3.0, 7.0, ", the paper's range of nu")

    @property
    @override
    def parameters(self) -> tuple[str, ...]:  # type: ignore[override]
        return ("exposure", "stokes_error_factor" if self.stated_errors else "intensity_scale")

    @property
    @override
    def reads_errors(self) -> bool:
        return self.stated_errors

    @override
    def center(self, name: str, prediction: Prediction, noise: Noise) -> PerView:
        return noise["exposure"] * prediction[name]

    @override
    def distribution(
        self, name: str, prediction: Prediction, data: Observations, noise: Noise
    ) -> dist.Distribution:
        location = self.center(name, prediction, noise)
        cos_view = cos_degrees(data.geometry.view_zenith)
        if self.stated_errors:
            scale = noise["stokes_error_factor"] * stated_errors(self, name, data)
        else:
            scale = self.schedule.scale(noise["intensity_scale"], location, cos_view)
        scale = scale_by_confidence(scale, data.confidence)
        return SensorStudentT(
            self.degrees_of_freedom, location, scale, data.saturated, data.full_scale
        )


def noise_parameters(links: Mapping[str, AbstractLink]) -> tuple[str, ...]:
    """Return the noise parameters of a set of links, each once, in order."""
    return tuple(dict.fromkeys(name for link in links.values() for name in link.parameters))


PERFECT: Mapping[str, float] = MappingProxyType(
    {
        "concentration_scale": math.inf,
        "logit_scale": 0.0,
        "normal_scale": 0.0,
        "stokes_scale": 0.0,
        "stokes_error_factor": 0.0,
        "intensity_scale": 0.0,
    }
)
"""Value of each noise parameter that means noise-free readings."""
