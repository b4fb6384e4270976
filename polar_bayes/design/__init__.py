"""Experimental design: what a capture determines, and which views to take next."""

from polar_bayes.namespace import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
