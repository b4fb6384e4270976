"""Draws of two mixtures as those of one: no draw that cost an evaluation is thrown away.

A draw is weighed by the mean of both mixtures, whichever it came from. What one of them covers
badly the other may cover well, and a mixture that is too narrow is found out by the other's draws.

Source:
    Veach & Guibas (1995), SIGGRAPH, 419-428: the balance heuristic; Cornuet, Marin, Mira & Robert
    (2012), Scand. J. Stat. 39(4), 798-812: mixtures that are adapted meanwhile.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polar_bayes.pixels.batching import batches
from polar_bayes.pixels.importance import smooth
from polar_bayes.pixels.mixtures import Mixture, Proposed, log_density
from polar_bayes.pixels.outcome import Weighted

BATCH = 16
"""Pixels that are weighed at a time: their draws stay in a core's own cache."""


def pool(first: Proposed, second: Proposed) -> Weighted:
    """The draws of both, weighed by the posterior over the mean of both mixtures."""
    z, parameters, log_posterior = jax.tree.map(
        lambda *x: np.concatenate(x, axis=1), first[1:], second[1:]
    )
    parts = []
    with jax.enable_x64(False):
        for index in batches(len(z), BATCH):
            given = jax.tree.map(lambda x, i=index: x[i], (first.mixture, second.mixture, z))
            parts.append(np.asarray(_log_means(*given)))
    ratios = log_posterior - np.concatenate(parts)[: len(z)]
    return Weighted(z, parameters, *smooth(ratios))


@jax.jit
@jax.vmap
def _log_means(first: Mixture, second: Mixture, z: Array) -> Array:
    """Log of the mean density of two mixtures at each draw of one pixel."""
    return jnp.logaddexp(log_density(first, z), log_density(second, z))
