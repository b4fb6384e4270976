"""The standard report: figures, tables and one self-contained page."""

from polar_bayes.namespace import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
