"""Light that walks over a rough surface by Smith's model: errors of two bounces and of bodies.

    python benchmarks/smith_walk.py              the tables of docs/scenes.md
    python benchmarks/smith_walk.py --write F    transmittances and their errors, as a table

A walk knows the height of every facet (as its share of all heights below), so that nothing is taken
as independent: from a facet at height u a ray that rises is free with probability u^L, one that
falls meets another facet above u' with probability 1 - (u'/u)^(1 + L), where L is Smith's Lambda.
Facets are GGX. Polarization is not followed, and no light is lost.

Source:
    Heitz, Hanika, d'Eon & Dachsbacher 2016, ACM Trans. Graph. 35, 58; Heitz 2018, Sampling the GGX
    distribution of visible normals, Journal of Computer Graphics Techniques 7 (4).
"""

from typing import NamedTuple

import click
import jax
import jax.numpy as jnp
import numpy as np

from polar_bayes.physics.facets import FacetQuadrature
from polar_bayes.physics.geometry import Geometry
from polar_bayes.physics.illumination import UniformSky
from polar_bayes.physics.microfacet import GGX, HeightCorrelatedShadowing, SeparableShadowing
from polar_bayes.physics.scene import Scene
from polar_bayes.physics.second_bounce import TwoBounceSurface
from polar_bayes.physics.second_passage import TwoFacetPassage
from polar_bayes.physics.stack import Stack
from polar_bayes.physics.surface import RoughPassage, RoughSurface, SmoothExit

ZENITHS = (0.0, 45.0, 75.0, 83.0, 87.0)
ROUGHNESS = (0.1, 0.3, 0.5, 0.8)
MANY = FacetQuadrature(10, 8)
BODY_ROUGHNESS, BODY_ZENITHS, INDEX = (0.15, 0.3, 0.5), (0.0, 45.0, 60.0, 75.0, 80.0, 85.0), 1.5
LOSSLESS = 1e5  # an index at which facets reflect all light
DARKEST = 60  # bounces after which nothing is left


class Walk(NamedTuple):
    """Rays that are still between facets: directions (ray, 3) and heights (ray,)."""

    ray: np.ndarray
    height: np.ndarray


def smith(cosine: np.ndarray, roughness: float) -> np.ndarray:
    """Smith's Lambda of a direction, up or down."""
    cosine = np.clip(np.abs(cosine), 1e-12, 1.0)
    return 0.5 * (np.sqrt(1.0 + roughness**2 * (1.0 / cosine**2 - 1.0)) - 1.0)


def arrive(zenith: float, count: int) -> Walk:
    """Rays that come from a zenith, in degrees, above all facets."""
    theta = np.deg2rad(zenith)
    ray = np.array([-np.sin(theta), 0.0, -np.cos(theta)])
    return Walk(np.tile(ray, (count, 1)), np.ones(count))


def next_facet(walk: Walk, roughness: float, random: np.random.Generator) -> np.ndarray:
    """Height of the facet that each ray meets; above 1 it meets none."""
    shadow, share = smith(walk.ray[:, 2], roughness), random.random(walk.height.size)
    rises = walk.ray[:, 2] > 0.0
    with np.errstate(over="ignore"):
        power = np.where(rises, -1.0 / np.maximum(shadow, 1e-12), 1.0 / (1.0 + shadow))
        return walk.height * share**power


