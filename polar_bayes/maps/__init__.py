"""Many small posteriors at once: every pixel of an image is a fit of its own."""

from polar_bayes.namespace import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
