"""bumps: the simplex, then DREAM from there with its default population and burn-in.

Its parameters need ranges: ours hold all of the prior draws and as much again. Members of the
population count as chains.
"""

from collections.abc import Iterator

import jax
import numpy as np
from bumps.fitproblem import FitProblem
from bumps.fitters import fit
from bumps.pdfwrapper import VectorPDF
from posterior import AbstractPeer, Posterior, Round

SAMPLES = 20_000
BURN = 100
WORST = 1e10


class Peer(AbstractPeer):
    packages = ("bumps",)

    def __init__(self, posterior: Posterior) -> None:
        super().__init__(posterior)
        self._density = jax.jit(posterior.log_density)
        self._asked = 0

    def _look(self, z: np.ndarray) -> float:
        self._asked += 1
        value = -float(self._density(z))
        return value if np.isfinite(value) else WORST

    def rounds(self, seed: int) -> Iterator[Round]:
        self._asked = 0
        drawn = self.posterior.from_prior(seed, 500)
        center, low, high = np.median(drawn, axis=0), drawn.min(axis=0), drawn.max(axis=0)
        model = VectorPDF(self._look, center)
        half = high - low
        for parameter, lowest, highest in zip(
            model.parameters().values(), low - half / 2, high + half / 2, strict=True
        ):
            parameter.range(lowest, highest)
        problem = FitProblem(model)
        np.random.seed(seed)  # noqa: NPY002, what bumps draws from
        problem.setp(fit(problem, method="amoeba").x)
        found, samples = None, SAMPLES
        while True:
            burn = BURN if found is None else 0
            found = fit(problem, method="dream", samples=samples, burn=burn, resume=found)
            _, z, _ = found.state.chains()
            yield Round(self.posterior.parameters(np.moveaxis(z, 0, 1)), self._asked)
            samples *= 2
