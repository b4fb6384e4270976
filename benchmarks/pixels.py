"""Pixels per second of this package and its peers in one run, with the accuracy of each.

    python benchmarks/pixels.py            40 views, four parameters
    python benchmarks/pixels.py 100000     the same, with so many pixels of ours

The image is of the paper's scene with four facets on the way out of the body, read by the degree of
polarization with known normal noise. Every peer gets the same compiled model; each is timed after
compilation, on as many pixels as it can do in some seconds.

    scipy      least_squares in a loop, its own differences, normal priors of the coordinates
    guide      AutoLaplaceApproximation in a loop: BFGS, then its Hessian; compiled once
    newton     vmap of 25 damped Newton steps with full Hessians and jax.numpy.linalg
    ours       `find_modes`: mode and covariance, on all cores; the others compute a pixel at a time
    single     the same in single precision
    weighed    `fit_pixels`: all of it, drawn from, weighed and summarized, on all cores

The second table is the roofline: what one look at a pixel costs in operations and bytes, as the
compiler counts them, and how much of the machine it uses. The peak is that of a loop of fused
multiply-adds that stays in registers, the bandwidth that of a copy; both of one core, same run.
"""

import dataclasses
import os
import platform
import sys
import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
import xarray as xr
from numpyro import handlers, optim
from numpyro.infer import SVI, Trace_ELBO
from numpyro.infer.autoguide import AutoLaplaceApproximation

import polar_bayes as pb
from polar_bayes.inference.batch_modes import ModeSearch, find_modes_from, find_starts
from polar_bayes.inference.batching import LANES, ObservationBatch
from polar_bayes.inference.compiled_model import CompiledModel
from polar_bayes.inference.problem_batch import ProblemBatch
from polar_bayes.inference.scoring import exact_derivatives, scoring_derivatives
from polar_bayes.maps.fit_map import mask_missing, plan_map
from polar_bayes.models.per_material import per_material
from polar_bayes.observation.data import Observations

NOISE, VIEWS, STEPS = 0.01, 40, 25
RANGES = {
    "roughness": (0.08, 0.35),
    "subsurface_fraction": (0.2, 0.7),
    "absorption": (0.1, 0.8),
    "refractive_index": (1.35, 1.6),
}
FEW_FACETS = pb.physics.FacetQuadrature(along=2, across=2)
PAPER = pb.setups.SETUPS["paper"].scene
SCENE = dataclasses.replace(
    PAPER, surface=pb.RoughSurface(pb.Beckmann(), pb.PointSource(), FEW_FACETS)
)
ASKED = {
    "model": handlers.condition(per_material, data={"normal_scale": NOISE}),
    "scene": SCENE,
    "links": pb.links.NormalLink(),
}


def image(side: int) -> xr.Dataset:
    """A square image whose pixels have nothing in common but the directions."""
    rng = np.random.default_rng(3)
    view = pb.simulate("leaf", seed=1, protocol=pb.simulation.Protocol(views=VIEWS, wavelengths=()))
    angles = [f"{body}_{angle}" for body in ("view", "light") for angle in ("zenith", "azimuth")]
    truth = {name: rng.uniform(*ends, (side, side)) for name, ends in RANGES.items()}
    with jax.enable_x64(True):
        geometry = pb.Geometry.from_degrees(**{name: view[name].to_numpy() for name in angles})
        readings = np.asarray(jax.jit(lambda t: SCENE.predict(t, geometry)["dop"])(truth))
    readings = np.clip(readings + NOISE * rng.normal(size=readings.shape), 0.0, 1.0)
    return view[angles].assign(dop=(("y", "x", "view"), readings))


def rate(count: int, run: Callable[[], Any]) -> tuple[float, Any]:
    """Return pixels per second of the second run, and its result."""
    run()
    start = time.perf_counter()
    found = run()
    return count / (time.perf_counter() - start), found


def find_modes(batch: ProblemBatch) -> ModeSearch:
    """The mode of every pixel, from the best of its starts."""
    return find_modes_from(batch, find_starts(batch)[:, 0])


