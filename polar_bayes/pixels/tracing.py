"""One thread at a time tells a model: see `polar_bayes.inference.tracing`."""

from polar_bayes.inference.tracing import TRACING, TracedOnce

__all__ = ["TRACING", "TracedOnce"]
