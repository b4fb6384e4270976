"""Least squares, the normal approximation, weighted draws and NUTS on the same simulations."""

import time
from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array
from paper_study import (
    NAMES,
    PAPER,
    NormalScores,
    Population,
    Study,
    header,
    layout,
    mean_of,
    row,
    score,
    scores,
    share_of,
    told,
)

import polar_bayes as pb
from polar_bayes.calibration.runner import Simulations, draw_captures
from polar_bayes.inference.program import Program, compile_program, from_prior
from polar_bayes.inference.request import resolve
from polar_bayes.methods.least_squares import Estimate, estimate
from polar_bayes.observation.data import observe

USUAL = ("laplace", "importance", "nuts")
NORMAL_95 = 1.959964


class Found(NamedTuple):
    """Least squares of many captures by parameter, (simulation,).

    Args:
        value: Estimates.
        error: Standard errors, infinite where the readings do not determine the value.
        converged: Where the solver met its tolerance.
    """

    value: dict[str, np.ndarray]
    error: dict[str, np.ndarray]
    converged: np.ndarray


class LeastSquares:
    """The deterministic fit, of all captures in one compiled program."""

    def __init__(self, capture: xr.Dataset, truth: Mapping[str, Any] | None, study: Study) -> None:
        generative_program, fitted = (
            resolve(
                capture,
                model,
                PAPER,
                None,
                None,
                None,
                study.seed,
                "double",
            )
            for model in ((truth or {}).get("model", "per_material"), "per_material")
        )
        with jax.enable_x64(True):
            data = observe(fitted.capture)
            self.program = compile_program(fitted.bind(), data)
            story = compile_program(generative_program.bind(), data)
            key = jax.random.key(study.seed)
            # The captures that `calibrate` draws for this seed.
            numbers, own = np.arange(study.simulations), jax.random.fold_in(key, 1)
            self.drawn = draw_captures(story, data, numbers, own)
            starts = from_prior(self.program, key, pb.methods.Point().starts, data)
        self._run = jax.jit(lambda own, shared: _each(self.program, own, shared, starts))

    def __call__(self) -> Found:
        """All estimates with their standard errors."""
        captures = self.drawn.captures
        with jax.enable_x64(True):
            found, slopes = self._run(captures.batched, captures.static)
        values, error = {}, {}
        variance = np.diagonal(np.asarray(found.covariance), axis1=1, axis2=2)
        places = self.program.unravel(jnp.arange(self.program.size))
        for name in NAMES:
            at = int(places[name])
            values[name] = np.asarray(slopes[1][name])
            error[name] = np.abs(np.asarray(slopes[0][name])[:, at]) * np.sqrt(variance[:, at])
        return Found(values, error, np.asarray(found.converged))


def _each(program: Program, own: Any, shared: Any, starts: Array) -> tuple[Estimate, tuple]:
    def fit(own: Any) -> tuple[Estimate, tuple]:
        found = estimate(program, eqx.combine(own, shared), starts)
        return found, (jax.jacfwd(program.constrain)(found.z), program.constrain(found.z))

    return jax.lax.map(fit, own)


def scores_of(found: Found, truth: np.ndarray, name: str) -> NormalScores:
    """Scores of least squares; fits that did not converge have no answer."""
    value = np.where(found.converged, found.value[name], np.nan)
    reach = NORMAL_95 * np.where(found.converged, found.error[name], np.nan)
    return score(value, value - reach, value + reach, truth)


def check_same(drawn: Simulations, tree: xr.DataTree) -> None:
    """Refuse to compare fits of different simulations."""
    for name in NAMES:
        if not np.allclose(drawn.truth[name], tree["truth"][name], rtol=1e-10):
            raise SystemExit("least squares and calibrate drew different simulations")


def compared(study: Study) -> tuple[str, ...]:
    """Return the methods of every comparison, and the selected one."""
    return tuple(dict.fromkeys((*USUAL, study.method)))


def methods(study: Study) -> None:
    """Accuracy, coverage, width and time of every method; the second run is timed."""
    capture, truth = layout(), {"model": Population()}
    squares = LeastSquares(capture, truth, study)
    squares()
    begun = time.perf_counter()
    found = squares()
    seconds = {"least squares": time.perf_counter() - begun}
    count = study.simulations
    lost = {"least squares": f"{np.sum(~found.converged)} of {count} without an answer"}
    by = {
        name: {"least squares": scores_of(found, squares.drawn.truth[name], name)} for name in NAMES
    }
    for method in compared(study):
        for _ in range(2):
            begun = time.perf_counter()
            tree = study.calibrate(capture, method=method, truth=truth)
            seconds[method] = time.perf_counter() - begun
        check_same(squares.drawn, tree)
        lost[method] = told([tree])
        for name in NAMES:
            by[name][method] = scores(tree, name)
    header("parameter", "method", "MAE", "95% holds", "mean width")
    for name, rows in by.items():
        for method, own in rows.items():
            row(name, method, mean_of(own.error), share_of(own.held), mean_of(own.width))
    print()
    header("method", "seconds a fit", "fits")
    for method, each in seconds.items():
        row(method, f"{each / count:.3f}", lost[method])