def by_scipy(engine: CompiledModel, pixels: ObservationBatch, count: int) -> np.ndarray:
    residuals = jax.jit(
        lambda z, data: jnp.concatenate([engine.program.residuals(z, data)["dop"] / NOISE, z])
    )
    found = []
    for i in range(count):
        data = pixels.pixel(i)
        found.append(scipy.optimize.least_squares(residuals, np.zeros(4), args=(data,)).x)
    return np.stack(found)


def by_guide(engine: CompiledModel, pixels: ObservationBatch, count: int) -> Any:
    guide = AutoLaplaceApproximation(engine.program.model)
    search = SVI(engine.program.model, guide, optim.Minimize(), Trace_ELBO())
    state = search.init(jax.random.key(0), pixels.pixel(0))

    @jax.jit
    def fit(data: Observations) -> Any:
        found, _ = search.update(state, data)
        parameters = search.get_params(found)
        return parameters["auto_loc"], guide.get_transform(parameters).scale_tril

    return lambda: [jax.block_until_ready(fit(pixels.pixel(i))) for i in range(count)]


def by_newton(engine: CompiledModel, pixels: ObservationBatch, count: int) -> Callable:
    def fit(own: Observations, shared: Observations) -> jax.Array:
        data = eqx.combine(own, shared)

        def potential(z: jax.Array) -> jax.Array:
            return engine.program.potential(z, data)

        def step(_: int, state: tuple) -> tuple:
            z, damping = state
            gradient, hessian = jax.grad(potential)(z), jax.hessian(potential)(z)
            bend = hessian + damping * jnp.diag(jnp.abs(jnp.diagonal(hessian)))
            tried = z - jnp.linalg.solve(bend, gradient)
            better = potential(tried) < potential(z)
            return jnp.where(better, tried, z), jnp.where(better, damping / 10, damping * 10)

        return jax.lax.fori_loop(0, STEPS, step, (jnp.zeros(4), jnp.asarray(1e-2)))[0]

    compiled = jax.jit(jax.vmap(fit, in_axes=(0, None)))
    some = pixels.subset(np.arange(count))
    return lambda: jax.block_until_ready(compiled(some.batched, some.static))


def heights(engine: CompiledModel, pixels: ObservationBatch, z: np.ndarray) -> np.ndarray:
    """The potential of the first pixels at some places."""
    some = pixels.subset(np.arange(len(z)))
    with jax.enable_x64(True):

        def height(own: Observations, z: jax.Array) -> jax.Array:
            return engine.program.potential(z, eqx.combine(own, some.static))

        return np.asarray(jax.jit(jax.vmap(height))(some.batched, jnp.asarray(z)))


def fastest(function: Callable, *given: Any) -> float:
    """Seconds of the fastest of some calls of a compiled function."""
    times = []
    for _ in range(20):
        start = time.perf_counter()
        jax.block_until_ready(function(*given))
        times.append(time.perf_counter() - start)
    return min(times[1:])


def peaks(dtype: type) -> tuple[float, float]:
    """Operations per second of multiply-adds in registers, and bytes per second of a copy."""
    rounds, lanes = 10_000, 128
    x = jnp.linspace(0.1, 0.9, lanes, dtype=dtype)

    @jax.jit
    def multiply_add(x: jax.Array) -> jax.Array:
        return jax.lax.fori_loop(0, rounds, lambda _, x: x * dtype(0.999) + dtype(1e-3), x)

    wide = jnp.ones(2**25, dtype)
    copied = 2 * wide.nbytes / fastest(jax.jit(lambda x: x + dtype(1.0)), wide)
    return 2 * rounds * lanes / fastest(multiply_add, x), copied


