"""Cumulative prior probabilities of the default families, without compiled programs."""

import functools

import jax
import numpy as np
from numpyro import distributions as dist
from scipy import special

from polar_bayes.numerics.batches import map_elements
from polar_bayes.priors import cast_prior


def has_probabilities(prior: dist.Distribution) -> bool:
    """Return whether NumPyro has a cumulative distribution function of this prior."""
    try:
        jax.eval_shape(lambda x: cast_prior(prior).cdf(x), np.zeros(prior.batch_shape))
    except NotImplementedError:  # NumPyro asks few distributions for one
        return False
    return not prior.event_shape


@functools.singledispatch
def probability_below(prior: dist.Distribution, x: np.ndarray) -> np.ndarray:
    """Return the prior's cumulative distribution function in double precision; shape of `x`."""
    with jax.enable_x64(True):
        if prior.batch_shape:
            return np.asarray(cast_prior(prior).cdf(x))
        return map_elements(cast_prior(prior).cdf, x, 1024)  # at a time: JAX compiles once


@probability_below.register
def _(prior: dist.Normal, x: np.ndarray) -> np.ndarray:
    return special.ndtr((x - np.asarray(prior.loc)) / np.asarray(prior.scale))


@probability_below.register
def _(prior: dist.LogNormal, x: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore"):
        return special.ndtr((np.log(x) - np.asarray(prior.loc)) / np.asarray(prior.scale))


@probability_below.register
def _(prior: dist.HalfNormal, x: np.ndarray) -> np.ndarray:
    return special.erf(x / (2.0**0.5 * np.asarray(prior.scale)))


@probability_below.register
def _(prior: dist.Beta, x: np.ndarray) -> np.ndarray:
    return special.betainc(np.asarray(prior.concentration1), np.asarray(prior.concentration0), x)


@probability_below.register
def _(prior: dist.TwoSidedTruncatedDistribution, x: np.ndarray) -> np.ndarray:
    low, high = (probability_below(prior.base_dist, end) for end in (prior.low, prior.high))
    return (probability_below(prior.base_dist, x) - low) / (high - low)
