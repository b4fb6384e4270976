"""Parameters of many draws at once."""

import jax.numpy as jnp
import numpy as np

from polar_bayes.inference.program import Program
from polar_bayes.observation.data import Observations

PIECE = 500


def parameters_of(program: Program, z: np.ndarray, data: Observations) -> dict[str, np.ndarray]:
    """What draws say of the parameters, and nothing of readings."""
    count = z.shape[1]
    pieces = []
    for begin in range(0, count, PIECE):
        index = np.minimum(np.arange(begin, begin + PIECE), count - 1)
        found = program.parameters_of_chains(jnp.asarray(z[:, index]), data)
        pieces.append({name: np.asarray(value) for name, value in found.items()})
    return {
        name: np.concatenate([piece[name] for piece in pieces], axis=1)[:, :count]
        for name in pieces[0]
    }
