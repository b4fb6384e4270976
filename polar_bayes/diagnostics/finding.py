"""The outcome of one check of a model, and the words that all of them share."""

import dataclasses
import math
from collections.abc import Iterable

from polar_bayes.inference.checks import level

MAX_LISTED = 4


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
    """The outcome of a check with a p-value, from the level `least` to the level `most`."""
    found = level(p_value)
    if found in LEVELS:
        found = max(min(found, most, key=LEVELS.index), least, key=LEVELS.index)
    return Finding(found, p_value, statistic, "" if found == "passed" else sentence)


def p_text(p_value: float) -> str:
    """`p = 0.012`."""
    return "p < 1e-6" if p_value < 1e-6 else f"p = {p_value:.2g}"


def listed(items: Iterable[str]) -> str:
    """The first items, and how many more there are: `roughness 1.08, exposure 1.03 and 2 more`."""
    items = list(items)
    more = len(items) - MAX_LISTED
    return ", ".join(items[:MAX_LISTED]) + (f" and {more} more" if more > 0 else "")
