"""Declarative models, one per file. Copy one, edit it, and pass it to `polar_bayes.fit`."""

from polar_bayes.namespace import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
