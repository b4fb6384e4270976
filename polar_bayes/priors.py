r"""Default priors, their validation and their description.

NumPyro samples the log of a positive value. Where the prior density at zero is finite, that log has
an unbounded left tail, which mixes slowly. `HalfNormal` is sampled in its normal score instead,

$$ z = \Phi^{-1}\big(2 \Phi(x/\sigma) - 1\big) $$

under which the prior is standard normal. So are `Beta(1, b)` and `Beta(a, 1)`, whose log odds
have such a tail towards the bound where their density is finite. Any smooth map will do as a
coordinate: in place of $\Phi$ stands a function of few operations (`log_odds`), so that programs
compile in less time. Densities are those of that function, exactly.

Every model reads the table `PRIORS`. A caller replaces any row with any NumPyro distribution of the
right support: `priors={"refractive_index": dist.Normal(1.5, 0.02)}` is
refused (an index below 1 is possible under it), `dist.TruncatedNormal(1.5, 0.02, low=1.0)` is
not. Distributions are made of Python numbers, so that importing this file creates no array and
the fit chooses the precision.
"""

import dataclasses
import difflib
import functools
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Literal, NoReturn, override

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaln
from jaxtyping import Array, ArrayLike, Float
from numpyro import distributions as dist
from numpyro.distributions import constraints, transforms

from polar_bayes.errors import FitError
from polar_bayes.expressions import parse_value
from polar_bayes.physics.part import notation
from polar_bayes.repr_html import DisplaySummary, Row, Table, value_text


def support_bounds(prior: dist.Distribution) -> tuple[float, float]:
    """Return the smallest and largest value that a prior allows; infinite without a bound."""
    return constraint_bounds(prior.support)


def constraint_bounds(support: constraints.Constraint) -> tuple[float, float]:
    """Return the smallest and largest value that satisfies a constraint, or infinity."""
    while isinstance(support, constraints.independent):
        support = support.base_constraint
    low = getattr(support, "lower_bound", -math.inf)
    high = getattr(support, "upper_bound", math.inf)
    return float(np.min(low)), float(np.max(high))


# --- Coordinates that are normal scores -----------------------------------------------------------


class ByNormalScore(constraints.Constraint):
    """The support of a transform's values, whose unconstrained coordinate is its argument."""

    def __init__(self, transform: transforms.Transform) -> None:
        self.transform = transform

    @property
    def lower_bound(self) -> float:
        """The least value."""
        return getattr(self.transform.codomain, "lower_bound", -math.inf)

    @property
    def upper_bound(self) -> float:
        """The largest value."""
        return getattr(self.transform.codomain, "upper_bound", math.inf)

    @override
    def __call__(self, x: ArrayLike) -> Array:
        return (jnp.asarray(x) > self.lower_bound) & (jnp.asarray(x) < self.upper_bound)

    @override
    def feasible_like(self, prototype: Array) -> Array:
        return self.transform(jnp.zeros_like(prototype))

    @override
    def eq(self, other: object, static: bool = False) -> bool:
        return isinstance(other, ByNormalScore) and other.transform == self.transform

    @override
    def tree_flatten(self) -> tuple:
        return (self.transform,), (("transform",), {})


@dist.biject_to.register(ByNormalScore)
def _by_score(support: ByNormalScore) -> transforms.Transform:
    return support.transform


BEND = 32.0 / math.pi
"""Constant of `log_odds` that gives it the slope at 0 of the log odds of a normal score."""


def log_odds(z: Float[Array, "..."]) -> Float[Array, "..."]:
    r"""Return the log odds of a share from its score, $v = \frac12 z \sqrt{z^2 + 32/\pi}$.

    $1/(1+e^{-v})$ is within .0006 of $\Phi(z)$, and its tails fall as those of $\Phi$ do.
    """
    return 0.5 * z * jnp.sqrt(z**2 + BEND)


