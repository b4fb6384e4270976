"""Methods that draw from a posterior, one file per algorithm; a fit loads only its own."""

from polar_bayes.namespace import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
