"""Numbers against fifty digits, and what must be finite with its derivatives."""

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np

BOUND = {np.float64: 1e-10, np.float32: 1e-4}


def digitwise(function):
    """A function of numbers of many digits, entry by entry."""
    return np.vectorize(function, otypes=[object])


exactly = digitwise(lambda number: mp.mpf(float(number)))
"""What a precision holds, in fifty digits: the rounding of inputs is on both sides then."""


def grid(dtype: type, *axes) -> list[np.ndarray]:
    """Every combination of the values, one column for each of them."""
    return [column.ravel() for column in np.meshgrid(*(np.array(axis, dtype) for axis in axes))]


def assert_accurate(value, truth, dtype, *inputs, size=None, floor=1e-60, bound=None) -> None:
    """The error against a size, by default that of the truth, within the bound of a precision."""
    value, truth = np.ravel(value), np.ravel(np.asarray(truth, object))
    assert value.dtype == dtype
    size = abs(truth) if size is None else np.ravel(size)
    error = abs(exactly(value) - truth) / np.maximum(size, mp.mpf(floor))
    worst = np.argmax(error)
    at = ", ".join(str(column[worst]) for column in inputs)
    assert error[worst] <= (bound or BOUND[dtype]), f"{float(error[worst]):.1e} at {at}"


def value_gradient_hessian(function, rows, *fixed):
    """Value, gradient and Hessian times a vector without zeros, row by row.

    One entry that is not finite spoils its row, and the product compiles in half the time.
    """
    tangent = jnp.asarray([0.7, -1.3, 0.9, 1.1][: rows.shape[1]], rows.dtype)

    def derivatives(row, *fixed):
        (value, gradient), (_, hessian) = jax.jvp(
            jax.value_and_grad(lambda x: function(x, *fixed)), (row,), (tangent,)
        )
        return value, gradient, hessian

    return jax.jit(jax.vmap(derivatives))(rows, *fixed)


def assert_finite(results, names, dtype) -> None:
    """Of every named row: its value and as many derivatives as there are."""
    for what, result in zip(("value", "gradient", "Hessian"), results, strict=False):
        assert result.dtype == dtype
        wrong = np.flatnonzero(~np.isfinite(np.reshape(result, (len(names), -1))).all(axis=1))
        some = [names[row] for row in wrong[:8]]
        assert not some, f"{what} is not finite at {wrong.size}: {some}"
