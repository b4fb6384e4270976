"""The outcome of one check of a model, and texts that all checks share."""

import dataclasses
import math
from collections.abc import Iterable, Sequence

from polar_bayes.inference.checks import level


@dataclasses.dataclass(frozen=True)
class Finding:
    """The outcome of one check: "passed", "note", "caution", "problem" or "not computed"."""

    level: str
    p_value: float = math.nan
    statistic: float = math.nan
    sentence: str = ""


LEVELS = ("passed", "note", "caution", "problem")


def judged_by(
    p_value: float, statistic: float, sentence: str, *, least: str = "passed", most: str = "problem"
) -> Finding:
    """Return the outcome of a check with a p-value: a problem, a caution, or passed."""
    found = level(p_value)
    if found in LEVELS:
        found = max(min(found, most, key=LEVELS.index), least, key=LEVELS.index)
    return Finding(found, p_value, statistic, "" if found == "passed" else sentence)


def p_text(p_value: float) -> str:
    """Format a p-value as `p = 0.012`."""
    return "p < 1e-6" if p_value < 1e-6 else f"p = {p_value:.2g}"


def join(names: Sequence[str]) -> str:
    """Join texts as `a, b and c`."""
    return " and ".join(filter(None, [", ".join(names[:-1]), *names[-1:]]))


def listed(items: Iterable[str], most: int = 4) -> str:
    """List the first items and count the others: `roughness 1.08, exposure 1.03 and 2 more`."""
    items = list(items)
    more = len(items) - most
    return ", ".join(items[:most]) + (f" and {more} more" if more > 0 else "")
