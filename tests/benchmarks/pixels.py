"""Pixels per second, side by side in one run: peers, ours, and what each answer is worth.

    python tests/benchmarks/pixels.py            40 views, four parameters
    python tests/benchmarks/pixels.py 100000     the same, with so many pixels of ours

The image is of the paper's scene with four facets on the way out of the body, read by the degree of
polarization with known normal noise. Every peer gets the same compiled model; each is timed after
compilation, on as many pixels as it can do in some seconds.

    scipy      least_squares in a loop, its own differences, normal priors of the coordinates
    guide      AutoLaplaceApproximation in a loop: BFGS, then its Hessian; compiled once
    newton     vmap of 25 damped Newton steps with full Hessians and jax.numpy.linalg
    ours       `Engine.climb`: mode and covariance
    weighed    `fit_pixels`: the same, drawn from, weighed and summarized, on all cores
"""

import dataclasses
import os
import platform
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
import xarray as xr
from numpyro import handlers, optim
from numpyro.infer import SVI, Trace_ELBO
from numpyro.infer.autoguide import AutoLaplaceApproximation
from polar_bayes.models.per_material import per_material

import polar_bayes as pb
from polar_bayes.capture.schema import validate
from polar_bayes.observation.data import Observations
from polar_bayes.pixels.blocks import set_aside
from polar_bayes.pixels.engine import Engine
from polar_bayes.pixels.maps import plan_map
from polar_bayes.pixels.stack import Stack, stack, together

NOISE, VIEWS, STEPS = 0.01, 40, 25
RANGES = {
    "roughness": (0.08, 0.35),
    "subsurface_fraction": (0.2, 0.7),
    "absorption": (0.1, 0.8),
    "refractive_index": (1.35, 1.6),
}
FEW_FACETS = pb.FacetQuadrature(along=2, across=2)
PAPER = pb.SETUPS["paper"].scene
SCENE = dataclasses.replace(
    PAPER, surface=pb.RoughSurface(pb.Beckmann(), pb.PointSource(), FEW_FACETS)
)
ASKED = {
    "model": handlers.condition(per_material, data={"normal_scale": NOISE}),
    "scene": SCENE,
    "links": pb.NormalLink(),
}


def image(side: int) -> xr.Dataset:
    """A square image whose pixels have nothing in common but the directions."""
    rng = np.random.default_rng(3)
    view = pb.simulate("leaf", seed=1, protocol=pb.Protocol(views=VIEWS, wavelengths=()))
    angles = [f"{body}_{angle}" for body in ("view", "light") for angle in ("zenith", "azimuth")]
    truth = {name: rng.uniform(*ends, (side, side)) for name, ends in RANGES.items()}
    with jax.enable_x64(True):
        geometry = pb.Geometry.from_degrees(**{name: view[name].to_numpy() for name in angles})
        readings = np.asarray(jax.jit(lambda t: SCENE.predict(t, geometry)["dop"])(truth))
    readings = np.clip(readings + NOISE * rng.normal(size=readings.shape), 0.0, 1.0)
    return view[angles].assign(dop=(("y", "x", "view"), readings))


def rate(count: int, run: Callable[[], Any]) -> tuple[float, Any]:
    """Pixels per second of the second run, and what it found."""
    run()
    start = time.perf_counter()
    found = run()
    return count / (time.perf_counter() - start), found


def by_scipy(engine: Engine, pixels: Stack, count: int) -> np.ndarray:
    residuals = jax.jit(
        lambda z, data: jnp.concatenate([engine.program.residuals(z, data)["dop"] / NOISE, z])
    )
    found = []
    for i in range(count):
        data = pixels.pixel(i)
        found.append(scipy.optimize.least_squares(residuals, np.zeros(4), args=(data,)).x)
    return np.stack(found)


def by_guide(engine: Engine, pixels: Stack, count: int) -> Any:
    guide = AutoLaplaceApproximation(engine.program.model)
    search = SVI(engine.program.model, guide, optim.Minimize(), Trace_ELBO())
    state = search.init(jax.random.key(0), pixels.pixel(0))

    @jax.jit
    def fit(data: Observations) -> Any:
        found, _ = search.update(state, data)
        parameters = search.get_params(found)
        return parameters["auto_loc"], guide.get_transform(parameters).scale_tril

    return lambda: [jax.block_until_ready(fit(pixels.pixel(i))) for i in range(count)]


def by_newton(engine: Engine, pixels: Stack, count: int) -> Callable:
    def fit(own: Observations, shared: Observations) -> jax.Array:
        data = together(own, shared)

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
    return lambda: jax.block_until_ready(compiled(some.own, some.shared))


def main(count: int) -> None:
    capture = image(round(count**0.5))
    model, scene, links = ASKED.values()
    plan = plan_map(capture, model, None, scene, None, links, None, 0, "double")
    with jax.enable_x64(True):
        pixels = stack(plan.observe(validate(set_aside(capture))))
        engine = plan.engine
        ours, settled = rate(len(pixels), lambda: engine.climb(pixels))
        scipy_rate, _ = rate(60, lambda: by_scipy(engine, pixels, 60))
        guide_rate, _ = rate(200, by_guide(engine, pixels, 200))
        newton_rate, newton = rate(1024, by_newton(engine, pixels, 1024))
    whole, maps = rate(len(pixels), lambda: pb.fit_pixels(capture, **ASKED))
    print(f"{platform.machine()}, {os.cpu_count()} cores; {len(pixels)} pixels, {VIEWS} views")
    for name, speed in {
        "scipy": scipy_rate,
        "guide": guide_rate,
        "newton": newton_rate,
        "ours": ours,
        "weighed": whole,
    }.items():
        print(f"{name:<8} {speed:10.0f} pixels/s   ours is {ours / speed:8.1f} times that")
    sd = np.sqrt(np.sum(np.asarray(settled.peak.widths[:1024]) ** 2, axis=1))
    apart = np.max(np.abs(np.asarray(newton) - settled.peak.z[:1024]) / sd, axis=1)
    print(
        f"converged {settled.converged.mean():.4f}; of newton within .01 sd of ours "
        f"{np.mean(apart < 0.01):.4f}; {pb.count_pixels(maps)}"
    )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 16384)
