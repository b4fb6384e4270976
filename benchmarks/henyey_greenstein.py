"""Multiple scattering behind `HenyeyGreenstein`: solved for a half space, and fitted to a table.

    python benchmarks/henyey_greenstein.py             how far the table is from the solution
    python benchmarks/henyey_greenstein.py --write F   solve and fit again, and write the table to F

The table is polar_bayes/physics/henyey_greenstein.csv. Steep are the directions that a body of
index 1.2 allows. Printing takes ten seconds on two cores, writing half a minute.
"""

import functools
import itertools
import math
from pathlib import Path

import click
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

from polar_bayes.physics.half_space import CLEAREST, GRAZING, Ray
from polar_bayes.physics.phase_function import (
    DEGREES,
    MOST_ANISOTROPY,
    ORDERS,
    HenyeyGreenstein,
    Isotropic,
)

# Squares of Gauss's nodes: many near grazing.
NODE, WEIGHT = np.polynomial.legendre.leggauss(48)
COSINES, MEASURE = (0.5 * (NODE + 1.0)) ** 2, 0.5 * WEIGHT * (NODE + 1.0)
SINES = np.sqrt(1.0 - COSINES**2)
TURNS = (np.arange(1000) + 0.5) * np.pi / 1000
NODES = 9  # of anisotropy and of absorption
PRECISION = 1e-10
MANY = 20  # orders in azimuth of the solution
TURNS_FITTED = 24
LEAST = 1e-3  # of the ratio to isotropic scattering
STEEP = 0.55  # cosine of the flattest ray inside a body of index 1.2


def henyey_greenstein(cosine: np.ndarray, g: float) -> np.ndarray:
    """The phase function, whose mean over all directions is 1."""
    return (1.0 - g**2) / (1.0 + g**2 - 2.0 * g * cosine) ** 1.5


@functools.cache
def scattered_once(g: float, orders: int) -> tuple[np.ndarray, np.ndarray]:
    """Orders in azimuth of the phase function, forwards and backwards, (order, view, light)."""
    around = np.cos(np.arange(orders)[:, None] * TURNS) / TURNS.size
    across = np.multiply.outer(np.outer(SINES, SINES), np.cos(TURNS))
    along = np.outer(COSINES, COSINES)[..., None]
    forth, back = (
        np.moveaxis(henyey_greenstein(each + across, g) @ around.T, -1, 0)
        for each in (along, -along)
    )
    scale = np.ones(COSINES.size)  # no light is lost to the nodes
    for _ in range(200):
        scale = np.sqrt(scale / (0.5 * ((forth[0] + back[0]) * MEASURE) @ scale))
    return forth * np.outer(scale, scale), back * np.outer(scale, scale)


def invariant_embedding(g: float, albedo: float, orders: int) -> np.ndarray:
    """Orders in azimuth of the reflectance r of a half space without interface.

    Ambartsumian's equation by iteration: a layer on top of a half space changes nothing.
    Source: Chandrasekhar 1960, Radiative transfer, section 29, equation 28.

    Returns:
        Shape (order, view, light), at `COSINES`.
    """
    forth, back = scattered_once(g, orders)
    view, light = COSINES[:, None], COSINES
    r, change = np.zeros_like(back), np.inf
    while change > PRECISION:
        inner = MEASURE[:, None] * r
        after = back + 2.0 * light * (forth @ inner)
        after += 2.0 * view * ((r * MEASURE) @ (forth + 2.0 * light * (back @ inner)))
        r, before = 0.25 * albedo * after / (view + light), r
        change = np.max(np.abs(r - before))
    return r


def rays(cosines: np.ndarray) -> Ray:
    """Directions inside the body."""
    return Ray(jnp.asarray(cosines), jnp.sqrt(1.0 - cosines**2))


def chebyshev(share: np.ndarray) -> np.ndarray:
    """Chebyshev polynomials (value, degree) of numbers from 0 to 1."""
    return np.polynomial.chebyshev.chebvander(2.0 * share - 1.0, DEGREES - 1)


def scattered_often(g: float, albedo: float, turns: np.ndarray) -> np.ndarray:
    """4 (mu_l + mu_v) r/w without the first order, (view, light, turn)."""
    orders = np.arange(MANY)[:, None]
    factor = np.where(orders > 0, 2.0, 1.0) * np.cos(orders * turns)
    total = 4.0 * np.add.outer(COSINES, COSINES) / albedo
    often = total * invariant_embedding(g, albedo, MANY) - scattered_once(g, MANY)[1]
    return np.tensordot(often, factor, axes=(0, 0))


