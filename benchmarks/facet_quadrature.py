"""Accuracy and cost of facets: the front of the setting `FacetQuadrature`, as a table.

    python benchmarks/facet_quadrature.py

Each cell holds the largest error in degree of polarization against 64 x 64 facets of the same
integral, for zenith angles 0 to 89 degrees, and where it is: (roughness, index, degrees). The peer
is a plain rule in the facets' polar angles (Gauss-Legendre radius, uniform azimuth) that cuts at
the border of the source; "lost" is where none of its facets mirrors the source.

The last column is the time of a gradient, reflection and way out, relative to the default.
"""

import functools
import itertools
import math
import time
from collections.abc import Callable

import click
import jax
import jax.numpy as jnp
import numpy as np

from polar_bayes.physics.facets import FacetQuadrature
from polar_bayes.physics.geometry import Geometry, cos_degrees, sin_degrees
from polar_bayes.physics.illumination import Disc, UniformSky
from polar_bayes.physics.microfacet import (
    GGX,
    AbstractMicrofacet,
    AnisotropicSlopes,
    Beckmann,
)
from polar_bayes.physics.stack import Stack
from polar_bayes.physics.surface import RoughSurface

ROUGHNESS = (0.01, 0.02, 0.04, 0.08, 0.15, 0.3)
INDEX = (1.2, 1.5, 2.0)
ZENITH = np.concatenate([np.arange(0.0, 75.0, 2.5), np.arange(75.0, 89.1, 0.5)])

RULES = ((4, 4), (5, 4), (5, 5), (6, 5), (8, 6), (10, 8), (16, 16))
PLAIN_RULES = ((4, 8), (8, 8), (8, 16), (16, 16))
TRUTH = FacetQuadrature(64, 64)

# Roughness along and across grooves, their azimuth from the viewer, and zeniths.
GROOVES = ((0.3, 0.2), (0.1, 0.3), (0.1, 0.4), (0.04, 0.3), (0.02, 0.3), (0.01, 0.2), (0.05, 1.0))
AZIMUTH = (0.0, 5.0, 15.0, 30.0, 60.0, 85.0, 90.0)
GROOVE_ZENITH = (0.0, 20.0, 40.0, 56.0, 70.0, 80.0, 85.0)

# Half width of the source in degrees; the horizon bounds the sky, and None is the way out.
INTEGRALS = {"sky": 90.0, "exit": None, "Disc(1)": 1.0, "Disc(5)": 5.0, "Disc(15)": 15.0}

# Roughness, index and zenith of shape (...) to the signed degree of polarization.
Polarization = Callable[[jax.Array, jax.Array, jax.Array], jax.Array]


def ours(distribution: AbstractMicrofacet, nodes: FacetQuadrature, integral: str) -> Polarization:
    """The library's average over facets."""
    half_width = INTEGRALS[integral]
    source = Disc(half_width) if half_width and half_width < 90.0 else UniformSky()
    surface = RoughSurface(distribution, source, nodes)

    def polarization(roughness: jax.Array, index: jax.Array, zenith: jax.Array) -> jax.Array:
        material = {"roughness": roughness, "refractive_index": index}
        views = Geometry(zenith, 0.0 * zenith, zenith, 0.0 * zenith + 180.0)
        light = surface.exit if half_width is None else surface.light
        return light(material, views, Stack(index)).q

    return polarization


