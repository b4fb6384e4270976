"""Methods that make draws of a posterior, a file an algorithm: a fit loads its own and no other."""

from polar_bayes.namespace import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
