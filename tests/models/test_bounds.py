"""The map onto an interval: the identity inside, finite wherever a sampler may go."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from cases import each

from polar_bayes.models.sites import SoftClip

LOW, HIGH = 1.2, 2.0
INTERVALS = {"both": (LOW, HIGH), "one": (1.0, np.inf)}


@each("interval", INTERVALS.values(), ids=INTERVALS)
def test_it_goes_there_and_back_with_its_volume(interval: tuple[float, float]) -> None:
    bent = SoftClip(*interval)
    x = np.linspace(0.9, 2.3, 57)

    @jax.jit
    def there_and_back(x: jax.Array) -> tuple[jax.Array, ...]:
        y = bent(x)
        slope = jax.vmap(jax.grad(lambda x: bent(x)))(x)
        return y, bent.inv(y), slope, bent.log_abs_det_jacobian(x, y)

    y, back, slope, found = map(np.asarray, there_and_back(x))
    inside = (y - LOW > 1e-6) & (HIGH - y > 1e-6)  # closer, the way back has no digits left
    np.testing.assert_allclose(back[inside], x[inside], atol=1e-8)
    # Outside, the slope is a difference of two numbers that are nearly one; the volume is not.
    np.testing.assert_allclose(found[inside], np.log(slope[inside]), atol=1e-8)


def test_inside_nothing_moves() -> None:
    x = jnp.linspace(1.4, 1.8, 9)
    # At twenty widths of the bend, 0.01 each: exp(-20) of one.
    np.testing.assert_allclose(SoftClip(LOW, HIGH)(x), x, atol=3e-11)


def curvature(function: Callable) -> Callable:
    return jax.grad(jax.grad(function))


@each("double", [True, False])
@each("interval", INTERVALS.values(), ids=INTERVALS)
def test_value_slope_and_curvature_are_finite_far_out_and_at_the_bounds(interval, double) -> None:
    with jax.enable_x64(double):
        bent = SoftClip(*interval)
        x = jnp.asarray(
            np.concatenate([np.linspace(-50.0, 50.0, 400), interval[:1], [HIGH, -1e6, 1e6]]), float
        )
        at_ends = jnp.asarray([interval[0], min(interval[1], 1e6)], x.dtype)

        def volume(x: jax.Array) -> jax.Array:
            return bent.log_abs_det_jacobian(x, None)

        def derivatives(x: jax.Array) -> list[jax.Array]:
            return [each(f)(x) for f in (bent, volume) for each in (jax.grad, curvature)]

        y, ends, *found = jax.jit(lambda x: (bent(x), bent.inv(at_ends), jax.vmap(derivatives)(x)))(
            x
        )
        assert y.dtype == (jnp.float64 if double else jnp.float32)
        assert (y >= jnp.asarray(interval[0], y.dtype)).all()
        assert (y <= jnp.asarray(interval[1], y.dtype)).all()
        assert np.isfinite([*jax.tree.leaves(found)]).all()
        assert np.isfinite(ends).all()
