"""Where readings stand in what the fits predict: a fresh one, and one that is left out.

In every simulation one entry of each recorded variable is chosen at random among the valid ones:
one, so that simulations stay independent of each other and the test of uniformity holds as it
does for parameters. Readings of one capture share its posterior, and all of them together would
not be uniform although each is.
"""

import functools
import math
from collections.abc import Callable, Iterator, Mapping

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import xarray as xr
from jaxtyping import Array
from numpyro import handlers

from polar_bayes.calibration.files import check_calibration
from polar_bayes.calibration.scores import (
    FALSE_ALARMS,
    is_calibrated,
    share_below,
    uniformity,
    which_stray,
)
from polar_bayes.errors import FitError
from polar_bayes.inference.batching import ObservationBatch, batched, batches
from polar_bayes.inference.program import Program, Values
from polar_bayes.inference.psis import MAX_PARETO_K, smooth
from polar_bayes.inference.result import provenance_of
from polar_bayes.observation.data import Observations

Arrays = dict[str, np.ndarray]

DRAWS = 128
"""Of each fit: its weighted draws, thinned or repeated to so many that weigh the same."""

LOOKED = 32
"""Draws of a fit that are looked at side by side."""

FEW = 4
"""Fits that one call of the program takes."""


class Readings:
    """Probability integral transforms of readings, filled in as fits come; NaN where one failed."""

    # A fresh reading of the same truth, and the posterior's predictions of it, are exchangeable
    # where model, prior and posterior are right. So are a reading that was fitted and what the
    # posterior without it predicts: draws of the whole posterior, each weighed by one over the
    # likelihood of that reading, the weights smoothed. The noise of all readings of a view may
    # follow its intensity, so without an intensity the whole view is left out.
    # Source: Gelman et al. (2013), Bayesian Data Analysis, 3rd ed., section 6.3 (probability
    # integral transforms of readings, and of those left out); Vehtari, Gelman & Gabry (2017), Stat.
    # Comput. 27, 1413-1432 (leaving out by smoothed weights); Saeilynoja, Buerkner & Vehtari
    # (2022), Stat. Comput. 32, 32 (the test).

    def __init__(
        self,
        program: Program,
        captures: ObservationBatch,
        again: Values,
        numbers: np.ndarray,
        seed: int,
    ) -> None:
        self._program, self._captures = program, captures.in_precision(np.float32)
        self._names = tuple(sorted(again))
        count = len(numbers)
        valid = np.asarray(captures.batched.valid).reshape(count, -1)
        chance = np.array(
            [np.random.default_rng([seed, n, 1]).random(1 + 3 * len(again)) for n in numbers]
        )
        self._first, chance = chance[:, 0], chance[:, 1:].reshape(count, 3, -1)
        self.place = {name: _choose(valid, chance[:, 0, at]) for at, name in enumerate(self._names)}
        self._chance = {name: chance[:, 1:, at] for at, name in enumerate(self._names)}
        self._read = {
            name: np.stack(
                [
                    _entry(np.asarray(values, np.float32), self.place[name])
                    for values in (again[name], self._captures.batched.readings[name])
                ],
                axis=-1,
            )
            for name in self._names
        }
        key = jax.random.fold_in(jax.random.key(seed), 2)
        draw_key = jax.vmap(lambda number: jax.random.fold_in(key, number))
        self._keys = np.asarray(jax.random.key_data(draw_key(numbers.astype(np.uint32))))
        self.fresh, self.left_out, self.left_out_k = (
            {name: np.full(count, np.nan) for name in self._names} for _ in range(3)
        )

    def describe(self, at: np.ndarray, parameters: Values, weights: np.ndarray) -> None:
        """Take down some fits."""
        if not at.size:
            return
        even = _resample(weights, self._first[at])
        row = np.arange(at.size)[:, None]
        latent = {
            name: np.asarray(parameters[name], np.float32)[row, even]
            for name in self._program.supports
        }
        predicted, left = self._look(at, latent)
        same = np.full((at.size, DRAWS), 1.0 / DRAWS)
        for name in self._names:
            known = self.place[name][at] >= 0
            read, chance = self._read[name][at], self._chance[name][at]
            found, pareto_k = smooth(-np.asarray(left[name], float))
            told = (
                share_below(predicted[name], same, read[:, 0], chance[:, 0]),
                share_below(predicted[name], found, read[:, 1], chance[:, 1]),
                pareto_k,
            )
            kept = (self.fresh, self.left_out, self.left_out_k)
            for whole, part in zip(kept, told, strict=True):
                whole[name][at] = np.where(known, part, np.nan)

    def _look(self, at: np.ndarray, latent: Values) -> tuple[Arrays, Arrays]:
        """Run the program on all fits, a few at a time."""
        looking = _looking(self._program, self._names)
        shared = jax.tree.map(jnp.asarray, self._captures.static)
        place = {name: np.maximum(x[at], 0).astype(np.int32) for name, x in self.place.items()}
        states = (place, latent, self._keys[at])
        parts: list = []
        for index in batches(at.size, FEW):
            wanted = np.int32(min(FEW, at.size - len(parts) * FEW))
            own = self._captures.take(at[index])
            given = jax.tree.map(lambda x, i=index: x[i], states)
            with jax.enable_x64(False):
                found = looking(wanted, own, shared, *given)
            parts.append(jax.tree.map(np.asarray, found))
        return jax.tree.map(lambda *x: np.concatenate(x)[: at.size], *parts)


