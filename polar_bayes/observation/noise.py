"""How noise depends on brightness and view angle: the schedules of the paper's section 2.

Both schedules are bounded, because the printed formulas are not: a pixel at full scale or a
view along the surface would get infinite scale or no concentration at all. The bounds are
fields, so that a user can see and move them.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from polar_bayes.cards import Carded
from polar_bayes.errors import FitError

SMOOTHING = 0.5
"""Width of the bend at the least headroom, in units of the least headroom."""


@dataclasses.dataclass(frozen=True)
class ConcentrationSchedule(Carded):
    r"""Concentration of the degree of polarization: bright, upright views are sharper.

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

    def concentration(
        self,
        scale: Float[Array, "..."],
        brightness: Float[Array, "... view"],
        cos_view: Float[Array, "... view"],
    ) -> Float[Array, "... view"]:
        """The concentration of each view.

        Args:
            scale: Concentration gained by a bright upright view, unit 1, range > 0.
            brightness: Recorded intensity over the capture's largest, unit 1, range [0, 1].
            cos_view: Cosine of the view zenith, unit 1, range (0, 1].

        Returns:
            The concentration, unit 1, at least `minimum`.
        """
        gain = brightness**self.brightness_exponent * cos_view**self.angle_exponent
        return self.minimum + scale * gain


@dataclasses.dataclass(frozen=True)
class ScaleSchedule(Carded):
    r"""Scale of the intensity noise: it grows towards full scale and towards grazing.

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

    def scale(
        self,
        base: Float[Array, "..."],
        brightness: Float[Array, "... view"],
        cos_view: Float[Array, "... view"],
    ) -> Float[Array, "... view"]:
        """The scale of each view, in the unit of `base`.

        Args:
            base: Scale of a dark upright view, range > 0.
            brightness: Predicted intensity over full scale, unit 1, range >= 0.
            cos_view: Cosine of the view zenith, unit 1, range (0, 1].

        Returns:
            The scale, at least `base`.
        """
        # A smooth bound: a corner here would put a corner, not a peak, on top of the posterior
        # whenever a view is predicted close to full scale.
        width = SMOOTHING * self.least_headroom
        spare = (1.0 - brightness - self.least_headroom) / width
        headroom = self.least_headroom + width * jax.nn.softplus(spare)
        cosine = jnp.maximum(cos_view, self.least_cosine)
        # Not `headroom ** -exponent`: a power is computed number by number, these in bunches.
        growth = jnp.exp(-self.headroom_exponent * jnp.log(headroom))
        return base * growth * cosine**-self.angle_exponent


def trusted_precision(
    precision: Float[Array, "..."], confidence: Float[Array, "... view"] | None
) -> Float[Array, "..."]:
    """A precision, less where the stated normal is less trusted: precision times confidence.

    Args:
        precision: Of a reading at directions that are sure, any unit, range > 0.
        confidence: Trust in the stated normal, unit 1, range (0, 1]; None where it is sure.

    Returns:
        The precision that is left, broadcast; the same object where the normal is sure.

    Raises:
        Nothing.
    """
    return precision if confidence is None else precision * confidence


def trusted_scale(
    scale: Float[Array, "..."], confidence: Float[Array, "... view"] | None
) -> Float[Array, "..."]:
    """The same for the scale of noise, one over the root of a precision.

    Args:
        scale: Of a reading at directions that are sure, any unit, range > 0.
        confidence: Trust in the stated normal, unit 1, range (0, 1]; None where it is sure.

    Returns:
        scale/sqrt(confidence), broadcast; the same object where the normal is sure.

    Raises:
        Nothing.
    """
    return scale if confidence is None else scale / jnp.sqrt(confidence)


def _check_range(schedule: object, field: str, low: float, high: float) -> None:
    value = getattr(schedule, field)
    if not low <= value <= high:
        raise FitError(
            f"{field} is {value}",
            where=type(schedule).__name__,
            mend=f"give a number from {low:g} to {high:g}",
        )
