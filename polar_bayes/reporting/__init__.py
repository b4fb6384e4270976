"""Reports: figures, tables and self-contained pages."""

from polar_bayes.namespace import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
