"""The report's conclusions in plain sentences, each true of the numbers beside it."""

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import pandas as pd
import xarray as xr

from polar_bayes.diagnostics.parameters import Scalar
from polar_bayes.diagnostics.population import Population
from polar_bayes.diagnostics.predictive import PitBand, PredictiveCheck, pit_band
from polar_bayes.reporting.style import QUANTITIES, place_of, title_of

# --- Numbers as text, with the digits that they deserve -------------------------------------------


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


# --- The report's conclusions in plain sentences, each true of the numbers beside it --------------


# Two intervals whose widths differ by less than this are equally wide, as far as draws can tell.
EQUAL_WIDTHS = 0.05
MOST_PLACES = 6
PLURALS = {"patch": "patches", "material": "materials"}
HALF = 0.5

HEADLINES = {
    ("nuts", True): "The fit converged.",
    ("nuts", False): "The fit did not converge: do not use these numbers.",
    ("laplace", True): "The approximation raised no alarm.",
    ("laplace", False): "The approximation failed: do not use these numbers.",
    ("variational", True): "The guide raised no alarm.",
    ("variational", False): "The guide failed: do not use these numbers.",
    ("importance", True): "The weighted draws raised no alarm.",
    ("importance", False): "The weighted draws failed: do not use these numbers.",
    ("tempered", True): "The tempered draws raised no alarm.",
    ("tempered", False): "The tempered draws failed: do not use these numbers.",
    ("point", True): "Least squares met its tolerance.",
    ("point", False): "Least squares failed: do not use these numbers.",
}

OTHERS = {
    True: "The method raised no alarm.",
    False: "The method failed: do not use these numbers.",
}
"""Of a method of the user's own."""


def headline(method: str, converged: bool, cautions: Sequence[str]) -> str:
    """The verdict in one sentence."""
    text = HEADLINES.get((method, converged), OTHERS[converged])
    return f"{text} Mind the cautions." if converged and cautions else text


def determined(found: Sequence[Scalar], prior: pd.DataFrame, posterior: xr.Dataset) -> list[str]:
    """Which material parameters the data determine, and which they do not."""
    groups: dict[str, list[Scalar]] = {"determined": [], "partly": [], "not determined": []}
    for scalar in found:
        word = str(prior.loc[scalar.label, "verdict"]) if scalar.label in prior.index else ""
        if scalar.is_material and word in groups:
            groups[word].append(scalar)
    phrases = {
        "determined": "The data determine {}.",
        "partly": "The data determine only in part: {}. There the prior still matters.",
        "not determined": "The data do not determine {}. There the interval is mostly the prior's: "
        "do not quote it as a measurement.",
    }
    return [
        phrases[word].format(named(group, posterior)) for word, group in groups.items() if group
    ]


def varied(summary: pd.DataFrame, found: Sequence[Population], posterior: xr.Dataset) -> list[str]:
    """How much the members of each population differ, and where a new one would lie."""
    groups: dict[str, list[Population]] = {}
    for each in found:
        if np.isfinite(summary.loc[each.label, "between"]):
            groups.setdefault(each.name, []).append(each)
    return [_varied(summary, group, posterior) for group in groups.values()]


def _varied(summary: pd.DataFrame, group: Sequence[Population], posterior: xr.Dataset) -> str:
    first = group[0]
    # Members stand along one axis: what tells them apart is what they are called.
    dims = [dim for dim in first.members[0].index if dim not in first.location.index]
    member = dims[0] if len(dims) == 1 and dims[0] in PLURALS else "member"
    row = summary.loc[first.label]
    scale = (row["between_q97.5"] - row["between_q2.5"]) / 4.0
    between, low, high = numbers([row["between"], row["between_q2.5"], row["between_q97.5"]], scale)
    factor = "a factor of about" if first.scale == "log" else "about"
    words = _words(first.members[0], posterior)
    count = len(first.members)
    said = (
        f"Between the {count} {PLURALS.get(member, 'members')} the {words} varies by {factor} "
        f"{between} (95%: {low} to {high})"
    )
    # Of many colors the first and the last.
    shown = [group[0], group[-1]] if len(group) > 1 else [group[0]]
    ranges = []
    for each in shown:
        row = summary.loc[each.label]
        bounds = [row["new_q2.5"], row["new_q97.5"]]
        ends = spoken(numbers(bounds, (bounds[1] - bounds[0]) / 4.0))
        places = [place_of(dim, label) for dim, label in each.location.labels.items()]
        ranges.append(f"between {ends}{' at ' + spoken(places) if places else ''}")
    return f"{said}; a new {member} would lie {spoken(ranges)} (95%)."


def _words(scalar: Scalar, posterior: xr.Dataset) -> str:
    return title_of(scalar, posterior).partition(", ")[0]


def leaning(summary: pd.DataFrame, found: Sequence[Population], posterior: xr.Dataset) -> list[str]:
    """Whether the members' own readings or their population decide, population by population."""
    groups: dict[bool, list[str]] = {}
    for each in found:
        pooling = summary.loc[each.label, "pooling"]
        if np.isfinite(pooling):
            places = [place_of(dim, label) for dim, label in each.location.labels.items()]
            name = ", ".join([_words(each.members[0], posterior), *places])
            groups.setdefault(bool(pooling > HALF), []).append(f"{name} ({pooling:.2f})")
    phrases = {
        True: "For {} the population says more than the readings of a single member (pooling "
        "factor in brackets): quote such estimates as those of a member of this population.",
        False: "For {} the readings of a single member say more than the population (pooling "
        "factor in brackets).",
    }
    return [phrases[leans].format(spoken(names)) for leans, names in groups.items()]


