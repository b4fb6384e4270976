"""What the readings of one member say without its population, from draws with it."""

import math
from typing import NamedTuple

import numpy as np

STEPS = 100
SETTLED = 1e-10
LEAST_ERRORS = 2.0
NARROWEST = 1e-6


class Alone(NamedTuple):
    """One member without its population, on the scale on which the population is normal."""

    mean: float
    sd: float
    leaning: float


def estimate_alone(value: np.ndarray, location: np.ndarray, spread: np.ndarray) -> Alone:
    """Take a normal population out of the posterior draws of one of its members."""
    # A likelihood $\exp(b x - p x^2 / 2)$ of the member makes its draws, given location $\mu$ and
    # spread $s$ of the same draw,
    # $$ x | \mu, s \sim Normal(m, v), \qquad v = \frac{1}{p + s^{-2}}, \qquad m = v (b + \mu
    # s^{-2}) $$
    # The log density of all draws is concave in (b, p): Newton's method finds its maximum. So the
    # estimate is exact, up to Monte Carlo error, for any posterior of location and spread.
    center, unit = float(value.mean()), float(value.std())
    if not unit > 0.0:
        return Alone(math.nan, math.nan, math.nan)
    x, mu = (value - center) / unit, (location - center) / unit
    belief = np.maximum(spread / unit, NARROWEST) ** -2.0
    b, p = 0.0, max(1.0 - 1.0 / float(np.mean(1.0 / belief)), 0.1)
    floor = -0.99 * float(belief.min())
    for _ in range(STEPS):
        gradient, curvature = _derivatives(x, mu, belief, b, p)
        step = np.linalg.solve(curvature, gradient)
        # Halved until it stays where every variance is positive and the density does not fall.
        before = _log_density(x, mu, belief, b, p)
        while p + step[1] <= floor or (
            _log_density(x, mu, belief, b + step[0], p + step[1]) < before - 1e-9 * abs(before)
        ):
            step = step / 2.0
        b, p = b + step[0], p + step[1]
        if gradient @ step < SETTLED * x.size:
            break
    error = math.sqrt(np.linalg.inv(_derivatives(x, mu, belief, b, p)[1])[1, 1])
    leaning = float(np.mean(belief / (belief + max(p, 0.0))))
    if not p > LEAST_ERRORS * error:
        return Alone(math.nan, math.nan, leaning)
    return Alone(center + unit * b / p, unit / math.sqrt(p), leaning)


def _log_density(x: np.ndarray, mu: np.ndarray, belief: np.ndarray, b: float, p: float) -> float:
    """Of all draws, up to a constant."""
    variance = 1.0 / (p + belief)
    mean = variance * (b + mu * belief)
    return float(np.sum(-0.5 * (x - mean) ** 2 / variance - 0.5 * np.log(variance)))


def _derivatives(
    x: np.ndarray, mu: np.ndarray, belief: np.ndarray, b: float, p: float
) -> tuple[np.ndarray, np.ndarray]:
    """Gradient of the log density in (b, p), and minus its second derivatives."""
    variance = 1.0 / (p + belief)
    mean = variance * (b + mu * belief)
    gradient = np.array([np.sum(x - mean), 0.5 * np.sum(mean**2 + variance - x**2)])
    cross = -np.sum(mean * variance)
    square = np.sum(mean**2 * variance + 0.5 * variance**2)
    return gradient, np.array([[np.sum(variance), cross], [cross, square]])
