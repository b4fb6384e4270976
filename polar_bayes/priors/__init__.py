"""What is believed before any data: the table, what may replace a row, and how it reads."""

from polar_bayes.priors.describe import describe_prior
from polar_bayes.priors.resolve import (
    PriorTable,
    check_support,
    in_this_precision,
    resolve_priors,
)
from polar_bayes.priors.support import support_bounds
from polar_bayes.priors.table import PRIORS, RANGES, Beta

__all__ = [
    "PRIORS",
    "RANGES",
    "Beta",
    "PriorTable",
    "check_support",
    "describe_prior",
    "in_this_precision",
    "resolve_priors",
    "support_bounds",
]
