"""The loop around the NUTS kernel, on a normal distribution of known width."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polar_bayes as pb
from polar_bayes.inference.initialization import Target
from polar_bayes.inference.program import AbstractDensity
from polar_bayes.methods import nuts


class OfFunction(AbstractDensity):
    """A density that is given as a function."""

    def __init__(self, potential: Callable) -> None:
        self._potential = potential

    def potential(self, z, given):
        return self._potential(z, given)


def density(z: jax.Array, center: jax.Array) -> jax.Array:
    return 0.5 * jnp.sum((z - center) ** 2)


def sampled(settings: pb.methods.Nuts, seed: int, *, density=density, given=None, potential=None):
    """Draws (chain, draw, 3), their statistics, whether goals were reached, and how often halved.

    By default of a standard normal distribution.
    """
    here = Target(
        density=density,
        given=jnp.zeros(3) if given is None else given,
        potential=potential or (lambda z: (0.5 * float(z @ z), z)),
        starts=np.random.default_rng(0).standard_normal((settings.chains, 3)),
        metric=np.eye(3),
    )
    sampler = nuts.Sampler(OfFunction(density), settings.static(here))
    return nuts.sample(sampler, here, jax.random.key(seed), settings)


@pytest.mark.thorough
def test_how_draws_are_cut_into_blocks_changes_nothing() -> None:
    """A warm-up that ends inside a block, too: its steps are counted, its draws are not kept."""
    settings = pb.methods.Nuts(chains=2, warmup=60, draws=120, most_draws=120)
    with jax.enable_x64(True):  # 60 divides the warm-up and the draws, 35 does neither
        told = [sampled(dataclasses.replace(settings, block=block), 1) for block in (60, 35)]
    (z, stats, *_), (again, others, *_) = told
    assert z.shape == (2, 120, 3)
    assert np.array_equal(z, again)
    for name in ("n_steps", "warmup_steps", "energy"):
        assert np.array_equal(stats[name], others[name]), name
    assert np.all(stats["warmup_steps"] >= 60)  # a draw takes one step at least


def test_chains_share_what_they_adapted() -> None:
    """Step size and metric: a density ten times as wide in one coordinate takes no more steps."""
    settings = pb.methods.Nuts(chains=3, warmup=200, draws=400, most_draws=400)
    with jax.enable_x64(True):
        taken = []
        for width in (1.0, 10.0):
            widths = jnp.asarray([1.0, 1.0, width])
            z, stats, *_ = sampled(
                settings,
                2,
                density=lambda z, widths: 0.5 * jnp.sum((z / widths) ** 2),
                given=widths,
                potential=lambda z, widths=widths: (
                    0.5 * float(np.sum((z / widths) ** 2)),
                    np.asarray(z / widths**2),
                ),
            )
            assert len(np.unique(stats["step_size"])) == 1
            taken.append(stats["n_steps"].mean())
            # Four standard errors of a variance from 300 effective draws at least.
            np.testing.assert_allclose(z.var(axis=(0, 1)), widths**2, rtol=4.0 * (2 / 300) ** 0.5)
    assert taken[1] < 1.5 * taken[0]


def funnel(z: jax.Array, scale: jax.Array) -> jax.Array:
    """Neal (2003), Ann. Statist. 31, 705: at its neck every step is too long."""
    return 0.5 * (z[0] / scale) ** 2 + 0.5 * jnp.sum(z[1:] ** 2) * jnp.exp(-z[0]) + z[0]


@pytest.mark.thorough
def test_where_draws_diverge_it_changes_nothing_either() -> None:
    """Chains are redone after the same draws, whether a block holds one or all of them."""
    settings = pb.methods.Nuts(chains=2, warmup=100, draws=100, most_draws=400, ess=1e6)
    slope = jax.value_and_grad(lambda z: funnel(z, 3.0))
    given = {"density": funnel, "given": jnp.asarray(3.0), "potential": slope}
    with jax.enable_x64(True):
        told = [
            sampled(dataclasses.replace(settings, block=block), 1, **given)
            for block in (20, 50, 100)
        ]
    z, stats, reached, halvings = told[0]
    assert halvings > 0
    assert not reached
    for again, others, *_, as_often in told[1:]:
        assert as_often == halvings
        assert np.array_equal(z, again)
        assert np.array_equal(stats["warmup_steps"], others["warmup_steps"])
