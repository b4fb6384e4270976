"""scipy: climb from some prior draws, normal approximation at the best end.

The curvature is by finite differences of the exact gradient. There is nothing to wait for: the
draws are as good as the approximation, however many they are.
"""

from collections.abc import Iterator

import jax
import numpy as np
import scipy.optimize
from posterior import CHAINS, AbstractPeer, Posterior, Round

STARTS = 8
DRAWS = 1000


class Peer(AbstractPeer):
    packages = ("scipy",)

    def __init__(self, posterior: Posterior) -> None:
        super().__init__(posterior)
        self._slopes = jax.jit(jax.value_and_grad(lambda z: -posterior.log_density(z)))
        self._asked = 0

    def _look(self, z: np.ndarray) -> tuple[float, np.ndarray]:
        self._asked += 1
        value, gradient = self._slopes(z)
        return float(value), np.asarray(gradient)

    def rounds(self, seed: int) -> Iterator[Round]:
        self._asked = 0
        ends = [
            scipy.optimize.minimize(self._look, start, jac=True, method="BFGS")
            for start in self.posterior.from_prior(seed, STARTS)
        ]
        best = min((end for end in ends if np.isfinite(end.fun)), key=lambda end: end.fun)
        curvature = scipy.optimize.approx_fprime(best.x, lambda z: self._look(z)[1])
        covariance = np.linalg.inv(0.5 * (curvature + curvature.T))
        random = np.random.default_rng(seed)
        z = random.multivariate_normal(best.x, covariance, size=(CHAINS, DRAWS))
        yield Round(self.posterior.parameters(z), self._asked, worth=float(CHAINS * DRAWS))
