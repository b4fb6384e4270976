"""The ends of a prior."""

import math

import numpy as np
from numpyro import distributions as dist
from numpyro.distributions import constraints


def support_bounds(prior: dist.Distribution) -> tuple[float, float]:
    """Smallest and largest value that a prior allows, infinite where it has no bound."""
    support = prior.support
    while isinstance(support, constraints.independent):
        support = support.base_constraint
    low = getattr(support, "lower_bound", -math.inf)
    high = getattr(support, "upper_bound", math.inf)
    return float(np.min(low)), float(np.max(high))
