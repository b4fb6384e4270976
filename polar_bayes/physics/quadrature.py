"""Nodes and weights of integrals from 0 to 1."""

import numpy as np


def unit_rule(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Legendre nodes and weights on (0, 1)."""
    node, weight = np.polynomial.legendre.leggauss(count)
    return 0.5 * (node + 1.0), 0.5 * weight


def squared_rule(count: int) -> tuple[np.ndarray, np.ndarray]:
    """The same in the square root: denser at 0, where light meets an interface at grazing."""
    node, weight = unit_rule(count)
    return node**2, 2.0 * node * weight
