"""BlackJAX: NUTS after window adaptation, a device for each chain, as its guide has it."""

import functools
from collections.abc import Callable, Iterator
from typing import Any

import blackjax
import jax
import numpy as np
from posterior import CHAINS, AbstractPeer, Round

WARMUP = 1000
DRAWS = 500


class Peer(AbstractPeer):
    packages = ("blackjax",)

    @functools.cached_property
    def _warm_up(self) -> Callable:
        def one(key: jax.Array, start: jax.Array) -> Any:
            adapting = blackjax.window_adaptation(blackjax.nuts, self.posterior.log_density)
            (state, settings), told = adapting.run(key, start, num_steps=WARMUP)
            return state, settings, told.info.num_integration_steps

        return jax.pmap(one)

    @functools.cached_property
    def _advance(self) -> Callable:
        def one(key: jax.Array, state: Any, settings: dict[str, jax.Array]) -> Any:
            kernel = blackjax.nuts(self.posterior.log_density, **settings).step

            def step(state: Any, key: jax.Array) -> Any:
                state, told = kernel(key, state)
                return state, (state.position, told.num_integration_steps)

            return jax.lax.scan(step, state, jax.random.split(key, DRAWS))

        return jax.pmap(one)

    def rounds(self, seed: int) -> Iterator[Round]:
        key, key_warm_up = jax.random.split(jax.random.key(seed))
        starts = jax.numpy.asarray(self.posterior.from_prior(seed, CHAINS))
        state, settings, steps = self._warm_up(jax.random.split(key_warm_up, CHAINS), starts)
        evaluations, kept = int(np.sum(steps)), []
        while True:
            key, key_round = jax.random.split(key)
            keys = jax.random.split(key_round, CHAINS)
            state, (z, steps) = self._advance(keys, state, settings)
            kept.append(np.asarray(z))
            evaluations += int(np.sum(steps))
            yield Round(self.posterior.parameters(np.concatenate(kept, axis=1)), evaluations)
