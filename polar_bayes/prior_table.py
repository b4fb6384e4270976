"""The priors of a scene as a table: what is believed of each parameter, in words and numbers."""

from collections.abc import Mapping

import jax
import numpy as np
import pandas as pd
from numpyro import distributions as dist

from polar_bayes.physics.part import notation
from polar_bayes.physics.scene import Scene
from polar_bayes.priors import PRIORS, describe_prior, resolve_priors
from polar_bayes.setups import find_setup

DRAWS = 10_000
LEVELS = (0.025, 0.5, 0.975)


def prior_table(
    scene: str | Scene | None = None, *, priors: Mapping[str, dist.Distribution] | None = None
) -> pd.DataFrame:
    """What is believed before any data.

    Args:
        scene: The name of a set-up, whose links' noise is listed too, or a scene; by default every
            parameter that has a prior.
        priors: Distributions that replace or extend `polar_bayes.PRIORS`, as for `polar_bayes.fit`.

    Returns:
        A row for each parameter: symbol, meaning, unit, prior (in words), and its quantiles q2.5,
        q50 and q97.5 (unit of the parameter), of 10,000 draws with a fixed seed.

    Raises:
        SceneError: No such set-up.
        FitError: A prior cannot be used, or belongs to no parameter of the scene.
    """
    rows = {}
    for name, prior in resolve_priors(_names(scene, priors), priors).items():
        draws = np.asarray(prior.sample(jax.random.key(0), (DRAWS,)))
        levels = np.quantile(draws, LEVELS).tolist()
        rows[name] = [*notation(name), describe_prior(prior), *levels]
    columns = ["symbol", "meaning", "unit", "prior", "q2.5", "q50", "q97.5"]
    return pd.DataFrame.from_dict(rows, orient="index", columns=columns)


def _names(
    scene: str | Scene | None, priors: Mapping[str, dist.Distribution] | None
) -> tuple[str, ...]:
    if scene is None:
        return tuple({**PRIORS, **(priors or {})})
    if isinstance(scene, Scene):
        return scene.parameters
    setup = find_setup(scene)
    noise = (name for link in setup.links.values() for name in link.parameters)
    return tuple(dict.fromkeys((*setup.scene.parameters, *noise)))
