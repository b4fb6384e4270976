"""Optics in pure JAX: parameters and geometry in, brightness and polarization out."""

from polar_bayes.namespace import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
