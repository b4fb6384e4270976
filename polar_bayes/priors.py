"""What is believed before any data: one NumPyro distribution for every named parameter.

The table is written once and read by every model. A caller replaces any row with any NumPyro
distribution of the right support: `priors={"refractive_index": dist.Normal(1.5, 0.02)}` is
refused (an index below 1 is possible under it), `dist.TruncatedNormal(1.5, 0.02, low=1.0)` is
not. Distributions are made of Python numbers, so that importing this file creates no array and
the fit chooses the precision.
"""

import difflib
import math
from collections.abc import Iterable, Mapping
from typing import override

import numpy as np
from jaxtyping import Array
from numpyro import distributions as dist
from numpyro.distributions import constraints

from polar_bayes.errors import FitError


class Beta(dist.Beta):
    """The Beta distribution, two Python numbers until it is used.

    NumPyro's own turns them into an array at once, in the precision of that moment: a table of
    priors would start the array library on import and stay in single precision for ever.

    Args:
        concentration1: Unit 1, range > 0.
        concentration0: Unit 1, range > 0.
    """

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


PRIORS: dict[str, dist.Distribution] = {
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
    # The instrument: what a careful set-up leaves unknown.
    "dolp_gain": Beta(10.0, 1.5),
    "channel_gain_ratio": dist.LogNormal(0.0, 0.1),
    "leakage": dist.HalfNormal(0.01),
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


def resolve_priors(
    parameters: Iterable[str], overrides: Mapping[str, dist.Distribution] | None = None
) -> dict[str, dist.Distribution]:
    """The prior of every parameter that a model reads.

    Args:
        parameters: Names that the scene and the links read.
        overrides: Priors that replace or extend the table.

    Returns:
        A distribution for each name, in the order given.

    Raises:
        FitError: An override is not a continuous NumPyro distribution of the right shape, names
            no parameter of this model, or allows values outside the parameter's physical range;
            or a parameter has no prior.
    """
    parameters = tuple(parameters)
    if not isinstance(overrides, Mapping | None):
        raise FitError(
            f"a {type(overrides).__name__} does not name what it replaces",
            where="priors",
            mend="give a mapping such as {'roughness': HalfNormal(0.1)}",
        )
    overrides = dict(overrides or {})
    for name, prior in overrides.items():
        _check_override(str(name), prior, parameters)
    available = {**PRIORS, **overrides}
    for name in parameters:
        if name not in available:
            raise FitError(
                "this parameter has no prior",
                where=f"priors[{name!r}]",
                mend=f"give one: priors={{{name!r}: <a NumPyro distribution>}}",
            )
    return {name: available[name] for name in parameters}


def describe_prior(prior: dist.Distribution) -> str:
    """A prior as text, for reports: `TruncatedNormal(loc=1.45, scale=0.15, low=1.2, high=2)`.

    Args:
        prior: Any NumPyro distribution.

    Returns:
        One line; ` x (4,)` at its end means that many independent copies.

    Raises:
        Nothing: what cannot be read out of a distribution is left out.
    """
    try:
        return _description(prior)
    except Exception:
        # A report must not fail because a distribution of the user's own describes itself badly.
        return type(prior).__name__


def _description(prior: dist.Distribution) -> str:
    shape = (*prior.batch_shape, *prior.event_shape)
    while isinstance(
        prior, dist.Independent | dist.ExpandedDistribution | dist.distribution.MaskedDistribution
    ):
        prior = prior.base_dist
    copies = f" x {shape}" if shape != (*prior.batch_shape, *prior.event_shape) else ""
    return f"{_name(prior)}({', '.join(_arguments(prior))}){copies}"


def _name(prior: dist.Distribution) -> str:
    if _is_truncated(prior):
        return f"Truncated{type(prior.base_dist).__name__}"
    if isinstance(prior, dist.MixtureSameFamily | dist.MixtureGeneral):
        return "Mixture"
    return type(prior).__name__


def _arguments(prior: dist.Distribution) -> list[str]:
    """What stands between the parentheses."""
    if _is_truncated(prior):
        bounds = zip(("low", "high"), support_bounds(prior), strict=True)
        said = [f"{key}={bound:g}" for key, bound in bounds if math.isfinite(bound)]
        return _arguments(prior.base_dist) + said
    if isinstance(prior, dist.MixtureSameFamily | dist.MixtureGeneral):
        same = isinstance(prior, dist.MixtureSameFamily)
        parts = [prior.component_distribution] if same else prior.component_distributions
        return [
            f"weights={_text(np.asarray(prior.mixing_distribution.probs))}",
            *map(_description, parts),
        ]
    if isinstance(prior, dist.TransformedDistribution) and not prior.arg_constraints:
        steps = (f"{type(step).__name__}({_fields(vars(step))})" for step in prior.transforms)
        return [_description(prior.base_dist), *steps]
    return [_fields({key: getattr(prior, key, None) for key in prior.arg_constraints})]


def _fields(values: Mapping[str, object]) -> str:
    """What of these is numbers, as `loc=1, scale=2`."""
    numbers = {
        key: np.asarray(value)
        for key, value in values.items()
        if not key.startswith("_") and np.asarray(value).dtype.kind in "iuf"
    }
    return ", ".join(f"{key}={_text(number)}" for key, number in numbers.items())


def _is_truncated(prior: dist.Distribution) -> bool:
    return isinstance(
        prior,
        dist.LeftTruncatedDistribution
        | dist.RightTruncatedDistribution
        | dist.TwoSidedTruncatedDistribution,
    )


def _text(numbers: np.ndarray) -> str:
    """A number in six digits, a short list in brackets, a longer one by its shape."""
    if numbers.size == 1:
        return f"{numbers.item():g}"
    if numbers.ndim == 1 and numbers.size <= 8:
        return f"[{', '.join(f'{number:g}' for number in numbers)}]"
    return f"<array {numbers.shape}>"


def support_bounds(prior: dist.Distribution) -> tuple[float, float]:
    """Smallest and largest value that a prior allows, infinite where it has no bound."""
    support = prior.support
    while isinstance(support, constraints.independent):
        support = support.base_constraint
    low = getattr(support, "lower_bound", -math.inf)
    high = getattr(support, "upper_bound", math.inf)
    return float(np.min(low)), float(np.max(high))


def _check_override(name: str, prior: object, parameters: tuple[str, ...]) -> None:
    where = f"priors[{name!r}]"
    if name not in parameters:
        near = difflib.get_close_matches(name, parameters, n=1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise FitError(
            "no such parameter in this model",
            where=where,
            mend=f"{hint}the parameters are {', '.join(parameters)}",
        )
    if not isinstance(prior, dist.Distribution):
        raise FitError(
            f"a {type(prior).__name__} is not a NumPyro distribution",
            where=where,
            mend="give an object such as numpyro.distributions.Normal(0.0, 1.0)",
        )
    _check_shape(name, prior, where)
    low, high = support_bounds(prior)
    least, most = RANGES.get(name, (-math.inf, math.inf))
    if low < least or high > most:
        raise FitError(
            f"{type(prior).__name__} allows values outside {least:g} to {most:g}",
            where=where,
            mend="use a distribution of that support, for example TruncatedNormal or Beta",
        )


def _check_shape(name: str, prior: dist.Distribution, where: str) -> None:
    """Refuse what would be repeated over the wrong axes, or cannot be differentiated."""
    if prior.support.is_discrete:
        raise FitError(
            f"{type(prior).__name__} is discrete, and samplers follow gradients",
            where=where,
            mend="give a continuous distribution",
        )
    usual = PRIORS.get(name)
    if usual is None:
        return  # a parameter of the user's own has the shape that its reader expects
    if len(prior.event_shape) != len(usual.event_shape):
        to_event = "one number" if not usual.event_shape else "a vector: use .expand([n])"
        raise FitError(
            f"one draw of it has shape {tuple(prior.event_shape)}",
            where=where,
            mend=f"give a distribution of {to_event}{'.to_event(1)' if usual.event_shape else ''}",
        )
    if prior.batch_shape and prior.batch_shape[-1] != 1:
        raise FitError(
            f"it is {prior.batch_shape[-1]} distributions side by side",
            where=where,
            mend="give one, or one per wavelength in shape (wavelength, 1): views share it",
        )
