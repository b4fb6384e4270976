"""Scenes for a capture: candidates, their comparison, and stacked posteriors."""

from polar_bayes.namespace import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
