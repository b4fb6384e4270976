"""Cache keys of compiled programs: requests with equal keys share their programs."""

import dataclasses
from collections.abc import Callable, Mapping

import jax
from numpyro import distributions as dist

from polar_bayes.numerics.fingerprint import fingerprint
from polar_bayes.observation.data import Observations
from polar_bayes.observation.links import AbstractLink
from polar_bayes.physics.scene import Scene


def cache_key(
    model: Callable,
    scene: Scene,
    priors: Mapping[str, dist.Distribution],
    links: Mapping[str, AbstractLink],
    *further: object,
) -> str:
    """Return a text that is equal for requests with the same compiled programs."""
    # Not the priors themselves: distributions store what they have computed.
    stated = [
        (name, jax.tree.leaves(prior), str(jax.tree.structure(prior)))
        for name, prior in priors.items()
    ]
    scene = dataclasses.replace(scene)  # without its ledger
    code = (model, scene, links, *map(type, priors.values()))
    return fingerprint(model, scene, stated, links, *further, code=code)


def layout_of(data: Observations) -> tuple[str, ...]:
    """Return what programs depend on in a capture: variables, axes, lengths and types."""
    return (str(jax.tree.structure(data)), *(f"{x.dtype}{x.shape}" for x in jax.tree.leaves(data)))