def plain(distribution: AbstractMicrofacet, nodes: tuple[int, int], integral: str) -> Polarization:
    """Facets in rings around the normal, cut where they mirror past the source."""
    half_width = INTEGRALS[integral]
    node, weight = np.polynomial.legendre.leggauss(nodes[0])
    rest = 0.5 * (1.0 - node)
    share = 1.0 - rest**3
    if isinstance(distribution, Beckmann):
        radius = np.sqrt(-np.log1p(-share))
    else:
        radius = np.sqrt(share / (1.0 - share))
    azimuth = 2.0 * np.pi * (np.arange(nodes[1]) + 0.5) / nodes[1]
    along, across = (np.outer(radius, f(azimuth)).ravel() for f in (np.cos, np.sin))
    shares = np.repeat(weight * rest**2, nodes[1])

    def polarization(roughness: jax.Array, index: jax.Array, zenith: jax.Array) -> jax.Array:
        sine, cosine = sin_degrees(zenith)[..., None], cos_degrees(zenith)[..., None]
        alpha, n = roughness[..., None], index[..., None]
        x, y = alpha * along, alpha * across
        tilt = 1.0 / jnp.sqrt(1.0 + x**2 + y**2)
        cos_incidence = jnp.maximum(tilt * (cosine + sine * x), 1e-6)
        facets = shares * jnp.maximum(cosine + sine * x, 0.0)
        in_plane, out_of_plane = (tilt * (sine - x * cosine)) ** 2, (tilt * y) ** 2
        law = Stack.transmission if half_width is None else Stack.reflection
        power = law(Stack(n), cos_incidence, in_plane + out_of_plane)
        if half_width is not None:
            cos_light = 2.0 * cos_incidence * tilt - cosine
            sin_light = 2.0 * cos_incidence * x * tilt - sine
            inside = cosine * cos_light - sine * sin_light > math.cos(math.radians(half_width))
            lit = (cos_light > 1e-6) & (inside | (half_width == 90.0))
            slope = jnp.where(lit, 1.0 / jnp.maximum(cos_light, 1e-6) ** 2 - 1.0, 0.0)
            facets = jnp.where(lit, facets * distribution.shadowing(slope, alpha), 0.0)
        polarized = jnp.sum(facets * power.contrast * (in_plane - out_of_plane), axis=-1)
        return polarized / jnp.sum(facets * power.mean, axis=-1)

    return polarization


def cases(roughness: tuple[float, ...]) -> np.ndarray:
    """Roughness, index and zenith of every case. Shape (3, roughness * index, zenith)."""
    pairs = np.array(list(itertools.product(roughness, INDEX)))
    return np.stack(
        [grid + 0.0 * ZENITH for grid in (pairs[:, :1], pairs[:, 1:])]
        + [np.broadcast_to(ZENITH, (len(pairs), len(ZENITH)))]
    )


def measure(polarization: Polarization, at: np.ndarray) -> np.ndarray:
    """Row by row: 64 x 64 facets of all cases at once would fill the memory."""
    return np.asarray(
        jax.jit(lambda x: jax.lax.map(lambda row: polarization(*row), x))(
            jnp.asarray(at.swapaxes(0, 1))
        )
    )


def worst(found: np.ndarray, truth: np.ndarray, at: np.ndarray) -> str:
    """The largest error and its place."""
    error = np.abs(found - truth)
    if not np.all(np.isfinite(error)):
        return "lost"
    place = np.unravel_index(np.argmax(error), error.shape)
    where = ", ".join(f"{x:.4g}" for x in at[:, *place])
    return f"{error[place]:.2g} ({where})"


def gradient(rule: Callable[[str], Polarization], at: np.ndarray) -> Callable[[], jax.Array]:
    """Derivatives of reflection and exit by roughness and index, for the size of a capture."""
    reflection, way_out = rule("sky"), rule("exit")
    some = jnp.asarray(at[:, ::5])

    def total(x: jax.Array) -> jax.Array:
        return jnp.sum(reflection(*x, some[2]) + way_out(*x, some[2]))

    compiled = jax.jit(jax.grad(total))
    return lambda: compiled(some[:2]).block_until_ready()


def relative_time(run: Callable[[], jax.Array], unit: Callable[[], jax.Array]) -> float:
    """Return the shortest of many times, in turns, so that a busy machine slows both."""
    seconds: dict[Callable[[], jax.Array], list[float]] = {run: [], unit: []}
    for _, task in itertools.product(range(40), seconds):
        start = time.perf_counter()
        task()
        seconds[task].append(time.perf_counter() - start)
    return min(seconds[run]) / min(seconds[unit])


