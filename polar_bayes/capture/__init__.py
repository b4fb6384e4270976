"""Measurements: what a capture holds, and the doors through which it enters."""

from polar_bayes.namespace import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