def roofline(engine: CompiledModel, pixels: ObservationBatch) -> None:
    print("one look at a pixel      us   operations   bytes   Gop/s  of peak  of bandwidth")
    for name, program, look, dtype in (
        ("scoring, single", engine.single_program, scoring_derivatives, np.float32),
        ("scoring, double", engine.program, scoring_derivatives, np.float64),
        ("exact, double", engine.program, exact_derivatives, np.float64),
    ):
        with jax.enable_x64(dtype is np.float64):
            some = pixels.subset(np.arange(LANES)).in_precision(dtype)

            def batch(own: Any, shared: Any, z: Any, look=look, program=program) -> Any:
                return jax.vmap(lambda own, z: look(program, z, eqx.combine(own, shared)))(own, z)

            given = (*jax.tree.map(jnp.asarray, (some.batched, some.static)), jnp.zeros((LANES, 4)))
            compiled = jax.jit(batch).lower(*given).compile()
            cost, seconds = compiled.cost_analysis(), fastest(compiled, *given)
            peak, bandwidth = peaks(dtype)
        operations, moved = cost["flops"] / LANES, cost["bytes accessed"] / LANES
        speed = LANES / seconds
        print(
            f"{name:<18} {1e6 / speed:8.1f} {operations:12.0f} {moved:7.0f} "
            f"{operations * speed / 1e9:7.1f} {operations * speed / peak:8.2f} "
            f"{moved * speed / bandwidth:13.2f}"
        )


def main(count: int) -> None:
    capture = image(round(count**0.5))
    model, scene, links = ASKED.values()
    plans = {
        precision: plan_map(capture, model, None, scene, None, links, None, 0, precision)
        for precision in ("double", "single")
    }
    engine = plans["double"].engine
    with jax.enable_x64(True):
        masked = mask_missing(capture)
        batches = {name: plan.batch(masked) for name, plan in plans.items()}
        pixels = batches["double"].pixels
        many = len(pixels)
        ours, settled = rate(many, lambda: find_modes(batches["double"]))
        single, near = rate(many, lambda: find_modes(batches["single"]))
        scipy_rate, _ = rate(60, lambda: by_scipy(engine, pixels, 60))
        guide_rate, _ = rate(200, by_guide(engine, pixels, 200))
        newton_rate, newton = rate(1024, by_newton(engine, pixels, 1024))
    whole, maps = rate(many, lambda: pb.fit_pixels(capture, **ASKED))
    print(f"{platform.machine()}, {os.cpu_count()} cores; {many} pixels, {VIEWS} views")
    print("            pixels/s   of scipy   of newton   of guide")
    for name, speed in {
        "scipy": scipy_rate,
        "guide": guide_rate,
        "newton": newton_rate,
        "ours": ours,
        "single": single,
        "weighed": whole,
    }.items():
        ratios = (speed / peer for peer in (scipy_rate, newton_rate, guide_rate))
        print(f"{name:<8} {speed:11.0f}" + "".join(f"{ratio:11.1f}" for ratio in ratios))
    sd = np.sqrt(np.sum(np.asarray(settled.mode.root) ** 2, axis=1))
    apart = np.max(np.abs(np.asarray(newton) - settled.mode.z[:1024]) / sd[:1024], axis=1)
    higher = heights(engine, pixels, np.asarray(newton)) - heights(
        engine, pixels, settled.mode.z[:1024]
    )
    off = np.max(np.abs(near.mode.z - settled.mode.z) / sd, axis=1)
    narrow = np.sqrt(np.sum(np.asarray(near.mode.root) ** 2, axis=1))
    print(
        f"converged {settled.converged.mean():.4f}; newton arrives at the same mode in "
        f"{np.mean(apart < 0.01):.3f} of the pixels, at a worse place in "
        f"{np.mean(higher > 1e-6):.3f}, at a better one in {np.mean(higher < -1e-6):.3f}\n"
        f"single precision converged {near.converged.mean():.4f}; its modes are off by "
        f"{np.median(off):.1e} sd (99%: {np.quantile(off, 0.99):.1e}), its sds by "
        f"{np.median(np.abs(narrow / sd - 1.0)):.1e}\n{pb.maps.count_pixels(maps)}"
    )
    roofline(engine, pixels)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 16384)