def why_untold(
    program: Program,
    generative_program: Program,
    data: Observations,
    given: Mapping[str, tuple[int, ...]],
) -> str:
    """Why readings of this model cannot be ranked."""
    missing = [name for name in program.supports if name not in given]
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


@functools.lru_cache(maxsize=4)
def _looking(program: Program, names: tuple[str, ...]) -> Callable:
    """What draws of one fit predict at the chosen entries, and how likely they hold them."""

    def look(data: Observations, place: dict, latent: Values, key: Array) -> tuple[Values, Values]:
        keys = jax.random.split(key, DRAWS)

        def one(given: tuple[Values, Array]) -> tuple[Values, Values]:
            values, key = given
            fixed = handlers.substitute(program.model, data=values)
            trace = handlers.trace(handlers.seed(fixed, key)).get_trace(data)
            likely = {n: trace[n]["fn"].log_prob(trace[n]["value"]) for n in program.observed}
            own = dict(zip(names, jax.random.split(key, len(names)), strict=True))
            predicted = {n: trace[n]["fn"].sample(own[n]).reshape(-1)[place[n]] for n in names}
            left = {
                # The noise of a view's other readings may follow its intensity.
                n: sum(
                    likely[m].reshape(-1)[place[n]]
                    for m in (program.observed if n == "intensity" else (n,))
                )
                for n in names
            }
            return predicted, left

        return jax.lax.map(one, (latent, keys), batch_size=LOOKED)

    return batched(look, lanes=1)


def _choose(valid: np.ndarray, chance: np.ndarray) -> np.ndarray:
    """The number of one valid entry of each row, all equally likely; -1 where there is none."""
    count = valid.sum(axis=-1)
    rank = np.minimum((chance * count).astype(int), count - 1)
    place = np.argmax(np.cumsum(valid, axis=-1) > rank[:, None], axis=-1)
    return np.where(count > 0, place, -1)


def _entry(values: np.ndarray, place: np.ndarray) -> np.ndarray:
    flat = values.reshape(len(values), -1)
    return flat[np.arange(len(flat)), np.maximum(place, 0)]


