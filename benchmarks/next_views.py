"""Views chosen by `next_views` against random and equally spaced ones, with known truth.

    python benchmarks/next_views.py           200 materials
    python benchmarks/next_views.py 50        fewer

Materials and readings are drawn from the model itself: the degree of polarization by the paper's
scene with four facets on the way out, one color. Each material is measured from four views and
fitted; three views are then added by each rule, read once, and all seven fitted together by
weighted draws. For every rule: the mean posterior sd, the root mean square of posterior mean minus
truth, and what of either is left of the four views', each with its Monte Carlo error. `expected` is
the sd that the design promised, before the views were read.
"""

import dataclasses
import os
import platform
import sys
import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from one_material import SCENE

import polar_bayes as pb
from polar_bayes.calibration.runner import draw_captures
from polar_bayes.design.fisher import (
    information_by_view,
    positive_definite,
    prior_precision,
    reading_information,
)
from polar_bayes.design.optimal_design import Selection, fedorov_exchange
from polar_bayes.design.setup import parameter_vector, unconstrain
from polar_bayes.inference.batching import ObservationBatch
from polar_bayes.inference.compiled_model import CompiledModel, compile_layout, layout_key
from polar_bayes.inference.problem_batch import problem_batch
from polar_bayes.inference.program import from_prior
from polar_bayes.inference.request import resolve
from polar_bayes.methods.corrected_laplace import CorrectedLaplace
from polar_bayes.observation.data import observe

NAMES = ("roughness", "subsurface_fraction", "absorption", "refractive_index")
MEASURED = (15.0, 30.0, 45.0, 60.0)
ZENITHS = np.arange(5.0, 86.0, 5.0)
AZIMUTHS = (180.0, 120.0, 60.0)
ADDED = 3
DRAWS = 16


class Fits(NamedTuple):
    """Posterior means and sds by parameter (material,), and draws (material, draw, size)."""

    mean: dict[str, np.ndarray]
    sd: dict[str, np.ndarray]
    z: np.ndarray


def layout() -> xr.Dataset:
    """The measured views, then all candidates, as one capture."""
    rows = [(zenith, 180.0) for zenith in MEASURED]
    rows += [(zenith, azimuth) for azimuth in AZIMUTHS for zenith in ZENITHS]
    view_zenith, view_azimuth = np.array(rows).T
    return xr.Dataset(
        {
            "view_zenith": ("view", view_zenith),
            "view_azimuth": ("view", view_azimuth),
            "light_zenith": ("view", np.full(len(rows), 45.0)),
            "light_azimuth": ("view", np.zeros(len(rows))),
            "dop": ("view", np.full(len(rows), 0.5)),
        },
        attrs={"name": "all views"},
    )


def fit_some(engine: CompiledModel, captures: ObservationBatch, seen: np.ndarray) -> Fits:
    """Fit every capture by the views that it has seen, (material, view)."""
    valid = np.broadcast_to(seen, captures.batched.valid.shape)
    masked = ObservationBatch(
        dataclasses.replace(captures.batched, valid=valid), captures.static, valid.sum(axis=-1)
    )
    count = len(captures)
    mean, sd = ({name: np.full(count, np.nan) for name in NAMES} for _ in range(2))
    few = {name: np.full((count, DRAWS), np.nan) for name in engine.program.supports}
    rng = np.random.default_rng(0)

    batch = problem_batch(engine, masked, np.arange(count), 0)
    for found in CorrectedLaplace(draws=512).fit_batch(batch):
        at, weights = found.at, found.weights
        for name in NAMES if found.draws else ():
            draws = np.asarray(found.draws[name], float)
            mean[name][at] = np.sum(weights * draws, axis=1)
            spread = np.sum(weights * (draws - mean[name][at, None]) ** 2, axis=1)
            sd[name][at] = np.sqrt(spread)
        for row, material in enumerate(at if found.draws else ()):
            share = weights[row] / weights[row].sum()
            some = rng.choice(share.size, DRAWS, p=share)
            for name, kept in few.items():
                kept[material] = np.asarray(found.draws[name])[row, some]
    flat = {name: kept.ravel() for name, kept in few.items()}
    z = unconstrain(engine.program, flat).reshape(count, DRAWS, -1)
    return Fits(mean, sd, z)


