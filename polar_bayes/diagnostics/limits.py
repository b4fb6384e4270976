"""Limits of the checks of a single fit, in one table.

Those by which the pixels of a map are judged as well are in `polar_bayes.inference.checks`.
"""

import dataclasses
import math


@dataclasses.dataclass(frozen=True)
class Limits:
    """Limits of the checks, in posterior sds unless a comment says otherwise."""

    # Prior probability beyond the posterior median of one parameter that is stated.
    prior_tail: float = 0.01
    # Factors by which the scatter exceeds its stated errors, or does not reach them, with
    # probability 97.5%.
    large_noise_factor: float = 3.0
    small_noise_factor: float = 1.0 / 3.0
    # Difference of a posterior mean without the discrepancy that counts.
    large_difference: float = 1.5
    # Difference of a posterior mean without what is absent up to which it is the same.
    same_mean: float = 0.5
    # Log Bayes factor up to which evidence is worth no more than a bare mention (Kass and Raftery).
    favored: float = math.log(3.0)
    # Log Bayes factor below which the readings speak strongly against an alternative.
    refuted: float = -math.log(20.0)
    # Shift by an alternative that leaves the 95% interval.
    outside: float = 1.96
    # Prior probability of the amplitudes of smooth errors that count as zero.
    near_zero: float = 0.1

    # Prior probability inside the posterior's 95% interval: normal ones, a third as wide, have
    # `determined`, those of three quarters of the width `partly`; one equal to its prior has 0.95.
    determined: float = 0.5
    partly: float = 0.85
    # Rate at which a posterior moves with the weight of its priors or readings.
    sensitive: float = 0.05

    # Error of an approximate mean, or of the log of an approximate sd, that is stated.
    large_correction: float = 0.1
    second_mode: float = 0.01
    # Standard errors by which the share in a tail must exceed that of chains: of twenty tails of
    # two right methods one does so in 0.5% of the fits.
    tail_errors: float = 3.5
    # Shares of readings that are masked or at the margin of their link, and of draws.
    masked: float = 0.25
    at_margin: float = 0.25
    deep_trees: float = 0.01
    # Of draws in single precision at the ends of their prior.
    rounding: float = 1e-6

    # Factor by which the set-up widens an interval that is worth a sentence.
    of_setup: float = 1.25

    replicates: int = 1000
    # Readings that the checks use; of more, evenly spaced ones.
    readings: int = 600
    # Share of the replicates at an end of their range beyond which the checks leave a reading out.
    cut_off: float = 0.05
    # Stated errors within which a reading is no outlier, however little the others scatter.
    stated_errors: float = 3.0
    # Degrees of freedom of the noise; with the most it is normal.
    freedom: tuple[float, float] = (2.5, 1000.0)
    # Draws may give a reading more than all of the information about itself.
    leverage: float = 0.999
    # Change of a posterior mean without one reading that counts.
    large_shift: float = 1.0
    # One minus the leverage of a reading from which the others know what it says.
    known_too: float = 0.2
    # Factor by which an interval would widen without a reading that is named as its source.
    alone: float = 2.0


LIMITS = Limits()
