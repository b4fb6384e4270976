"""Methods, each loaded when it is first used: a fit loads its own and no other."""

from polar_bayes.namespace import attach

__getattr__, __dir__, __all__ = attach("polar_bayes.inference", __file__)