def _resample(weights: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Numbers of draws that weigh the same, by systematic resampling. (fit, DRAWS)."""
    at = (np.arange(DRAWS) + first[:, None]) / DRAWS
    below = np.cumsum(weights, axis=-1)
    found = [np.searchsorted(*row, side="right") for row in zip(below, at, strict=True)]
    return np.minimum(found, weights.shape[-1] - 1)


# --- What a calibration says of readings: a small table, and in words -----------------------------


TESTS = {"predictive_pit": "fresh", "loo_pit": "left out"}
"""What the groups of a calibration rank, in a word."""


def holds_readings(calibration: xr.DataTree) -> bool:
    """Whether readings were ranked in a calibration."""
    return set(TESTS) <= set(calibration.children)


def calibration_readings(calibration: xr.DataTree) -> pd.DataFrame:
    """Two rows for each reading: a fresh one, and one that is left out of the fit.

    Where model, prior, links and method are right, both stand uniformly among what the fits
    predict. One entry is looked at in each simulation, so that simulations are independent and the
    test that `calibration_table` makes of parameters holds here as it does there.

    Args:
        calibration: What `polar_bayes.calibrate` returns.

    Returns:
        Columns `reading` and `test` ("fresh" or "left out"); `answered` and `failed` (fits);
        `p_value` of uniform ranks; `rank_mean` (above a half predictions are too low) and
        `rank_spread` (above one they are too narrow, below too wide); `untrusted`, how many of
        those left out have a Pareto k above 0.7 (of fresh ones none is needed, NaN): where they
        are many, the weights are what strays.

    Raises:
        FitError: It is no calibration, or readings were not ranked.

    Source:
        See `polar_bayes.calibration.predictive.Readings`.
    """
    check_calibration(calibration)
    if not holds_readings(calibration):
        raise FitError(
            "it holds no ranks of readings",
            where="calibration",
            hint="give what polar_bayes.calibrate returns with readings=True",
        )
    rows = {label: row for label, row, _ in _rows(calibration)}
    return pd.DataFrame.from_dict(rows, orient="index")


def reading_ranks(calibration: xr.DataTree) -> dict[str, np.ndarray]:
    """Ranks of readings by their label in `calibration_readings`, NaN where a fit failed."""
    return {label: ranks for label, _, ranks in _rows(calibration)}


def readings_verdict(calibration: xr.DataTree) -> list[str]:
    """What a calibration says of readings, in sentences."""
    if not holds_readings(calibration):
        why = provenance_of(calibration).get("readings_told", "")
        return [f"Readings were not ranked: {why}."] if why else []
    table = calibration_readings(calibration)
    passed = is_calibrated(table)
    names = list(dict.fromkeys(table["reading"]))
    said = [
        f"Readings ({', '.join(names)}; fresh ones and ones left out) "
        f"{'pass' if passed else 'fail'} a joint test of their own that a right model fails "
        f"{FALSE_ALARMS:.0%} of the time."
    ]
    said += which_stray(table, how_predictions_stray)
    for label, row in table.iterrows():
        if row["untrusted"] > 0:
            said.append(
                f"{label}: in {int(row['untrusted'])} of {int(row['answered'])} fits the weights "
                f"without it say little (Pareto k above {MAX_PARETO_K:g})."
            )
    return said


def how_predictions_stray(row: pd.Series) -> str:
    """In which way the ranks of a reading stray."""
    count = row["answered"]
    if count < 2:
        return "fewer than two fits have an answer"
    shift = (row["rank_mean"] - 0.5) * math.sqrt(12.0 * count)
    stretch = (row["rank_spread"] - 1.0) * math.sqrt(5.0 * count)  # sd of the spread: 1/sqrt(5 n)
    ways = []
    if abs(shift) > 2.5:
        ways.append(f"predictions are too {'low' if shift > 0.0 else 'high'}")
    if abs(stretch) > 2.5:
        ways.append(f"predictions are too {'narrow' if stretch > 0.0 else 'wide'}")
    return " and ".join(ways) or "the ranks have another shape than the uniform"


def _rows(calibration: xr.DataTree) -> Iterator[tuple[str, dict, np.ndarray]]:
    """Label, row of the table, and ranks."""
    chosen = calibration["readings"].to_dataset()
    for name in map(str, calibration["predictive_pit"].data_vars):
        for group, test in TESTS.items():
            pit = calibration[group][name].to_numpy()
            answered = pit[np.isfinite(pit)]
            told = uniformity(answered) if answered.size > 1 else (math.nan,) * 3
            untrusted = math.nan
            if group == "loo_pit":
                pareto_k = chosen[f"{name}_pareto_k"].to_numpy()
                untrusted = float(np.sum(pareto_k[np.isfinite(pit)] > MAX_PARETO_K))
            row = {
                "reading": name,
                "test": test,
                "answered": answered.size,
                "failed": pit.size - answered.size,
                **dict(zip(("p_value", "rank_mean", "rank_spread"), told, strict=True)),
                "untrusted": untrusted,
            }
            yield f"{name}, {test}", row, pit
