r"""The information of the paper: every degree of polarization counts with its concentration.

$$ F_{paper} = \sum_i \kappa_i S_i S_i^T, \quad S_i = \partial\rho_i / \partial z $$

A Beta reading of mean $\mu$ tells more. Its exact information about the mean is
$\kappa^2[\psi_1(\mu\kappa) + \psi_1((1-\mu)\kappa)]$, which is about $\kappa/(\mu(1-\mu))$: four
times the paper's at $\mu = 1/2$ and without bound towards 0 and 1.
"""

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polar_bayes.identifiability.fisher import Seen, look
from polar_bayes.inference.program import Program
from polar_bayes.observation.data import Observations


def paper_information(
    program: Program, z: Float[Array, " size"], data: Observations
) -> tuple[Float[Array, "size size"], Float[Array, "size size"]]:
    """The paper's sum over the readings with Beta noise, and the exact one about their means."""
    # The noise counts as known in both: only the means move.
    # Source: The paper, on identifiability: the sum of kappa S S' over views.
    return sum_as_paper(look(program, z, data), program.size)


def sum_as_paper(
    seen: Mapping[str, Seen], size: int
) -> tuple[Float[Array, "size size"], Float[Array, "size size"]]:
    """The same from what the readings see."""
    paper: list[Array] = []
    exact: list[Array] = []
    for each in seen.values():
        if each.concentration is not None:
            mean = each.slope[..., 0, :]
            weights = (each.concentration, each.information[..., 0, 0])
            for found, weight in zip((paper, exact), weights, strict=True):
                found.append(jnp.einsum("...i,...,...j->ij", mean, weight, mean))
    if not paper:
        nothing = jnp.full((size, size), jnp.nan)
        return nothing, nothing
    return jnp.sum(jnp.stack(paper), axis=0), jnp.sum(jnp.stack(exact), axis=0)


def sd_with(
    information: Float[np.ndarray, "size size"],
    prior: Float[np.ndarray, "size size"],
    slopes: Float[np.ndarray, "parameter size"],
) -> Float[np.ndarray, " parameter"]:
    """Standard deviations of parameters, expected from an information matrix and a prior."""
    covariance = np.linalg.inv(information + prior)
    return np.sqrt(np.einsum("pi,ij,pj->p", slopes, covariance, slopes))
