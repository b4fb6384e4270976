"""PyMC with nutpie: the density is a JAX function that PyTensor wraps.

nutpie cannot go on with chains that have ended: where one run is not enough, the next one has
twice as many draws, and all of them count.
"""

import functools
from collections.abc import Iterator
from typing import Any

import numpy as np
import nutpie
import pymc as pm
from posterior import CHAINS, AbstractPeer, Round
from pytensor import wrap_jax

DRAWS = 1000
CORES = 2


class Peer(AbstractPeer):
    packages = ("pymc", "nutpie")

    @functools.cached_property
    def _compiled(self) -> Any:
        with pm.Model() as model:
            z = pm.Flat("z", shape=self.posterior.size)
            pm.Potential("log_density", wrap_jax(self.posterior.log_density)(z))
        return nutpie.compile_pymc_model(model, backend="jax", gradient_backend="jax")

    def rounds(self, seed: int) -> Iterator[Round]:
        draws, evaluations = DRAWS, 0
        while True:
            told = nutpie.sample(
                self._compiled,
                draws=draws,
                chains=CHAINS,
                cores=CORES,
                seed=seed,
                progress_bar=False,
            )
            for group in ("warmup_sample_stats", "sample_stats"):
                evaluations += int(np.sum(told[group]["n_steps"]))
            yield Round(self.posterior.parameters(told["posterior"]["z"].values), evaluations)
            draws *= 2
