"""What a compiled program costs: its operations, its compilation, and its time."""

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

ROUNDS = 40
"""How often each program is timed."""

CALLS = 3
"""How many calls make one timing."""


@dataclasses.dataclass(frozen=True)
class Compiled:
    """A compiled program and what it took to make it."""

    call: Callable[..., Any]
    operations: float
    compile_seconds: float


@dataclasses.dataclass(frozen=True)
class Cost:
    """What a program costs."""

    operations: float
    compile_seconds: float
    run_seconds: float


def compile_and_count(function: Callable[..., Any], *arguments: Any) -> Compiled:
    """Compile a function for arguments of these shapes."""
    begin = time.perf_counter()
    program = jax.jit(function).lower(*arguments).compile()
    seconds = time.perf_counter() - begin
    counted = program.cost_analysis() or {}
    operations = sum(counted.get(kind, math.nan) for kind in ("flops", "transcendentals"))
    return Compiled(program, float(operations), seconds)


def run_seconds(calls: Sequence[Callable[[], Any]]) -> list[float]:
    """Time of each call at its fastest, results awaited."""
    # The calls take turns, so that a machine that slows down slows them all alike; the fastest
    # round is the one that other programs disturbed least.
    rounds = [[_seconds(call) for call in calls] for _ in range(ROUNDS)]
    return [float(fastest) for fastest in np.min(rounds, axis=0)]


def _seconds(call: Callable[[], Any]) -> float:
    begin = time.perf_counter()
    for _ in range(CALLS):
        jax.block_until_ready(call())
    return (time.perf_counter() - begin) / CALLS
