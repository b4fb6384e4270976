"""Do the intervals hold? Simulate from the prior, fit, and see where the truth stands."""

from polar_bayes.namespace import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
