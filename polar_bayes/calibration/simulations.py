"""Captures drawn from a model itself: parameters from the prior, readings from the links."""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polar_bayes.inference.batching import ObservationBatch
from polar_bayes.inference.compile import JitByShape
from polar_bayes.inference.program import Program, Values
from polar_bayes.observation.data import Observations


class Simulations(NamedTuple):
    """Truths and what was recorded of them."""

    truth: Values
    captures: ObservationBatch


def draw_captures(program: Program, data: Observations, count: int, key: Array) -> Simulations:
    """Draw captures of one layout."""
    # Directions, stated errors and masks are those of `data`. Where intensity is recorded, each
    # capture's own brightness sets its noise, and readings at full scale are saturated.
    return draw_numbered(program, data, np.arange(count), key)


def draw_numbered(
    program: Program, data: Observations, numbers: np.ndarray, key: Array
) -> Simulations:
    """Draw the captures of some numbers."""
    told = _drawing(program)(jnp.asarray(numbers, np.uint32), key, data)
    truth, parts = jax.tree.map(np.asarray, told)
    return Simulations(truth, _in_a_row(data, parts))


def draw_fresh(
    program: Program, data: Observations, drawn: Simulations, numbers: np.ndarray, key: Array
) -> Values:
    """Read the same truths once more."""
    captures = drawn.captures
    found = _reading_again(program)(
        np.asarray(numbers, np.uint32), key, data, captures.batched, captures.static
    )
    return jax.tree.map(np.asarray, found)


@functools.lru_cache(maxsize=4)
def _reading_again(program: Program) -> Callable[..., Values]:
    """Fresh readings of many truths, compiled once for a program."""

    def read(
        number: Array, key: Array, data: Observations, own: Observations, shared: Observations
    ) -> Values:
        key_truth, key_noise = jax.random.split(jax.random.fold_in(key, number))
        z = program.from_prior(key_truth, data)
        told = program.describe(jax.random.fold_in(key_noise, 1), z, eqx.combine(own, shared))
        return told.predictive

    def read_all(
        numbers: Array, key: Array, data: Observations, own: Observations, shared: Observations
    ) -> Values:
        return jax.lax.map(lambda at: read(at[0], key, data, at[1], shared), (numbers, own))

    return JitByShape(read_all)


@functools.lru_cache(maxsize=4)
def _drawing(program: Program) -> Callable[[Array, Array, Observations], tuple[Values, tuple]]:
    """The story of many captures, compiled once for a program."""

    def simulate(number: Array, key: Array, data: Observations) -> tuple[Values, tuple]:
        key_truth, key_noise = jax.random.split(jax.random.fold_in(key, number))
        z = program.from_prior(key_truth, data)
        told = program.describe(key_noise, z, data)
        seen = _recorded(data, told.predictive)
        if "intensity" in program.observed:  # the noise of the other readings may follow it
            again = program.describe(key_noise, z, seen).predictive
            seen = _recorded(data, {**again, "intensity": told.predictive["intensity"]})
        return told.parameters, (seen.readings, seen.brightness, seen.saturated)

    return JitByShape(
        lambda numbers, key, data: jax.lax.map(lambda at: simulate(at, key, data), numbers)
    )


def _recorded(data: Observations, readings: Mapping[str, Any]) -> Observations:
    """A capture with other readings; harmless numbers stay where a view is not valid."""
    kept = {n: jnp.where(data.valid, x, data.readings[n]) for n, x in readings.items()}
    whole = dataclasses.replace(data, readings={**data.readings, **kept})
    if "intensity" not in kept:
        return whole
    return dataclasses.replace(
        whole,
        brightness=jnp.clip(kept["intensity"], 0.0, 1.0),
        saturated=data.valid & (kept["intensity"] >= data.full_scale),
    )


def _in_a_row(data: Observations, parts: tuple) -> ObservationBatch:
    """What was drawn is each capture's own, all else is shared."""

    def drawn(capture: Observations) -> tuple:
        return capture.readings, capture.brightness, capture.saturated, capture.valid

    count = len(parts[1])
    parts = jax.tree.map(lambda x: np.broadcast_to(x, (count, *data.shape)), parts)
    valid = np.broadcast_to(np.asarray(data.valid), (count, *data.shape))
    plain = jax.tree.map(np.asarray, data)
    whole = eqx.tree_at(drawn, plain, (*parts, valid))
    is_own = eqx.tree_at(
        drawn,
        jax.tree.map(lambda _: False, plain),
        jax.tree.map(lambda _: True, drawn(plain)),
    )
    own, shared = eqx.partition(whole, is_own)
    views = valid.reshape(count, -1, data.shape[-1]).any(axis=1).sum(axis=-1)
    return ObservationBatch(own, shared, views)
