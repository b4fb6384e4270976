"""From predicted to recorded: data as arrays, noise schedules, likelihood links."""

from polar_bayes.namespace import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
