"""What a finished fit is worth: convergence, predictive checks, what the data determine."""

from polar_bayes.namespace import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
