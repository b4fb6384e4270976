"""Captures drawn from a model: parameters from the prior, readings from the links."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polar_bayes.inference.batching import ObservationBatch
from polar_bayes.inference.compile import JitOnce, LRUCache
from polar_bayes.inference.program import Program, Values
from polar_bayes.observation.data import Observations

_SIMULATORS: LRUCache[Callable] = LRUCache(4)
_READERS: LRUCache[Callable] = LRUCache(4)


class Simulations(NamedTuple):
    """True parameters, and the captures simulated from them."""

    truth: Values
    captures: ObservationBatch


def draw_captures(
    program: Program, data: Observations, numbers: np.ndarray, key: Array
) -> Simulations:
    """Simulate captures by their numbers, with the layout, stated errors and masks of `data`."""
    # Where intensity is recorded, each capture's own brightness sets its noise, and readings at
    # full scale are saturated.
    simulate = _SIMULATORS.of(program, lambda: _simulator(program))
    found = simulate(jnp.asarray(numbers, np.uint32), key, data)
    truth, recorded = jax.tree.map(np.asarray, found)
    return Simulations(truth, _batch(data, recorded))


def redraw_readings(
    program: Program, data: Observations, drawn: Simulations, numbers: np.ndarray, key: Array
) -> Values:
    """Draw the readings of the same true parameters once more."""
    read = _READERS.of(program, lambda: _reader(program))
    captures = drawn.captures
    found = read(np.asarray(numbers, np.uint32), key, data, captures.batched, captures.static)
    return jax.tree.map(np.asarray, found)


def _simulator(program: Program) -> Callable[[Array, Array, Observations], tuple[Values, tuple]]:
    """Compiled: parameters and readings of many captures."""

    def simulate(number: Array, key: Array, data: Observations) -> tuple[Values, tuple]:
        key_truth, key_noise = jax.random.split(jax.random.fold_in(key, number))
        z = program.from_prior(key_truth, data)
        draw = program.describe(key_noise, z, data)
        recorded = _recorded(data, draw.predictive)
        if "intensity" in program.observed:  # the noise of the other readings may follow it
            others = program.describe(key_noise, z, recorded).predictive
            recorded = _recorded(data, {**others, "intensity": draw.predictive["intensity"]})
        return draw.parameters, (recorded.readings, recorded.brightness, recorded.saturated)

    return JitOnce(
        lambda numbers, key, data: jax.lax.map(lambda number: simulate(number, key, data), numbers)
    )


def _reader(program: Program) -> Callable[..., Values]:
    """Compiled: further readings of the true parameters of many captures."""

    def read_all(
        numbers: Array, key: Array, data: Observations, own: Observations, shared: Observations
    ) -> Values:
        def read(at: tuple[Array, Observations]) -> Values:
            number, capture = at
            key_truth, key_noise = jax.random.split(jax.random.fold_in(key, number))
            z = program.from_prior(key_truth, data)
            key_noise = jax.random.fold_in(key_noise, 1)
            return program.describe(key_noise, z, eqx.combine(capture, shared)).predictive

        return jax.lax.map(read, (numbers, own))

    return JitOnce(read_all)


def _recorded(data: Observations, readings: Mapping[str, Any]) -> Observations:
    """A capture with other readings; where a view is not valid, those of `data` remain."""
    valid = {n: jnp.where(data.valid, x, data.readings[n]) for n, x in readings.items()}
    capture = dataclasses.replace(data, readings={**data.readings, **valid})
    if "intensity" not in valid:
        return capture
    return dataclasses.replace(
        capture,
        brightness=jnp.clip(valid["intensity"], 0.0, 1.0),
        saturated=data.valid & (valid["intensity"] >= data.full_scale),
    )


def _batch(data: Observations, recorded: tuple) -> ObservationBatch:
    """Captures as a batch: what was drawn and the masks differ, all else is the same."""

    def drawn(capture: Observations) -> tuple:
        return capture.readings, capture.brightness, capture.saturated, capture.valid

    shape = (len(recorded[1]), *data.shape)
    recorded = jax.tree.map(lambda x: np.broadcast_to(x, shape), recorded)
    valid = np.broadcast_to(np.asarray(data.valid), shape)
    plain = jax.tree.map(np.asarray, data)
    is_drawn = eqx.tree_at(
        drawn, jax.tree.map(lambda _: False, plain), jax.tree.map(lambda _: True, drawn(plain))
    )
    own, shared = eqx.partition(eqx.tree_at(drawn, plain, (*recorded, valid)), is_drawn)
    views = valid.reshape(shape[0], -1, shape[-1]).any(axis=1).sum(axis=-1)
    return ObservationBatch(own, shared, views)
