"""Accuracy against time: every method and setting on one capture."""

from polar_bayes.namespace import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
