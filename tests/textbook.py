"""A smooth white plate in textbook formulas: NumPy only, nothing shared with the package."""

import numpy as np


def mirror_and_body(index: np.ndarray, zenith: np.ndarray) -> tuple[np.ndarray, ...]:
    """Fresnel's formulas: reflected s and p, and what a white body returns. Zenith in radian."""
    inside = np.sqrt(1.0 - (np.sin(zenith) / index) ** 2)
    s = ((np.cos(zenith) - index * inside) / (np.cos(zenith) + index * inside)) ** 2
    p = ((index * np.cos(zenith) - inside) / (index * np.cos(zenith) + inside)) ** 2
    through = 1.0 - 0.5 * (s + p)
    return s, p, np.cos(zenith) / np.pi * through * through


def plate_q(index: np.ndarray, fraction: np.ndarray, zenith: np.ndarray) -> np.ndarray:
    """Normalized Stokes q of a plate whose body has a share of the light."""
    s, p, body = mirror_and_body(index, zenith)
    return (1.0 - fraction) * 0.5 * (s - p) / ((1.0 - fraction) * 0.5 * (s + p) + fraction * body)