def named(found: Sequence[Scalar], posterior: xr.Dataset) -> str:
    """Parameters in words: `roughness r and refractive index n at 450, 550 and 650 nm`."""
    groups: dict[str, list[Scalar]] = {}
    for scalar in found:
        groups.setdefault(title_of(scalar, posterior).partition(", ")[0], []).append(scalar)
    return spoken([f"{words}{_places(group, posterior)}" for words, group in groups.items()])


def _places(group: Sequence[Scalar], posterior: xr.Dataset) -> str:
    """` at 450 and 550 nm`, ` (material leaf, 450 nm; material fruit, 450 nm)` or nothing."""
    if not group[0].labels:
        return ""
    if list(group[0].labels) == ["wavelength"]:
        return f" at {spoken([scalar.labels['wavelength'] for scalar in group])} nm"
    if len(group) > 1 and len(group) * group[0].draws.size == posterior[group[0].name].size:
        return " (everywhere)"
    places = [
        ", ".join(place_of(dim, label) for dim, label in scalar.labels.items()) for scalar in group
    ]
    more = f"; {len(places) - MOST_PLACES} more" if len(places) > MOST_PLACES else ""
    return f" ({'; '.join(places[:MOST_PLACES])}{more})"


def expected(checks: Mapping[str, PredictiveCheck]) -> list[str]:
    """Whether the readings are distributed as the model expects, variable by variable."""
    sentences = []
    for check in checks.values():
        band = pit_band(check.loo.pit if check.loo else check.pit)
        name = QUANTITIES.get(check.name, check.name)
        if band is not None and band.rejects_uniformity:
            sentences.append(
                f"The readings of {name} are not distributed as the model expects: {shape(band)}. "
                "The intervals may be off."
            )
        elif band is not None:
            sentences.append(f"The readings of {name} are distributed as the model expects.")
        if check.loo and check.loo.unreliable:
            many = check.loo.unreliable > HALF * check.count
            sentences.append(
                f"Pareto k is above 0.7 for {check.loo.unreliable} of {check.count} readings of "
                f"{name}: "
                + (
                    "leaving one out cannot be imitated with these draws, so what the report says "
                    "about leaving out means little."
                    if many
                    else "they weigh so much that leaving them out cannot be imitated. Look at "
                    "them first."
                )
            )
    return sentences


def trust(method: str, cautions: Sequence[str], checks: Mapping[str, PredictiveCheck]) -> str:
    """Whether the intervals can be trusted, as far as one fit can tell."""
    if method == "point":
        return (
            "Standard errors are those of least squares: they know no prior and no range, so do "
            "not read them as intervals."
        )
    bands = [pit_band(check.loo.pit if check.loo else check.pit) for check in checks.values()]
    if cautions or any(band is not None and band.rejects_uniformity for band in bands):
        return "Trust the intervals with care: what speaks against them is said on this page."
    return (
        "Nothing here speaks against the intervals. How often such intervals hold the truth, a "
        "calibration of this layout shows."
    )


def shape(band: PitBand) -> str:
    """In which way the readings depart from the prediction, once the curve leaves its band."""
    above = np.flatnonzero(band.difference > band.upper)
    below = np.flatnonzero(band.difference < band.lower)
    if above.size and below.size:
        return f"they scatter {'more' if above[0] < below[0] else 'less'} than it says"
    return f"more of them lie {'low' if above.size else 'high'} than it says"


def overconfidence(
    compared: pd.DataFrame, found: Sequence[Scalar], posterior: xr.Dataset, what: str
) -> list[str]:
    """What to make of a fit that leaves out a part of the instrument."""
    gain = {
        s: 1.0 - compared.loc[s.label, "width_ratio"] for s in found if s.label in compared.index
    }
    narrower = {scalar: share for scalar, share in gain.items() if share > EQUAL_WIDTHS}
    others = [scalar for scalar in gain if scalar not in narrower]
    sentences = []
    if narrower:
        least, most = min(narrower.values()), max(narrower.values())
        by = f"{most:.0%}" if most - least < 0.01 else f"{least:.0%} to {most:.0%}"
        sentences.append(
            f"Without {what} the 95% {_interval_of(list(narrower), posterior)} "
            f"narrower by {by}. That is overconfident: the fit then counts errors of the "
            "instrument as knowledge about the material."
        )
    if others:
        sentences.append(
            f"Without {what} the 95% {_interval_of(others, posterior)} not narrower, as it "
            "happens; still, that fit has no room for such errors of the instrument and holds "
            "only if there are none."
        )
    misses = (compared["mean"] < compared["q2.5_without"]) | (
        compared["mean"] > compared["q97.5_without"]
    )
    apart = [scalar for scalar in gain if misses[scalar.label]]
    if apart:
        sentences.append(
            f"The two fits disagree on {named(apart, posterior)}: the interval without {what} "
            "does not contain the mean of this fit."
        )
    return [*sentences, f"Do not quote the numbers without {what}."]


def _interval_of(found: Sequence[Scalar], posterior: xr.Dataset) -> str:
    return f"interval{' of {} is' if len(found) == 1 else 's of {} are'}".format(
        named(found, posterior)
    )
