r"""Estimate of the gamma of frames from the redundancy of four analyzer angles or more.

Light I behind analyzers at k angles lies in three dimensions, $I = A S$, so that $B I = 0$ for the
k - 3 rows of B that are orthogonal to A; at 0, 45, 90 and 135 degrees that is
$I_0 + I_{90} = I_{45} + I_{135}$. Counts $C = I^e$ satisfy it where they are taken to the power
$g = 1/e$. With $m_k = q \cos 2\chi_k + u \sin 2\chi_k$ and brightness s,

$$ B (1 + m)^e = \tfrac12 e (e - 1)\, B m^2 + O(m^3) : $$

an exponent shows by $x = B m^2$ (at four angles $q^2 - u^2$), in polarized light only. Other causes
do not go with x. Analyzers that pass unequal shares, stand at wrong angles or in the wrong order
are linear: they add $a + b q + c u$. Frames displaced by $\delta_k$ add
$\sum_k B_k \delta_k \cdot \nabla I_k/s$. So, for counts to the power g, the regression

$$ B C^g/s = \beta(g)\, x + a + b q + c u + \sum_k B_k \delta_k \cdot \nabla C_k^g/s + \epsilon $$

over all pixels (Huber weights over the stated errors) has $\beta = 0$ at the exponent sought. Its
standard uncertainty is that of beta over $d\beta/dg$. That of beta is by the jackknife over 4 x 4
tiles of the frame, in each of which errors may go together as they like.

The exponent is not determined where the other regressors leave too little of x: where nothing is
polarized, where all light has one polarization, and where the noise of x is more than 5% of what is
left (it goes with the noise of the response, and biases the exponent by up to so much). It is not
trusted where residuals are twice the stated errors (root mean square): then something else
happened, such as an object that moved by many pixels.

Source:
    Huber 1981, Robust Statistics; Efron and Tibshirani 1993, An Introduction to the Bootstrap,
    chapter 11 (jackknife). Redundancy: Tyo et al. 2006, Appl. Opt. 45, 5453.
"""

import numpy as np
from scipy.optimize import brentq

from polar_bayes.importers.stokes import polarizer_design


def restoring_exponent(
    light: np.ndarray, noise: np.ndarray, error: float, angles: np.ndarray, used: np.ndarray
) -> tuple[float, float] | None:
    """Estimate the exponent that makes counts linear, and its standard uncertainty.

    Args:
        light: Counts less the dark level, (angle, row, column).
        noise: Variance of the same.
        error: Relative error of every reading besides noise. It counts as 0.003 at least, which
            filling in and averaging leave where light changes quickly.
        angles: Of the analyzer, degree, (angle,).
        used: Pixels neither saturated nor dark, (row, column).

    Returns:
        Both numbers; None for a line of pixels, where angles are not redundant, light does not
        determine an exponent from 0.2 to 5, or residuals contradict that there is one.
    """
    used = used & (light > 0.0).all(axis=0)
    if len(angles) < 4 or used.sum() < 100 * (len(angles) - 3) or min(used.shape) < 2:
        return None
    relative = noise[:, used] / light[:, used].mean(axis=0) ** 2
    variances = relative, relative + max(error, 0.003) ** 2

    def beta(g: float) -> float:
        return _huber(*_regression(light, variances, angles, used, g)[:2])[0]

    if not beta(0.2) < 0.0 < beta(5.0):
        return None
    g = float(brentq(beta, 0.2, 5.0, xtol=1e-3))
    columns, response, noise_of_x = _regression(light, variances, angles, used, g)
    rows = columns.reshape(-1, columns.shape[-1])
    others, x = rows[:, :-1], rows[:, -1]
    rest = x - others @ np.linalg.lstsq(others.T @ others, others.T @ x, rcond=1e-12)[0]
    # Tiles divide the rectangle that holds all pixels used.
    row, column = (4 * (k - k.min()) // (np.ptp(k) + 1) for k in np.nonzero(used))
    tiles = [4 * row + column == tile for tile in np.unique(4 * row + column)]
    left = [_huber(columns[~tile], response[~tile])[0] for tile in tiles]
    slope = (beta(1.05 * g) - beta(0.95 * g)) / (0.1 * g)
    is_determined = rest @ rest > 20.0 * noise_of_x and slope > 0.0 and len(tiles) > 8
    if not is_determined or _huber(columns, response)[1] > 4.0:
        return None
    return g, float(np.sqrt((len(left) - 1) * np.var(left)) / slope)


def _regression(
    light: np.ndarray,
    variances: tuple[np.ndarray, np.ndarray],
    angles: np.ndarray,
    used: np.ndarray,
    g: float,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return regressors, x last, (pixel, redundancy, regressor), responses, and x's variance.

    All are over the errors; the variances are those of noise, and of noise and other errors.
    """
    A = polarizer_design(angles)
    B = np.linalg.svd(A)[0].T[3:]
    power = np.maximum(light / light[:, used].mean(), 1e-6) ** g
    S = np.linalg.pinv(A) @ power[:, used]
    m = 2.0 * A[:, 1:] @ (S[1:] / S[0])
    change = np.array(np.gradient(power, axis=(1, 2)))[:, :, used] / (0.5 * S[0])
    linear = np.concatenate([np.ones_like(S[:1]), S[1:] / S[:1]])
    each = np.einsum("ij,cn->njic", np.eye(len(B)), linear).reshape(S.shape[1], len(B), -1)
    shifts = np.einsum("jk,dkn->njdk", B, change).reshape(*each.shape[:2], -1)
    error = g * np.sqrt(B**2 @ variances[1]).T[..., None]
    columns = np.concatenate([each, shifts, (B @ m**2).T[..., None]], axis=-1) / error
    noise_of_x = (B**2 @ (4.0 * (g * m) ** 2 * variances[0])).T / error[..., 0] ** 2
    return columns, (B @ power[:, used] / (0.5 * S[0])).T / error[..., 0], float(noise_of_x.sum())


def _huber(columns: np.ndarray, response: np.ndarray) -> tuple[float, float]:
    """Return the last coefficient by Huber's M-estimator, and the mean squared residual."""
    weights = np.ones(len(response))
    for _ in range(8):
        weighted = (weights[:, None, None] * columns).reshape(-1, columns.shape[-1]).T
        gram = weighted @ columns.reshape(-1, columns.shape[-1])
        found = np.linalg.lstsq(gram, weighted @ response.ravel(), rcond=1e-12)[0]
        size = np.sqrt(np.mean((response - columns @ found) ** 2, axis=-1)) + 1e-12
        weights = np.minimum(1.0, 1.345 * np.median(size) / 0.6745 / size)
    return float(found[-1]), float(np.mean(size**2))