def score_of_log_odds(v: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the score of a share from its log odds."""
    return 2.0 * v / jnp.sqrt(0.5 * (BEND + jnp.sqrt(BEND**2 + (4.0 * v) ** 2)))


def log_slope(z: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the log of the derivative of `log_odds`."""
    return jnp.log(z**2 + 0.5 * BEND) - 0.5 * jnp.log(z**2 + BEND)


# --- Half-normal prior ----------------------------------------------------------------------------


class HalfNormal(dist.HalfNormal):
    """The half-normal distribution, sampled in its normal score."""

    @property
    @override
    def support(self) -> constraints.Constraint:
        return ByNormalScore(NormalScoreToHalfNormal(self.scale))


class NormalScoreToHalfNormal(transforms.Transform):
    r"""Transform of a normal score to the half-normal quantile of that score.

    A share $2\Phi(-x)$ is beyond a value x of scale 1, and $\Phi(-z)$ beyond a score z: they are
    equal where the log odds v are $e^{v(x)} = 1 + 2 e^{v(z)}$.
    """

    domain = constraints.real
    codomain = constraints.positive

    def __init__(self, scale: float) -> None:
        self.scale = scale

    def __call__(self, x: Array) -> Array:
        """Return the half-normal value at a score."""
        odds = log_odds(jnp.asarray(x)) + math.log(2.0)
        return self.scale * score_of_log_odds(jnp.logaddexp(odds, 0.0))

    @override
    def _inverse(self, y: Array) -> Array:
        odds = log_odds(jnp.asarray(y) / self.scale)
        return score_of_log_odds(odds + jnp.log(-jnp.expm1(-odds)) - math.log(2.0))

    @override
    def log_abs_det_jacobian(
        self, x: Array, y: Array, intermediates: object | None = None
    ) -> Array:
        odds = log_odds(jnp.asarray(x)) + math.log(2.0)
        share = odds - jnp.logaddexp(odds, 0.0)  # log of the derivative of logaddexp
        return jnp.log(self.scale) + share + log_slope(x) - log_slope(y / self.scale)

    @override
    def eq(self, other: object, static: bool = False) -> bool:
        return isinstance(other, NormalScoreToHalfNormal) and other.scale == self.scale

    @override
    def tree_flatten(self) -> tuple:
        return (self.scale,), (("scale",), {})


# --- Beta prior -----------------------------------------------------------------------------------


class Beta(dist.Beta):
    """The Beta distribution, sampled in its normal score where one of its shapes is 1."""

    # NumPyro's own converts the shapes to arrays at once, in the current precision: a table of
    # priors would start JAX on import and stay in single precision. Here they are Python numbers.

    def __init__(
        self, concentration1: float, concentration0: float, *, validate_args: bool | None = None
    ) -> None:
        self.concentration1, self.concentration0 = concentration1, concentration0
        dist.Distribution.__init__(self, validate_args=validate_args)

    @property
    @override
    def support(self) -> constraints.Constraint:
        rising, falling = self.concentration1, self.concentration0
        if _is_one(rising) and isinstance(falling, float | int):
            return ByNormalScore(NormalScoreToPower(float(falling), falls=True))
        if _is_one(falling) and isinstance(rising, float | int):
            return ByNormalScore(NormalScoreToPower(float(rising), falls=False))
        return constraints.unit_interval

    @override
    def sample(self, key: Array, sample_shape: tuple[int, ...] = ()) -> Array:
        support = self.support
        if isinstance(support, ByNormalScore):  # a sampler by rejection compiles for a second
            return support.transform(jax.random.normal(key, self.shape(sample_shape)))
        return dist.Beta(self.concentration1, self.concentration0).sample(key, sample_shape)

    @override
    def log_prob(self, value: Array) -> Array:
        shapes = self.concentration1, self.concentration0
        # A shape of 1 adds nothing, not even a derivative of zero times infinity at its bound.
        logs = zip(shapes, (jnp.log, lambda x: jnp.log1p(-x)), strict=True)
        terms = ((shape - 1.0) * log(value) for shape, log in logs if not _is_one(shape))
        total = gammaln(shapes[0] + shapes[1])
        return sum(terms, total - gammaln(shapes[0]) - gammaln(shapes[1]))


def _is_one(shape: object) -> bool:
    """Return whether a shape is the Python number 1; traced values count as others."""
    return isinstance(shape, float | int) and shape == 1.0


class NormalScoreToPower(transforms.Transform):
    r"""Transform of a normal score z to a quantile of a power distribution.

    $x = \Phi(z)^{1/p}$ under Beta(p, 1), and $x = 1 - \Phi(-z)^{1/p}$ under Beta(1, p), which
    `falls`; $\Phi$ by its `log_odds`.
    """

    domain = constraints.real
    codomain = constraints.unit_interval

    def __init__(self, power: float, falls: bool) -> None:
        self.power, self.falls = power, falls

    def __call__(self, x: Array) -> Array:
        """Return the value at a score; squared distances from 0 and 1 are representable."""
        log_share = -jnp.logaddexp(-self._odds(x), 0.0) / self.power
        value = -jnp.expm1(log_share) if self.falls else jnp.exp(log_share)
        number = jnp.finfo(value.dtype)
        return jnp.clip(value, 2.0 * number.tiny**0.5, 1.0 - number.eps)

    @override
    def _inverse(self, y: Array) -> Array:
        y = jnp.asarray(y)
        log_share = self.power * (jnp.log1p(-y) if self.falls else jnp.log(y))
        score = score_of_log_odds(log_share - jnp.log(-jnp.expm1(log_share)))
        return -score if self.falls else score

    @override
    def log_abs_det_jacobian(
        self, x: Array, y: Array, intermediates: object | None = None
    ) -> Array:
        odds = self._odds(x)
        rest = jnp.logaddexp(-odds, 0.0)  # minus the log of the share, whose power is the value
        return log_slope(x) - odds - rest * (1.0 + 1.0 / self.power) - math.log(self.power)

    @override
    def eq(self, other: object, static: bool = False) -> bool:
        mine = self.power, self.falls
        return isinstance(other, NormalScoreToPower) and (other.power, other.falls) == mine

    @override
    def tree_flatten(self) -> tuple:
        return (), ((), {"power": self.power, "falls": self.falls})

    def _odds(self, x: Array) -> Array:
        odds = log_odds(jnp.asarray(x))
        return -odds if self.falls else odds


# --- The prior of an exposure ---------------------------------------------------------------------

CONTRAST = 1e4
"""Largest ratio of intensities in a capture for which an exposure is set: outside its highlight a
bare mirror is darker, and nobody exposes for that."""


class Metered(dist.LogNormal):
    """Log-normal prior of an exposure that was set by a meter for the light of the capture.

    Where the light of all its views is known to a model, it samples the share of full scale at
    which their log-average is recorded, `exposure_share`, and the exposure follows. Readings tell
    that share, whatever the material, so that chains take long steps.

    Source:
        Reinhard, Stark, Shirley and Ferwerda 2002, "Photographic tone reproduction for digital
        images", ACM Trans. Graph. 21(3), 267-276, eq. 1 and 2: the log-average at a share of .18.
    """

    @override
    def cdf(self, value: ArrayLike) -> Array:
        raise NotImplementedError("it depends on the light")


# --- Priors that come from other pixels -----------------------------------------------------------


class NormalCoordinate(dist.TransformedDistribution):
    """Normal distribution in the unconstrained coordinate of a support.

    Args:
        mean: Of the coordinate, in the shape of one draw.
        sd: The same.
        support: Of the distribution.
    """

    def __init__(self, mean: Array, sd: Array, support: constraints.Constraint) -> None:
        self._support = support
        base = dist.Normal(mean, sd)
        transform = dist.biject_to(support)
        super().__init__(base.to_event(transform.domain.event_dim), [transform])

    @property
    @override
    def support(self) -> constraints.Constraint:
        return self._support


# --- Priors as text -------------------------------------------------------------------------------


@value_text.register
def describe_prior(prior: dist.Distribution) -> str:
    """A prior as text, for reports: `TruncatedNormal(loc=1.45, scale=0.15, low=1.2, high=2)`."""
    return prior_text(prior, is_exact=False)


def prior_text(prior: dist.Distribution, *, is_exact: bool = True) -> str:
    """A prior as text with every digit, which `parse_prior` reads."""
    try:
        return _Calls(is_exact).describe(prior)
    except Exception:
        # A report must not fail because of a user-defined distribution.
        return type(prior).__name__


def parse_prior(text: object, where: str) -> dist.Distribution:
    """Return the NumPyro distribution that a text such as `Normal(0, 3)` describes.

    Args:
        text: As `prior_text` writes it, or as it stands in a program. `HalfNormal` and `Beta` are
            those of this file, which have the same densities, and so is `Metered`.
        where: Where the text is, for the message of an error.

    Raises:
        FitError: It describes no distribution.
    """
    found = parse_value(text, _distributions(), where)
    if not isinstance(found, dist.Distribution):
        _refuse_prior(found, where)
    return found


def short_numbers(text: str) -> str:
    """Round the numbers in the text of a prior to six digits."""
    return re.sub(r"\d+\.\d+(?:e[+-]?\d+)?", lambda found: f"{float(found[0]):g}", text)


def unwrapped(distribution: dist.Distribution) -> dist.Distribution:
    """Return the distribution inside masks, expansions and event dimensions."""
    wrappers = dist.distribution.MaskedDistribution | dist.ExpandedDistribution | dist.Independent
    while isinstance(distribution, wrappers):
        distribution = distribution.base_dist
    return distribution


type Mixture = dist.MixtureSameFamily | dist.MixtureGeneral

Truncated = (
    dist.LeftTruncatedDistribution
    | dist.RightTruncatedDistribution
    | dist.TwoSidedTruncatedDistribution
)


@dataclasses.dataclass(frozen=True)
class _Calls:
    """Distributions as the calls that make them, which `parse_prior` reads if they are exact."""

    is_exact: bool

    def describe(self, prior: dist.Distribution) -> str:
        """A distribution with its arguments."""
        if isinstance(prior, dist.distribution.MaskedDistribution) and not self.is_exact:
            return self.describe(prior.base_dist)
        if isinstance(prior, dist.Independent):
            return f"{self.describe(prior.base_dist)}.to_event({prior.reinterpreted_batch_ndims})"
        if isinstance(prior, dist.ExpandedDistribution):
            return f"{self.describe(prior.base_dist)}.expand({list(prior.batch_shape)})"
        if isinstance(prior, Truncated):
            return self._truncated(prior)
        name = type(prior).__name__
        if isinstance(prior, dist.MixtureSameFamily | dist.MixtureGeneral):
            weights = self._fields({"probs": prior.mixing_distribution.probs})
            inner = ", ".join(map(self.describe, _components(prior)))
            inner = f"[{inner}]" if isinstance(prior, dist.MixtureGeneral) else inner
            return f"{name}(CategoricalProbs({weights}), {inner})"
        if isinstance(prior, dist.TransformedDistribution) and not prior.arg_constraints:
            steps = (f"{type(x).__name__}({self._fields(vars(x))})" for x in prior.transforms)
            return f"{name}({self.describe(prior.base_dist)}, [{', '.join(steps)}])"
        return f"{name}({self._arguments(prior)})"

    def _arguments(self, prior: dist.Distribution) -> str:
        return self._fields({key: getattr(prior, key, None) for key in prior.arg_constraints})

    def _truncated(self, prior: dist.Distribution) -> str:
        ends = zip(("low", "high"), support_bounds(prior), strict=True)
        bounds = self._fields({key: x for key, x in ends if math.isfinite(x)})
        name = f"Truncated{type(prior.base_dist).__name__}"
        if hasattr(dist, name):
            return f"{name}({self._arguments(prior.base_dist)}, {bounds})"
        return f"TruncatedDistribution({self.describe(prior.base_dist)}, {bounds})"

    def _fields(self, values: Mapping[str, object]) -> str:
        """The numeric values among these, as `loc=1, scale=2`."""
        shown = {key: np.asarray(x) for key, x in values.items() if not key.startswith("_")}
        numbers = {key: x for key, x in shown.items() if x.dtype.kind in "iuf"}
        return ", ".join(f"{key}={self._text(number)}" for key, number in numbers.items())

    def _text(self, numbers: np.ndarray) -> str:
        """A number, or a list; for readers a long list by its shape."""
        if numbers.ndim == 0 or (numbers.size == 1 and not self.is_exact):
            number = numbers.item()
            short = f"{number:g}"
            return repr(number) if self.is_exact and float(short) != number else short
        if not self.is_exact and (numbers.ndim > 1 or numbers.size > 8):
            return f"<array {numbers.shape}>"
        return f"[{', '.join(map(self._text, numbers))}]"


def _components(prior: Mixture) -> Sequence[dist.Distribution]:
    """Return the components of a mixture."""
    is_general = isinstance(prior, dist.MixtureGeneral)
    return prior.component_distributions if is_general else [prior.component_distribution]


@functools.cache
def _distributions() -> Mapping[str, Callable[..., object]]:
    """Return what the text of a prior may name: NumPyro's distributions and transforms."""
    names = (name for name in dist.__all__ if name[:1].isupper())
    own = {"HalfNormal": HalfNormal, "Beta": Beta, "Metered": Metered}
    known = {name: getattr(dist, name) for name in names} | own
    known |= {name: getattr(transforms, name) for name in transforms.__all__ if name[:1].isupper()}
    return {name: _with_arrays(made) for name, made in known.items()}


def _with_arrays(made: Callable[..., object]) -> Callable[..., object]:
    """Wrap the constructors, so that tuples of numbers become arrays for NumPyro."""

    def convert(argument: object) -> object:
        if not isinstance(argument, tuple):
            return argument
        parts = dist.Distribution | transforms.Transform
        of_parts = any(isinstance(each, parts) for each in argument)
        return list(argument) if of_parts else np.asarray(argument, float)

    @functools.wraps(made)
    def make(*arguments: object, **keywords: object) -> object:
        return made(*map(convert, arguments), **{k: convert(x) for k, x in keywords.items()})

    return make


# --- The table: one NumPyro distribution for every named parameter --------------------------------


class Priors(dict[str, dist.Distribution]):
    """A dictionary of priors that notebooks show as a table."""

    def _repr_html_(self) -> str:
        return prior_card(self)._repr_html_()


def prior_card(priors: Mapping[str, dist.Distribution]) -> DisplaySummary:
    """Return a table of parameters: meaning, prior and unit."""
    columns = ("parameter", "meaning", "prior", "unit")
    words = {name: notation(name) for name in priors}
    rows = tuple(
        Row(name, (words[name].meaning, describe_prior(prior), words[name].unit))
        for name, prior in priors.items()
    )
    return DisplaySummary("Priors", (), (Table(columns, rows, prose=columns),))


_ROWS: dict[str, dist.Distribution] = {
    # The material: the paper, section 2.
    "roughness": HalfNormal(0.2),
    "subsurface_fraction": Beta(2.0, 2.0),
    "absorption": dist.LogNormal(-1.0, 0.5),
    "refractive_index": dist.TruncatedNormal(1.45, 0.15, low=1.2, high=2.0),
    # The material, in scenes with more parts: a second roughness, a body's own color, a law of
    # dispersion (for lengths in micrometers), a coat, a film (nm).
    "roughness_across": dist.HalfNormal(0.2),
    "roughness_azimuth": dist.Normal(0.0, 45.0),
    "albedo": Beta(2.0, 2.0),
    "anisotropy": dist.Uniform(0.0, 0.9),
    "polarized_fraction": Beta(2.0, 2.0),
    "cauchy_a": dist.TruncatedNormal(1.44, 0.15, low=1.2, high=2.0),
    "cauchy_b": dist.LogNormal(math.log(0.005), 0.5),
    "sellmeier_strength": dist.TruncatedNormal(1.05, 0.4, low=0.4, high=3.0),
    "sellmeier_resonance": dist.TruncatedNormal(0.011, 0.004, low=0.0, high=0.03),
    "coat_refractive_index": dist.TruncatedNormal(1.5, 0.05, low=1.2, high=2.0),
    "coat_absorbance": dist.HalfNormal(0.2),
    "film_refractive_index": dist.TruncatedNormal(1.45, 0.1, low=1.2, high=2.0),
    "film_thickness": dist.LogNormal(math.log(200.0), 0.7),
    # A blackened back sends nothing, a beam that the detector catches whole sends all.
    "back_face_share": Beta(1.0, 1.0),
    # A clear sky: a sixth of the light of the sun over a hemisphere; haze has several times that.
    "sky_radiance": dist.LogNormal(math.log(0.05), 1.0),
    # How far the normal leans from the stated one: that of a sample laid down by eye.
    "normal_tilt_x": dist.Normal(0.0, 2.0),
    "normal_tilt_y": dist.Normal(0.0, 2.0),
    # Populations of materials or patches (models/hierarchical.py): the paper, section 2, for the
    # index; for the others the prior of the location is that of one material, and two members may
    # differ by half a unit of log or log odds.
    "roughness_location": dist.HalfNormal(0.2),
    "roughness_spread": dist.HalfNormal(0.5),
    "subsurface_fraction_location": Beta(2.0, 2.0),
    "subsurface_fraction_spread": dist.HalfNormal(0.5),
    "absorption_location": dist.LogNormal(-1.0, 0.5),
    "absorption_spread": dist.HalfNormal(0.5),
    "refractive_index_location": dist.TruncatedNormal(1.45, 0.2, low=1.2, high=2.0),
    "refractive_index_spread": dist.HalfNormal(0.1),
    # Spectra (models/gp_spectral.py). The level has the prior of one wavelength. Of 58 measured
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
    "dolp_gain": Beta(10.0, 1.0),
    "channel_gain_ratio": dist.LogNormal(0.0, 0.1),
    "leakage": HalfNormal(0.01),
    "dark_level": dist.Normal(0.0, 0.001),
    "angle_zero": dist.Normal(0.0, 0.75),
    "beam_overlap_zenith": dist.TruncatedNormal(80.0, 5.0, low=45.0, high=89.0),
    # Smooth errors of some percent are usual, and none is possible; one in 400 is worse than 36%.
    "discrepancy_amplitude": HalfNormal(0.12),
    "discrepancy_weights": dist.Normal(0.0, 1.0).expand([3]).to_event(1),
    # What a set-up is known to: a lamp placed by eye, the pose of a printed board, an analyzer set
    # by its mark. Ambient light only adds, and an analyzer only loses polarization.
    "light_zenith_offset": dist.Normal(0.0, 1.0),
    "light_azimuth_offset": dist.Normal(0.0, 1.0),
    "view_zenith_scale_offset": dist.Normal(0.0, 0.005),
    "incidence_angle_offset": dist.Normal(0.0, 0.75),
    "sample_lean_offset": dist.Normal(0.0, 0.2),
    "analyzer_roll_offset": dist.Normal(0.0, 0.3),
    "polarization_loss_offset": HalfNormal(0.008),
    "ambient_light_offset": HalfNormal(0.005),
    "tone_curve_offset": dist.Normal(0.0, 0.01),
    # The noise: scales that the data themselves determine. None may reach zero: where the scene
    # can match a few readings exactly, a scale of zero would have infinite posterior density.
    "concentration_scale": dist.LogNormal(math.log(200.0), 1.0),
    "logit_scale": dist.LogNormal(math.log(0.15), 1.0),
    "normal_scale": dist.LogNormal(math.log(0.03), 1.0),
    "stokes_scale": dist.LogNormal(math.log(0.01), 1.0),
    "stokes_error_factor": dist.LogNormal(math.log(1.5), 0.7),
    # Bodies under unit irradiance come near full scale at exposures of 5 to 15.
    "exposure": Metered(math.log(7.0), 3.0),
    "exposure_share": dist.LogNormal(math.log(0.18), 2.0),
    "intensity_scale": dist.LogNormal(math.log(0.02), 1.0),
}

PRIORS = Priors(_ROWS)
"""Default prior of each parameter, by its name."""

ANGLE_ZERO: Mapping[str, dist.Distribution] = MappingProxyType(
    {"stage": dist.Normal(0.0, 0.2), "hand": PRIORS["angle_zero"], "lens": dist.Normal(0.0, 3.0)}
)
"""Prior of `angle_zero` and `incidence_angle_offset`, degree, by how the angles were set: by a
rotary stage, by hand, or read from a picture through the geometry of its lens. What is not stated
counts as by hand."""

UNCHECKED_GAIN = dist.LogNormal(0.0, 0.3)
"""Prior of `channel_gain_ratio` for unknown incident levels of both channels."""

INDICES = (
    *("refractive_index", "cauchy_a", "refractive_index_level"),
    *("refractive_index_location", "refractive_index_level_location"),
)
"""Parameters whose prior bounds the index of a material."""

RANGES: dict[str, tuple[float, float]] = {
    **{
        name: support_bounds(prior)
        for name, prior in _ROWS.items()
        if isinstance(prior, dist.HalfNormal | dist.LogNormal | dist.Beta)
    },
    **dict.fromkeys((*INDICES, "coat_refractive_index", "film_refractive_index"), (1.0, math.inf)),
    "anisotropy": (0.0, 0.9),
    "sellmeier_strength": (0.0, math.inf),
    "sellmeier_resonance": (0.0, 0.1),
    "beam_overlap_zenith": (0.0, 90.0),
}
"""Physical ranges of parameters with bounded priors; other parameters may take any value."""


def natural_scale(name: str) -> Literal["log", "log odds", "plain"]:
    """Return the scale on which a population of a parameter is normal, by its physical range."""
    limits = RANGES.get(name, (-math.inf, math.inf))
    return "log" if limits == (0.0, math.inf) else "log odds" if limits == (0.0, 1.0) else "plain"


# --- Resolution and validation --------------------------------------------------------------------


class PriorTable(Mapping[str, dist.Distribution]):
    """Default priors with the caller's replacements, as models read them."""

    # It records the names that are read, so that a model need not list its parameters.

    def __init__(self, overrides: Mapping[str, dist.Distribution] | None = None) -> None:
        if not isinstance(overrides, Mapping | None):
            what = f"a {type(overrides).__name__} does not name what it replaces"
            hint = "give a mapping such as {'roughness': HalfNormal(0.1)}"
            raise FitError(what, where="priors", hint=hint)
        self._rows = {**PRIORS, **(overrides or {})}
        self._read: dict[str, None] = {}

    @property
    def read(self) -> tuple[str, ...]:
        """Names that have been read, in order."""
        return tuple(self._read)

    @override
    def __getitem__(self, name: str) -> dist.Distribution:
        return cast_prior(self.row(name))

    def row(self, name: str) -> dist.Distribution:
        """Return the prior as it was given."""
        if name not in self._rows:
            hint = f"give one: priors={{{name!r}: <a NumPyro distribution>}}"
            raise FitError("this parameter has no prior", where=f"priors[{name!r}]", hint=hint)
        self._read[name] = None
        if not isinstance(self._rows[name], dist.Distribution):
            _refuse_prior(self._rows[name], f"priors[{name!r}]")
        return self._rows[name]

    @override
    def __iter__(self) -> Iterator[str]:
        return iter(self._rows)

    @override
    def __len__(self) -> int:
        return len(self._rows)


def cast_prior(prior: dist.Distribution) -> dist.Distribution:
    """Return a copy of a prior in the floating type of the fit."""
    # Distributions cache lazy attributes in the precision of their first use; a copy made from the
    # arguments alone does not.

    def convert(argument: object) -> object:
        if hasattr(argument, "dtype") and jnp.issubdtype(argument.dtype, jnp.floating):
            return jnp.asarray(np.asarray(argument).astype(jnp.result_type(float)))
        return argument

    return jax.tree.map(convert, prior)


def resolve_priors(
    parameters: Iterable[str], overrides: Mapping[str, dist.Distribution] | None = None
) -> dict[str, dist.Distribution]:
    """Return the prior of every parameter that a model reads."""
    parameters = tuple(parameters)
    table = PriorTable(overrides)
    for name, prior in (overrides or {}).items():
        _check_override(str(name), prior, parameters)
    return {name: table.row(name) for name in parameters}


def check_support(name: str, prior: dist.Distribution, where: str) -> None:
    """Refuse a distribution that allows values outside the physical range of a parameter."""
    least, most = RANGES.get(name, (-math.inf, math.inf))
    try:
        low, high = support_bounds(prior)
    except jax.errors.ConcretizationTypeError:
        return  # bounds that depend on other parameters are known only when it runs
    if low < least or high > most:
        what = f"{type(prior).__name__} allows values outside {least:g} to {most:g}"
        raise FitError(what, where=where, hint=_in_range(least, most))


def _in_range(least: float, most: float) -> str:
    """Suggest a distribution with a support inside the physical range."""
    if (least, most) == (0.0, 1.0):
        return "give a Beta distribution, or a truncated one"
    if least == 0.0 and math.isinf(most):
        return "give a HalfNormal or LogNormal distribution"
    bound = f"low={least:g}" if math.isinf(most) else f"low={least:g}, high={most:g}"
    return f"truncate it, for example TruncatedNormal(..., {bound})"


def _check_override(name: str, prior: object, parameters: tuple[str, ...]) -> None:
    where = f"priors[{name!r}]"
    if name not in parameters:
        near = [known for known in parameters if notation(known).symbol == name]
        near = near or difflib.get_close_matches(name, parameters, n=1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        hint = f"{hint}the parameters are {', '.join(parameters)}"
        raise FitError("no such parameter in this model", where=where, hint=hint)
    if not isinstance(prior, dist.Distribution):
        _refuse_prior(prior, where)
    _check_shape(name, prior, where)
    check_support(name, prior, where)


def _refuse_prior(prior: object, where: str) -> NoReturn:
    """Refuse a value that is not a distribution, and suggest one."""
    kind, example = type(prior), "numpyro.distributions.Normal(0.0, 1.0)"
    hint = f"give an object such as {example}"
    if isinstance(prior, int | float):
        near = f"numpyro.distributions.Normal({prior:g}, 0.01)"
        hint = f"give a distribution around it, such as {near}, truncated where it has a range"
    elif kind.__module__.startswith("scipy."):
        name = getattr(getattr(prior, "dist", None), "name", "norm")
        hint = f"NumPyro has the like of scipy.stats.{name}: give an object such as {example}"
    raise FitError(f"a {kind.__name__} is not a NumPyro distribution", where=where, hint=hint)


def _check_shape(name: str, prior: dist.Distribution, where: str) -> None:
    """Refuse a prior of the wrong shape, or one that cannot be differentiated."""
    if prior.support.is_discrete:
        what = f"{type(prior).__name__} is discrete, and samplers follow gradients"
        raise FitError(what, where=where, hint="give a continuous distribution")
    usual = PRIORS.get(name)
    if usual is None:
        return  # a parameter of the user's own has the shape that its reader expects
    if len(prior.event_shape) != len(usual.event_shape):
        to_event = "one number" if not usual.event_shape else "a vector: use .expand([n])"
        what = f"one draw of it has shape {tuple(prior.event_shape)}"
        hint = f"give a distribution of {to_event}{'.to_event(1)' if usual.event_shape else ''}"
        raise FitError(what, where=where, hint=hint)
    if prior.batch_shape and prior.batch_shape[-1] != 1:
        what = f"it is a batch of {prior.batch_shape[-1]} distributions"
        hint = "give one, or one per wavelength in shape (wavelength, 1): views share it"
        raise FitError(what, where=where, hint=hint)
