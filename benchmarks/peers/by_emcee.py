"""emcee, as in its tutorials "Fitting a model to data" and "Autocorrelation analysis".

Walkers begin in a small ball around the maximum; the density of half of them is computed in one
call; what two autocorrelation times hold is discarded. Walkers count as chains.
"""

from collections.abc import Iterator

import emcee
import jax
import numpy as np
import scipy.optimize
from posterior import AbstractPeer, Posterior, Round

WALKERS = 32
BALL = 1e-4
STEPS = 1000


class Peer(AbstractPeer):
    packages = ("emcee",)

    def __init__(self, posterior: Posterior) -> None:
        super().__init__(posterior)
        self._log_densities = jax.jit(jax.vmap(posterior.log_density))

    def _look(self, z: np.ndarray) -> np.ndarray:
        found = np.asarray(self._log_densities(z))
        return np.where(np.isfinite(found), found, -np.inf)

    def rounds(self, seed: int) -> Iterator[Round]:
        size, random = self.posterior.size, np.random.default_rng(seed)
        start = np.median(self.posterior.from_prior(seed, 500), axis=0)
        top = scipy.optimize.minimize(
            lambda z: -self._look(np.tile(z, (WALKERS // 2, 1)))[0], start
        )
        sampler = emcee.EnsembleSampler(WALKERS, size, self._look, vectorize=True)
        sampler.random_state = np.random.RandomState(seed).get_state()
        state = top.x + BALL * random.standard_normal((WALKERS, size))
        while True:
            state = sampler.run_mcmc(state, STEPS)
            discarded = int(2.0 * np.max(sampler.get_autocorr_time(tol=0)))
            z = np.moveaxis(sampler.get_chain(discard=discarded), 0, 1)
            evaluations = top.nfev + WALKERS * sampler.iteration
            yield Round(self.posterior.parameters(z), evaluations)
