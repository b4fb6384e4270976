"""Predictive checks of a calibration: PIT of a replicated reading and of one that is left out.

In every simulation one entry of each recorded variable is chosen at random among the valid ones.
With one entry, simulations are independent of each other, which the test of uniformity needs;
readings of one capture share its posterior.

A replicated reading of the same truth, and the posterior's predictions of it, are exchangeable
where model, prior and posterior are right. So are a reading that was fitted and what the posterior
without it predicts: draws of the whole posterior, each weighted by one over the likelihood of that
reading, the weights Pareto-smoothed.

Source: Gelman et al. (2013), Bayesian Data Analysis, 3rd ed., section 6.3 (PIT of replicated
readings and of those left out); Vehtari, Gelman & Gabry (2017), Stat. Comput. 27, 1413-1432
(leave-one-out by smoothed weights).
"""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpyro import handlers

from polar_bayes.calibration.scores import randomized_pit
from polar_bayes.inference.batching import batched
from polar_bayes.inference.compiled_model import CompiledModel
from polar_bayes.inference.problem_batch import SMALL_BATCH, ProblemBatch
from polar_bayes.inference.program import Program, Values
from polar_bayes.numerics.compile import JitOnce
from polar_bayes.numerics.psis import smooth, systematic_resample
from polar_bayes.observation.data import Observations

Arrays = dict[str, np.ndarray]

DRAWS = 128
"""Equally weighted draws to which the weighted draws of each fit are resampled."""

DRAW_BATCH = 32
"""Draws of one fit that are evaluated together."""


class PredictivePit:
    """PIT values of readings, filled in fit by fit; NaN where a fit has failed."""

    def __init__(self, batch: ProblemBatch, replicated: Values, numbers: np.ndarray) -> None:
        self._batch, seed = batch, batch.seed
        self._names = tuple(sorted(replicated))
        count = len(numbers)
        valid = np.asarray(batch.pixels.batched.valid).reshape(count, -1)
        uniform = np.array(
            [np.random.default_rng([seed, n, 1]).random(1 + 3 * len(replicated)) for n in numbers]
        )
        self._first, uniform = uniform[:, 0], uniform[:, 1:].reshape(count, 3, -1)
        self.entry = {n: _choose(valid, uniform[:, 0, at]) for at, n in enumerate(self._names)}
        self._uniform = {n: uniform[:, 1:, at] for at, n in enumerate(self._names)}
        fitted = batch.pixels.batched.readings
        self._observed = {
            n: np.stack([_take(x[n], self.entry[n]) for x in (replicated, fitted)], axis=-1)
            for n in self._names
        }
        key = jax.random.fold_in(jax.random.key(seed), 2)
        draw_key = jax.vmap(lambda number: jax.random.fold_in(key, number))
        self._keys = np.asarray(jax.random.key_data(draw_key(numbers.astype(np.uint32))))
        self.fresh, self.left_out, self.left_out_k = (
            {name: np.full(count, np.nan) for name in self._names} for _ in range(3)
        )

    def describe(self, at: np.ndarray, parameters: Values, weights: np.ndarray) -> None:
        """Fill in the fits at some positions from their weighted draws."""
        if not at.size:
            return
        firsts = zip(weights, self._first[at], strict=True)
        chosen = np.stack([systematic_resample(own, DRAWS, first) for own, first in firsts])
        rows = np.arange(at.size)[:, None]
        latent = {
            name: np.asarray(parameters[name], np.float32)[rows, chosen]
            for name in self._batch.engine.program.supports
        }
        predicted, log_likelihood = self._predict(at, latent)
        equal = np.full((at.size, DRAWS), 1.0 / DRAWS)
        for name in self._names:
            is_valid = self.entry[name][at] >= 0
            observed, uniform = self._observed[name][at], self._uniform[name][at]
            without, pareto_k = smooth(-np.asarray(log_likelihood[name], float))
            found = (
                (self.fresh, randomized_pit(predicted[name], equal, observed[:, 0], uniform[:, 0])),
                (
                    self.left_out,
                    # Weights without a reading select predictions, which are as many as before.
                    randomized_pit(predicted[name], without, observed[:, 1], uniform[:, 1], DRAWS),
                ),
                (self.left_out_k, pareto_k),
            )
            for values, part in found:
                values[name][at] = np.where(is_valid, part, np.nan)

    def _predict(self, at: np.ndarray, latent: Values) -> tuple[Arrays, Arrays]:
        """Predict the chosen entries; return predictions and log likelihoods, each (fit, draw)."""
        entry = {name: np.maximum(x[at], 0).astype(np.int32) for name, x in self.entry.items()}
        states = (entry, latent, self._keys[at])
        some = self._batch.subset(at)
        return some.run(_predictor, self._names, *states, batch=SMALL_BATCH, single=True)


def unranked_reason(
    program: Program,
    generative_program: Program,
    data: Observations,
    parameters: Mapping[str, tuple[int, ...]],
) -> str:
    """Explain why readings of this model cannot be ranked; empty where they can."""
    missing = [name for name in program.supports if name not in parameters]
    if missing:
        return f"draws do not hold {', '.join(missing)}, without which the model predicts nothing"
    if not set(program.observed) & set(generative_program.observed):
        return "what is simulated and what is fitted read different variables"
    size = int(np.prod(data.shape))
    for each in (program, generative_program):
        shape = jax.eval_shape(
            lambda z, each=each: each.describe(jax.random.key(0), z, data), jnp.zeros(each.size)
        )
        for name in each.observed:
            if {shape.log_likelihood[name].size, shape.predictive[name].size} != {size}:
                return f"entries of {name} do not scatter by themselves"
    return ""


def _predictor(engine: CompiledModel, names: tuple[str, ...]) -> JitOnce:
    """Compile the predictions of chosen entries from draws of one fit, with log likelihoods."""
    program = engine.single_program

    def predict(
        data: Observations, entry: dict, latent: Values, key: Array
    ) -> tuple[Values, Values]:
        def of_draw(draw: tuple[Values, Array]) -> tuple[Values, Values]:
            values, key = draw
            fixed = handlers.substitute(program.model, data=values)
            trace = handlers.trace(handlers.seed(fixed, key)).get_trace(data)
            density = {n: trace[n]["fn"].log_prob(trace[n]["value"]) for n in program.observed}
            keys = dict(zip(names, jax.random.split(key, len(names)), strict=True))
            predicted = {n: trace[n]["fn"].sample(keys[n]).reshape(-1)[entry[n]] for n in names}
            log_likelihood = {
                # The noise of a view's other readings may follow its intensity, so without an
                # intensity the whole view is left out.
                n: sum(
                    density[m].reshape(-1)[entry[n]]
                    for m in (program.observed if n == "intensity" else (n,))
                )
                for n in names
            }
            return predicted, log_likelihood

        keys = jax.random.split(key, DRAWS)
        return jax.lax.map(of_draw, (latent, keys), batch_size=DRAW_BATCH)

    return batched(predict, lanes=1)


def _choose(valid: np.ndarray, uniform: np.ndarray) -> np.ndarray:
    """Return the index of a random valid entry of each row; -1 where a row has none."""
    count = valid.sum(axis=-1)
    rank = np.minimum((uniform * count).astype(int), count - 1)
    entry = np.argmax(np.cumsum(valid, axis=-1) > rank[:, None], axis=-1)
    return np.where(count > 0, entry, -1)


def _take(values: Array | np.ndarray, entry: np.ndarray) -> np.ndarray:
    flat = np.asarray(values, np.float32).reshape(len(values), -1)
    return flat[np.arange(len(flat)), np.maximum(entry, 0)]