def facing(ray: np.ndarray, roughness: float, random: np.random.Generator) -> np.ndarray:
    """Normals of facets as they are seen against the rays, which may rise."""
    view = -ray * [roughness, roughness, 1.0]
    view = view / np.linalg.norm(view, axis=1, keepdims=True)
    radius, turn = np.sqrt(random.random(len(ray))), 2.0 * np.pi * random.random(len(ray))
    first, second = radius * np.cos(turn), radius * np.sin(turn)
    up = 0.5 * (1.0 + view[:, 2])
    second = (1.0 - up) * np.sqrt(1.0 - first**2) + up * second
    aside = np.stack([-view[:, 1], view[:, 0], 0.0 * up], axis=1)
    length = np.linalg.norm(aside, axis=1, keepdims=True)
    aside = np.where(length > 1e-7, aside / np.maximum(length, 1e-7), [1.0, 0.0, 0.0])
    third = np.sqrt(np.maximum(1.0 - first**2 - second**2, 0.0))
    normal = first[:, None] * aside + second[:, None] * np.cross(view, aside)
    normal = normal + third[:, None] * view
    normal = normal * [roughness, roughness, 1.0]
    normal[:, 2] = np.maximum(normal[:, 2], 1e-9)
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def mirrored(ray: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Rays behind a mirror."""
    return ray - 2.0 * np.sum(ray * normal, axis=1, keepdims=True) * normal


def free_after(zenith: float, roughness: float, count: int, seed: int = 1) -> np.ndarray:
    """Return the share of rays that leave after one bounce, two, three and more."""
    random, walk, left = np.random.default_rng(seed), arrive(zenith, count), []
    for _ in range(4):
        height = next_facet(walk, roughness, random)
        left.append(np.sum(height <= 1.0) / count)
        ray, height = walk.ray[height <= 1.0], height[height <= 1.0]
        walk = Walk(mirrored(ray, facing(ray, roughness, random)), height)
    return -np.diff(left)


def second_bounce(
    view: float, lights: np.ndarray, roughness: float, count: int, seed: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Radiance by two mirrors, one after the other, of unit irradiance from each light.

    Args:
        view: Zenith of the viewer, degree, at azimuth 0.
        lights: Directions (light, 3).
        roughness: Of GGX.
        count: Number of rays.
        seed: Of the random numbers.

    Returns:
        Mean and standard error, each (light,).
    """
    random, walk = np.random.default_rng(seed), arrive(view, count)
    ray = mirrored(walk.ray, facing(walk.ray, roughness, random))
    walk = Walk(ray, next_facet(walk, roughness, random))
    met = next_facet(walk, roughness, random)
    height, ray = met[met <= 1.0], walk.ray[met <= 1.0]
    shadow = smith(ray[:, 2], roughness)
    area = np.abs(ray[:, 2]) * np.where(ray[:, 2] > 0.0, shadow, 1.0 + shadow)
    mean, error = [], []
    for light in lights:
        half = light - ray
        half = half / np.linalg.norm(half, axis=1, keepdims=True)
        up = np.maximum(half[:, 2], 1e-9)
        density = (roughness / (1.0 + (roughness**2 - 1.0) * up**2)) ** 2 / np.pi
        lit = np.where(half[:, 2] > 0.0, density / (4.0 * area), 0.0)
        lit = lit * height ** smith(light[2], roughness)
        mean.append(np.sum(lit) / count)
        error.append(np.sqrt(np.sum(lit**2) / count - mean[-1] ** 2) / np.sqrt(count))
    return np.array(mean), np.array(error)


def transmittance(
    zenith: float, roughness: float, index: float, count: int, seed: int = 1
) -> tuple[float, float]:
    """Share of light from a zenith that gets into a body, and its standard error.

    A facet reflects or refracts each ray; rays inside meet facets from below, as rays outside do
    from above.
    """
    random, walk = np.random.default_rng(seed), arrive(zenith, count)
    inside, entered = np.zeros(count, bool), 0
    for _ in range(DARKEST):
        height = next_facet(walk, roughness, random)
        met = height <= 1.0
        entered += np.sum(inside & ~met)
        ray, height, inside = walk.ray[met], height[met], inside[met]
        normal = facing(ray, roughness, random)
        cosine = np.clip(-np.sum(ray * normal, axis=1), 0.0, 1.0)
        ratio = np.where(inside, index, 1.0 / index)
        square = 1.0 - ratio**2 * (1.0 - cosine**2)
        other = np.sqrt(np.maximum(square, 0.0))
        s = (ratio * cosine - other) / (ratio * cosine + other)
        p = (cosine - ratio * other) / (cosine + ratio * other)
        share = np.where(square > 0.0, 0.5 * (s**2 + p**2), 1.0)
        passes = random.random(ray.shape[0]) >= share
        through = ratio[:, None] * ray + (ratio * cosine - other)[:, None] * normal
        # From the other side heights count downwards.
        through, turned = through * [1.0, 1.0, -1.0], 1.0 - height
        ray = np.where(passes[:, None], through, mirrored(ray, normal))
        walk = Walk(ray, np.where(passes, np.maximum(turned, 1e-12), height))
        inside = inside ^ passes
    share = float(entered) / count
    return share, float(np.sqrt(share * (1.0 - share) / count))


def table_of_bounces(count: int) -> None:
    """Print the share of a sky that lossless facets give back, by a walk and by both shadowings."""
    click.echo("| roughness | zenith | walk, two | walk, all | separable | height-correlated |")
    click.echo("|---|---|---|---|---|---|")
    views = Geometry.from_degrees(
        view_zenith=ZENITHS, view_azimuth=0.0, light_zenith=0.0, light_azimuth=0.0
    )
    stokes = jax.jit(Scene.stokes, static_argnums=0)
    for roughness in ROUGHNESS:
        material = {"roughness": roughness, "refractive_index": LOSSLESS}
        found = [
            stokes(
                Scene(TwoBounceSurface(GGX(), UniformSky(), MANY, shadowing=shadowing)),
                material,
                views,
            )[:, 0]
            for shadowing in (SeparableShadowing(), HeightCorrelatedShadowing())
        ]
        for place, zenith in enumerate(ZENITHS):
            two = np.sum(free_after(zenith, roughness, count)[:2])
            ours = " | ".join(f"{each[place]:.3f}" for each in found)
            click.echo(f"| {roughness} | {zenith:g} | {two:.3f} | 1 | {ours} |")


def transmittances(count: int) -> np.ndarray:
    """Rows of roughness, zenith, index, the walk's transmittance and its standard error."""
    rows = [
        (roughness, zenith, INDEX, *transmittance(zenith, roughness, INDEX, count))
        for roughness in BODY_ROUGHNESS
        for zenith in BODY_ZENITHS
    ]
    return np.array(rows)


def table_of_bodies(rows: np.ndarray) -> None:
    """Print how much light gets into a body, and by how much each way out is off."""
    ways = (SmoothExit(), RoughPassage(), TwoFacetPassage())
    names = "a plane (RoughExit) | RoughPassage | TwoFacetPassage"
    click.echo(f"| roughness | zenith | walk | {names} |")
    click.echo("|---|---|---|---|---|---|")
    for row in rows:
        roughness, zenith, index, share = row[:4]
        views = Geometry.from_degrees(
            view_zenith=zenith, view_azimuth=0.0, light_zenith=0.0, light_azimuth=0.0
        )
        found = [
            float(
                RoughSurface(GGX(), way_out=way)
                .exit({"roughness": jnp.asarray([roughness])}, views, Stack(jnp.asarray([index])))
                .intensity[0]
            )
            for way in ways
        ]
        off = " | ".join(f"{100.0 * (each / share - 1.0):+.1f}%" for each in found)
        click.echo(f"| {roughness} | {zenith:g} | {share:.4f} | {off} |")


@click.command(help=__doc__.splitlines()[0])
@click.option("--write", type=click.Path(dir_okay=False), help="Write transmittances there.")
@click.option("--count", default=1_000_000, help="Rays of each walk.")
def main(write: str | None, count: int) -> None:
    """Walk and print."""
    jax.config.update("jax_enable_x64", True)
    rows = transmittances(count)
    if write is not None:
        header = "roughness,zenith,refractive_index,transmittance,standard_error"
        np.savetxt(write, rows, fmt="%.6g", delimiter=",", header=header, comments="")
        return
    table_of_bounces(count)
    table_of_bodies(rows)


if __name__ == "__main__":
    main()
