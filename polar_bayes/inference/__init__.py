"""Inference: from a model and data to posterior draws."""

from polar_bayes.namespace import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