def table(distribution: AbstractMicrofacet, roughness: tuple[float, ...]) -> None:
    """Print the front of one distribution."""
    at = cases(roughness)
    truth = {name: measure(ours(distribution, TRUTH, name), at) for name in INTEGRALS}
    rules = {
        f"{along} x {across}": functools.partial(ours, distribution, FacetQuadrature(along, across))
        for along, across in RULES
    } | {
        f"plain {radius} x {azimuth}": functools.partial(plain, distribution, (radius, azimuth))
        for radius, azimuth in PLAIN_RULES
    }
    unit = gradient(functools.partial(ours, distribution, FacetQuadrature()), at)
    click.echo(f"\n{distribution!r}, roughness {min(roughness)} to {max(roughness)}\n")
    click.echo("| along x across | facets | " + " | ".join(INTEGRALS) + " | gradient |")
    click.echo("|---" * (len(INTEGRALS) + 3) + "|")
    for name, rule in rules.items():
        errors = [worst(measure(rule(i), at), truth[i], at) for i in INTEGRALS]
        relative = relative_time(gradient(rule, at), unit)
        facets = math.prod(int(x) for x in name.removeprefix("plain ").split(" x "))
        click.echo(f"| {name} | {facets} | " + " | ".join(errors) + f" | {relative:.2f} |")


def light_on_grooves(
    distribution: AbstractMicrofacet, nodes: FacetQuadrature, integral: str, at: np.ndarray
) -> np.ndarray:
    """Intensity, q and u of rows of roughness along and across, azimuth and zenith."""
    half_width = INTEGRALS[integral]
    source = Disc(half_width) if half_width and half_width < 90.0 else UniformSky()
    surface = RoughSurface(distribution, source, nodes, AnisotropicSlopes("azimuth"))

    def one(row: jax.Array) -> jax.Array:
        names = ("roughness", "roughness_across", "azimuth")
        zenith, index = row[3:], jnp.full(1, 1.5)
        views = Geometry(zenith, 0.0 * zenith, zenith, 0.0 * zenith + 180.0)
        law = surface.exit if half_width is None else surface.light
        return jnp.concatenate(
            law(dict(zip(names, row[:, None], strict=False)), views, Stack(index))
        )

    return np.asarray(jax.jit(lambda rows: jax.lax.map(one, rows, batch_size=35))(at))


def groove_table(distribution: AbstractMicrofacet) -> None:
    """Print the accuracy of `FacetQuadrature` on grooves, against 40 x 40."""
    at = np.array([(*r, t, z) for r, t, z in itertools.product(GROOVES, AZIMUTH, GROOVE_ZENITH)])
    click.echo(f"\n{distribution!r}, grooves\n")
    click.echo("| along x across | facets | " + " | ".join(INTEGRALS) + " | brightness |")
    click.echo("|---" * (len(INTEGRALS) + 3) + "|")
    many = FacetQuadrature(40, 40)
    truth = {name: light_on_grooves(distribution, many, name, at) for name in INTEGRALS}
    for along, across in RULES[1:-1]:
        cells, bright = [], 0.0
        for name in INTEGRALS:
            found = light_on_grooves(distribution, FacetQuadrature(along, across), name, at)
            error = np.hypot(*(found - truth[name])[:, 1:].T)
            place = int(np.argmax(error))
            where = ", ".join(f"{x:.4g}" for x in at[place])
            cells.append(f"{error[place]:.2g} ({where})")
            bright = max(bright, np.max(np.abs(found[:, 0] / truth[name][:, 0] - 1.0)))
        facets = 2 * across * (along + across)
        click.echo(f"| {along} x {across} | {facets} | {' | '.join(cells)} | {bright:.2g} |")


@click.command(help=__doc__.splitlines()[0])
@click.option("--roughness", multiple=True, default=ROUGHNESS, help="Repeat for several.")
def main(roughness: tuple[float, ...]) -> None:
    """Measure and print."""
    jax.config.update("jax_enable_x64", True)
    for distribution in (Beckmann(), GGX()):
        table(distribution, roughness)
        groove_table(distribution)


if __name__ == "__main__":
    main()
