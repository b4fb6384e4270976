"""Numbers as text, with the digits that they deserve."""

import math
from collections.abc import Iterable, Sequence

DASH = "\N{EN DASH}"


def numbers(values: Iterable[float], scale: float) -> list[str]:
    """Numbers with as many decimals as show two digits of the scale (three if it begins with 1)."""
    decimals = 3
    if math.isfinite(scale) and scale > 0.0:
        decimals = min(max(1 - math.floor(math.log10(scale / 2.0)), 0), 8)
    # Adding zero turns a rounded -0.0 into 0.0.
    return [
        f"{round(value, decimals) + 0.0:.{decimals}f}" if math.isfinite(value) else DASH
        for value in values
    ]


def interval(low: float, high: float, scale: float | None = None) -> str:
    """`[1.44, 1.52]`, with the digits of the scale (by default a quarter of its width)."""
    if not math.isfinite(high - low):
        return DASH
    return f"[{', '.join(numbers([low, high], (high - low) / 4.0 if scale is None else scale))}]"


def percent(share: float) -> str:
    """`12%`; one digit more below 10%."""
    if not math.isfinite(share):
        return DASH
    return f"{share:.1%}" if share < 0.0995 else f"{share:.0%}"


def or_dash(value: float, form: str) -> str:
    """A number in the given format, or a dash."""
    return form.format(value) if math.isfinite(value) else DASH


def spoken(names: Sequence[str]) -> str:
    """`a, b and c`."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