def fitted() -> np.ndarray:
    """Coefficients of P_m, (order, g, gamma, cosine, cosine)."""
    nodes = 0.5 - 0.5 * np.cos(np.pi * (np.arange(NODES) + 0.5) / NODES)
    anisotropies = MOST_ANISOTROPY * nodes
    gammas = math.sqrt(CLEAREST) + (1.0 - math.sqrt(CLEAREST)) * nodes
    least = np.maximum(COSINES, GRAZING)  # as the package does
    turns = (np.arange(TURNS_FITTED) + 0.5) * np.pi / TURNS_FITTED
    orders = np.arange(ORDERS)
    transform = np.where(orders > 0, 2.0, 1.0) * np.cos(np.outer(turns, orders)) / turns.size
    logs = np.empty((NODES, NODES, COSINES.size, COSINES.size, ORDERS))
    for (i, g), (j, gamma) in itertools.product(enumerate(anisotropies), enumerate(gammas)):
        absorption = gamma**2 / (1.0 - gamma**2)
        often = scattered_often(g, 1.0 / (1.0 + (1.0 - g) * absorption), turns)
        material = {"absorption": jnp.asarray(absorption), "refractive_index": jnp.ones(())}
        light, view = rays(COSINES[None]), rays(COSINES[:, None])
        isotropic = Isotropic().reflectance(material, light, view, jnp.zeros(()), jnp.ones(()))
        h_squared = 4.0 * np.add.outer(least, least) * np.asarray(isotropic) * (1.0 + absorption)
        # What few orders leave of a peak at grazing may be negative there.
        logs[i, j] = np.log(np.maximum(often / (h_squared - 1.0)[..., None], LEAST)) @ transform
    # Least squares in each variable; a direction counts as much as diffuse light has of it.
    of_g, of_gamma, of_cosine = map(chebyshev, (nodes, gammas, np.sqrt(COSINES)))
    weight, found = np.sqrt(COSINES * MEASURE)[:, None], []
    for order in orders:
        factor = anisotropies ** (2 * order) if order else nodes
        solve_g, solve_gamma = np.linalg.pinv(of_g * factor[:, None]), np.linalg.pinv(of_gamma)
        sines = SINES[:, None] ** order
        solve = np.linalg.pinv(of_cosine * sines * weight) * weight[:, 0]
        solvers = solve_g, solve_gamma, solve, solve
        found.append(np.einsum("gi,sj,kl,mn,ijln->gskm", *solvers, logs[..., order]))
    return np.stack(found)


def errors(g: float, albedo: float) -> dict[str, float]:
    """Errors of `HenyeyGreenstein` without an interface, relative to the solution."""
    turns, total = TURNS[::8], np.add.outer(COSINES, COSINES)
    # The first order of scattering needs more orders in azimuth than the others.
    across = np.multiply.outer(np.outer(SINES, SINES), np.cos(turns))
    once = henyey_greenstein(across - np.outer(COSINES, COSINES)[..., None], g)
    exact = 0.25 * albedo * (once + scattered_often(g, albedo, turns)) / total[..., None]

    material = {
        "absorption": jnp.asarray((1.0 - albedo) / albedo / (1.0 - g)),
        "refractive_index": jnp.ones(()),
    }
    light, view = rays(COSINES[:, None]), rays(COSINES[:, None, None])
    azimuth = jnp.asarray(180.0 - np.rad2deg(turns))
    one = jnp.ones(())
    found = np.asarray(HenyeyGreenstein(g).reflectance(material, light, view, azimuth, one))

    share, steep = MEASURE * COSINES, COSINES > STEEP
    diffuse = np.outer(share, share) / share.sum() ** 2
    mean, right, error = found.mean(axis=-1), exact.mean(axis=-1), found / exact - 1.0
    inside = error[steep][:, steep]
    return {
        "diffuse albedo": float(np.sum(diffuse * mean) / np.sum(diffuse * right) - 1.0),
        "albedo along the normal": float(share @ mean[:, -1] / (share @ right[:, -1]) - 1.0),
        "rms": float(np.sqrt(np.sum(diffuse * np.mean(error**2, axis=-1)))),
        "rms of steep": float(np.sqrt(np.mean(inside**2))),
        "largest of steep": float(np.abs(inside).max()),
    }


@click.command()
@click.option("--write", type=click.Path(path_type=Path), help="solve, fit and write the table")
def main(write: Path | None) -> None:
    """Print errors of the table that is installed, or write it anew."""
    with jax.enable_x64(True):
        if write is not None:
            rows = fitted().reshape(ORDERS * DEGREES**2, DEGREES**2)
            np.savetxt(write, rows, fmt="%.5g", delimiter=",")
            return
        found = {
            (g, albedo): errors(g, albedo)
            for g, albedo in itertools.product((0.2, 0.5, 0.8, 0.9), (0.1, 0.5, 0.9, 0.99, 0.999))
        }
    table = pd.DataFrame(found).T.rename_axis(index=("g", "albedo"))
    print(table.to_string(float_format="{:.4f}".format))


if __name__ == "__main__":
    main()
