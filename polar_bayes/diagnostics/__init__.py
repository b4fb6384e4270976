"""Diagnostics of a finished fit: convergence, model criticism, predictive checks, sensitivity."""

from polar_bayes.namespace import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
