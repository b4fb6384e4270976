"""What a model says about itself when it is told once, without computing anything."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from numpyro import distributions as dist
from numpyro import handlers
from numpyro.primitives import Messenger

from polar_bayes.errors import FitError
from polar_bayes.inference.program import family_of, is_auxiliary
from polar_bayes.observation.data import Observations
from polar_bayes.observation.links import AbstractLink
from polar_bayes.physics.scene import Scene
from polar_bayes.priors import PriorTable, check_support


class Story(NamedTuple):
    """What was found."""

    priors: tuple[str, ...]
    declared: dict[str, str]
    fixed: dict[str, Any]


def read_story(
    model: Callable,
    data: Observations,
    scene: Scene,
    priors: PriorTable,
    links: Mapping[str, AbstractLink],
) -> Story:
    """Tell the story once, with abstract arrays, and refuse what cannot be fitted."""
    sites: dict[str, dict] = {}

    def tell(data: Observations) -> None:
        seeded = handlers.seed(model, jax.random.key(0))
        sites.update(
            handlers.trace(seeded).get_trace(data, scene=scene, priors=priors, links=links)
        )

    jax.eval_shape(tell, data)
    sampled = {name: site for name, site in sites.items() if site["type"] == "sample"}
    latent = {name: site for name, site in sampled.items() if not site["is_observed"]}
    for name, site in latent.items():
        _check_site(name, site["fn"])
    _check_handlers(model, tuple(sampled))
    _check_readings(sampled, data)
    return Story(
        priors=priors.read,
        declared={
            name: family_of(site["fn"])
            for name, site in latent.items()
            if name not in priors.read and not is_auxiliary(site)
        },
        fixed={
            name: _value_of(site["value"])
            for name, site in sampled.items()
            if site["is_observed"] and name not in data.readings
        },
    )


def _value_of(value: Any) -> Any:
    """What JSON can hold of a value that a model was given."""
    if isinstance(value, jax.core.Tracer):
        return "as the model computes it"
    return np.asarray(value).tolist()


def _check_handlers(model: Callable, sites: tuple[str, ...]) -> None:
    """Two handlers hold a value while one simulates, but not while one samples a posterior."""
    while isinstance(model, Messenger):
        held = [name for name in getattr(model, "data", None) or {} if name in sites]
        if isinstance(model, handlers.substitute | handlers.do) and held:
            raise FitError(
                f"{type(model).__name__} does not hold {held[0]} while the posterior is sampled",
                where="model",
                mend=f"use numpyro.handlers.condition(model, data={{{held[0]!r}: ...}})",
            )
        model = model.fn


def _check_site(name: str, distribution: dist.Distribution) -> None:
    where = f"model: sample({name!r})"
    if distribution.support.is_discrete:
        raise FitError(
            f"{family_of(distribution)} is discrete, and samplers follow gradients",
            where=where,
            mend="give a continuous distribution, or sum the discrete site out",
        )
    check_support(name, distribution, where)


def _check_readings(sampled: Mapping[str, dict], data: Observations) -> None:
    """A model that observes nothing, or draws a reading, has lost its data."""
    drawn = [n for n in data.readings if n in sampled and not sampled[n]["is_observed"]]
    if drawn:
        raise FitError(
            "it is drawn, not observed",
            where=f"model: sample({drawn[0]!r})",
            mend="give it obs=link.reading(data.readings[name]), as declare_readings does",
        )
    if not any(name in sampled for name in data.readings):
        raise FitError(
            "the model observes none of the readings",
            where="model",
            mend=f"end it with declare_readings(...), or observe {' or '.join(data.readings)}",
        )
