"""A prior in words, for reports."""

import math
from collections.abc import Mapping

import numpy as np
from numpyro import distributions as dist

from polar_bayes.priors.support import support_bounds


def describe_prior(prior: dist.Distribution) -> str:
    """A prior as text, for reports: `TruncatedNormal(loc=1.45, scale=0.15, low=1.2, high=2)`."""
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