class Designer:
    """Chooses views as `next_views` does, from a program that is compiled once."""

    def __init__(self, engine: CompiledModel, data: Any) -> None:
        program = engine.program
        self.size, self.measured = program.size, len(MEASURED)
        self.prior = from_prior(program, jax.random.key(9), 500, data)

        def told(z: Any) -> Any:
            readings = reading_information(program, z, data)
            slopes = jax.jacfwd(lambda z: parameter_vector(program, z, data))(z)
            return information_by_view(readings, data.shape[-1:])["dop"], slopes

        names = sorted(program.parameters(jnp.asarray(self.prior[0]), data))
        self.rows = [names.index(name) for name in NAMES]
        self.told = jax.jit(lambda z: jax.lax.map(told, z))
        self.curvature = jax.jit(lambda z: prior_precision(program, z, data))
        values = jax.vmap(lambda z: parameter_vector(program, z, data))(self.prior)
        self.unit = np.asarray(values).std(axis=0)[self.rows]

    def choose(self, z: np.ndarray, criterion: Any) -> tuple[Selection, np.ndarray]:
        """Return the chosen views, and the expected sds."""
        each, slopes = (np.asarray(x) for x in self.told(jnp.asarray(z)))
        slopes = slopes[:, None, self.rows]
        center = np.asarray(self.curvature(jnp.asarray(np.median(z, axis=0))))
        base = each[:, : self.measured].sum(axis=1) + positive_definite(center, self.prior)
        new = each[:, self.measured :]

        def variances(information: np.ndarray) -> np.ndarray:
            return slopes @ np.linalg.inv(information) @ np.swapaxes(slopes, -1, -2)

        def loss(information: np.ndarray) -> np.ndarray:
            covariance = variances(information) / np.outer(self.unit, self.unit)
            return np.mean(criterion.loss(covariance, NAMES), axis=0)

        alone = np.eye(new.shape[1], dtype=bool)
        chosen = fedorov_exchange(loss, base, new, np.ones(len(alone), bool), alone, ADDED)
        after = variances((base + new[:, chosen.picks].sum(axis=1))[:, None])[:, 0]
        return chosen, np.sqrt(np.diagonal(after, axis1=-2, axis2=-1).mean(axis=0))


def seen_by(picks: np.ndarray, views: int) -> np.ndarray:
    """Measured views and picks, (material, view)."""
    seen = np.zeros((len(picks), views), bool)
    seen[:, : len(MEASURED)] = True
    np.put_along_axis(seen, picks + len(MEASURED), True, axis=1)
    return seen


def main(count: int) -> None:
    begun = time.perf_counter()
    capture, links = layout(), {"dop": pb.links.BetaLink()}
    views = capture.sizes["view"]
    with jax.enable_x64(True):
        request = resolve(capture, "per_material", SCENE, None, links, None, 0, "double")
        data = observe(request.capture)
        key = layout_key(request, request.largest_view_zenith)
        engine = compile_layout(key, request, lambda: data)
        drawn = draw_captures(engine.program, data, np.arange(count), jax.random.key(1))
        before = np.arange(views) < len(MEASURED)
        first = fit_some(engine, drawn.captures, np.tile(before, (count, 1)))
        designer = Designer(engine, data)
        good = np.flatnonzero(np.isfinite(first.z).all(axis=(1, 2)))
        rng = np.random.default_rng(2)
        even = np.linspace(0, ZENITHS.size - 1, ADDED).round().astype(int)
        picks: dict[str, np.ndarray] = {
            "random": np.array(
                [rng.permutation(views - len(MEASURED))[:ADDED] for _ in range(count)]
            ),
            "equally spaced": np.tile(even, (count, 1)),
        }
        promised = {}
        for label, criterion in (
            ("D-optimal", pb.design.DOptimal()),
            ("for the index", pb.design.SingleParameter("refractive_index")),
        ):
            picks[label] = picks["random"].copy()
            promised[label] = np.full((count, len(NAMES)), np.nan)
            for material in good:
                chosen, sds = designer.choose(first.z[material], criterion)
                picks[label][material] = chosen.picks
                promised[label][material] = sds
        found = {"four views": first}
        for label, some in picks.items():
            found[label] = fit_some(engine, drawn.captures, seen_by(some, views))
    print(f"{platform.machine()}, {os.cpu_count()} cores; {count} materials, {ADDED} views added")
    kept = np.all([np.isfinite(fits.mean["roughness"]) for fits in found.values()], axis=0)
    print(f"{kept.sum()} answered by all; {time.perf_counter() - begun:.0f} s")
    for column, name in enumerate(NAMES):
        print(f"\n{name:<20} mean sd         rms error       sd left         expected")
        truth = np.asarray(drawn.truth[name]).reshape(count)
        for label, fits in found.items():
            sd, error = fits.sd[name][kept], (fits.mean[name] - truth)[kept]
            root = np.sqrt(np.mean(error**2))
            of_root = np.std(error**2) / (2.0 * root * np.sqrt(error.size))
            left = sd / found["four views"].sd[name][kept]
            told = promised[label][kept, column].mean() if label in promised else np.nan
            print(f"{label:<20} {show(sd)} {root:.4f} +-{of_root:.4f}  {show(left)} {told:.4f}")


def show(x: np.ndarray) -> str:
    return f"{x.mean():.4f} +-{x.std() / np.sqrt(x.size):.4f} "


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
