"""Factors of very small matrices: those of NumPy, and NaN where there is none."""

import jax
import numpy as np
import pytest
from cases import each
from hypothesis import given, settings
from hypothesis import strategies as st

from polar_bayes.numerics.levenberg_marquardt import cholesky, inverse

SIZES = range(1, 8)
FACTOR, INVERSE = jax.jit(jax.vmap(cholesky)), jax.jit(jax.vmap(inverse))


def positive(rng: np.random.Generator, size: int, condition: float, count: int = 20) -> np.ndarray:
    """Random symmetric matrices of a given condition number."""
    turns = np.linalg.qr(rng.normal(size=(count, size, size)))[0]
    values = np.geomspace(1.0, 1.0 / condition, size)
    matrix = (turns * values) @ turns.swapaxes(-1, -2)
    return 0.5 * (matrix + matrix.swapaxes(-1, -2))


@each("dtype", [np.float64, np.float32], quick=1)
@each("size", SIZES)
def test_factors_and_inverses_are_those_of_numpy(size: int, dtype: type) -> None:
    matrix = positive(np.random.default_rng(size), size, 100.0).astype(dtype)
    factor = np.asarray(FACTOR(matrix))
    half = np.asarray(INVERSE(factor))
    assert factor.dtype == half.dtype == dtype
    # Rounding of a few operations, times the condition number 100 (its root for the factor).
    eps = np.finfo(dtype).eps
    assert np.abs(factor - np.linalg.cholesky(matrix)).max() < 10 * size * 100.0 * eps
    expected = np.linalg.inv(np.linalg.cholesky(matrix.astype(float)))
    assert np.abs(half - expected).max() < 10 * size * 1000.0 * eps
    assert (np.triu(factor, 1) == 0.0).all()
    assert (np.triu(half, 1) == 0.0).all()


@given(
    size=st.integers(1, 7),
    seed=st.integers(0, 2**32 - 1),
    scales=st.lists(st.floats(-8.0, 8.0), min_size=7, max_size=7),
)
@settings(max_examples=100, deadline=None)
def test_any_factor_is_found_again(size: int, seed: int, scales: list[float]) -> None:
    # Coordinates of very different units: 1e-8 to 1e8.
    rng = np.random.default_rng(seed)
    truth = np.tril(rng.uniform(-0.5, 0.5, (20, size, size)), -1) + np.eye(size)
    truth = truth * 10.0 ** np.array(scales[:size])[:, None]
    factor = np.asarray(FACTOR(truth @ truth.swapaxes(-1, -2)))
    rows = np.linalg.norm(truth, axis=-1, keepdims=True)
    assert np.abs((factor - truth) / rows).max() < 1e-11
    assert np.abs(np.asarray(INVERSE(factor)) @ factor - np.eye(size)).max() < 1e-11


BAD = {
    "zero": np.zeros((3, 3)),
    "negative": -np.eye(3),
    "negative at the end": np.diag([1.0, 1.0, -1e-9]),
    "indefinite": np.array([[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
    "of rank one": np.ones((3, 3)),
    "NaN": np.full((3, 3), np.nan),
    "NaN in one entry": np.eye(3) + np.where(np.arange(9).reshape(3, 3) % 8 == 3, np.nan, 0.0),
    "NaN at the end": np.diag([1.0, 1.0, np.nan]),
    "infinite": np.diag([1.0, np.inf, 1.0]) + np.where(np.eye(3) > 0.0, 0.0, np.inf),
}


@each("dtype", [np.float32, np.float64])
@each("case", BAD)
def test_what_has_no_factor_gets_nan_and_no_repair(case: str, dtype: type) -> None:
    good = positive(np.random.default_rng(2), 3, 10.0, 1)[0]
    factor = np.asarray(FACTOR(np.stack([BAD[case], good]).astype(dtype)))
    assert np.isnan(factor[0]).any()
    half = np.asarray(INVERSE(factor))
    assert not np.isfinite(half[0]).all()
    assert not np.isfinite(half[0].T @ half[0]).all()
    # The one beside it does not notice.
    assert factor[1] == pytest.approx(np.linalg.cholesky(good.astype(dtype)), rel=1e-5)
    assert np.isfinite(half[1]).all()
