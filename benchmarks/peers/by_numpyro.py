"""NumPyro with its defaults: NUTS, diagonal metric, warm-up of 1000, a device for each chain."""

from collections.abc import Iterator

import jax
import numpy as np
from numpyro.infer import MCMC, NUTS
from posterior import CHAINS, AbstractPeer, Posterior, Round

WARMUP = 1000
DRAWS = 1000


class Peer(AbstractPeer):
    packages = ("numpyro", "jax")

    def __init__(self, posterior: Posterior) -> None:
        super().__init__(posterior)
        self._sampler = MCMC(
            NUTS(posterior.model),
            num_warmup=WARMUP,
            num_samples=DRAWS,
            num_chains=CHAINS,
            progress_bar=False,
        )

    def rounds(self, seed: int) -> Iterator[Round]:
        sampler, key, evaluations = self._sampler, jax.random.key(seed), 0
        names, kept = tuple(self.posterior.program.supports), []
        sampler.post_warmup_state = None
        sampler.warmup(key, self.posterior.data, collect_warmup=True, extra_fields=("num_steps",))
        evaluations += int(np.sum(sampler.get_extra_fields()["num_steps"]))
        while True:
            sampler.run(key, self.posterior.data, extra_fields=("num_steps",))
            drawn = sampler.get_samples(group_by_chain=True)
            kept.append({name: np.asarray(drawn[name]) for name in names})
            evaluations += int(np.sum(sampler.get_extra_fields()["num_steps"]))
            joined = {n: np.concatenate([part[n] for part in kept], axis=1) for n in names}
            yield Round(joined, evaluations)
            sampler.post_warmup_state = sampler.last_state
            key = sampler.post_warmup_state.rng_key
