"""How a fit was made: what was chosen, what was swapped, and what was believed before."""

from collections.abc import Mapping, Sequence
from typing import Any

from polar_bayes.errors import one_line
from polar_bayes.reporting.tables import Row, fact_rows
from polar_bayes.reporting.text import spoken

HELD = " held fixed"
PRIOR = "prior of "
MARK = "swapped"
MOST_NAMED = 6


def made_by(provenance: Mapping[str, Any], method: str) -> str:
    """Scene, model, method and seed in one line."""
    said = {
        key: f"{key} {one_line(str(provenance[key]))}"
        for key in ("scene", "model", "seed")
        if provenance.get(key) is not None
    }
    parts = [said.get("scene", ""), said.get("model", ""), method, said.get("seed", "")]
    text = ", ".join(filter(None, parts))
    return f"{text[:1].upper()}{text[1:]}."


def swapped_sentence(provenance: Mapping[str, Any]) -> str:
    """What the user replaced, in one sentence."""
    if "swapped" not in provenance:
        return ""
    swapped = [str(name) for name in provenance["swapped"]]
    priors = [name.removeprefix(PRIOR) for name in swapped if name.startswith(PRIOR)]
    held = [name.removesuffix(HELD) for name in swapped if name.endswith(HELD)]
    parts = [f"the {n}" for n in swapped if not n.startswith(PRIOR) and not n.endswith(HELD)]
    if priors:
        parts.append(f"the prior{'s' if len(priors) > 1 else ''} of {_few(priors)}")
    said = [f"Swapped by the user: {spoken(parts)}." if parts else ""]
    said += [f"Held fixed: {_few(held)}." if held else ""]
    return (
        " ".join(filter(None, said)) or "Nothing was swapped: all parts and priors are as shipped."
    )


def provenance_groups(provenance: Mapping[str, Any]) -> list[tuple[str, list[Row]]]:
    """How the fit was made, in titled groups of name and text; what was swapped is marked."""
    keys = ["method", "settings", "model", "scene", "scene_parts", "seed", "precision"]
    keys += ["chain_method", "largest_view_zenith"]
    fit = {key.replace("_", " "): provenance[key] for key in keys if key in provenance}
    swapped = [str(name) for name in provenance.get("swapped") or ()]
    fit["swapped by the user"] = swapped or "nothing: all defaults"
    priors, links = provenance.get("priors") or {}, provenance.get("links") or {}
    timings = dict(provenance.get("timings") or {})
    if timings:
        timings["total"] = round(sum(timings.values()), 3)
    versions = {**(provenance.get("versions") or {}), **(provenance.get("machine") or {})}
    groups = {
        "Fit": fact_rows(fit, {"model", "scene"} & set(swapped), MARK),
        "Settings of the model": fact_rows(provenance.get("model_settings") or {}),
        "Readings": fact_rows(_counts(provenance.get("counts") or {})),
        "Capture": fact_rows(provenance.get("capture") or {}),
        "Priors": fact_rows(priors, {n for n in priors if f"{PRIOR}{n}" in swapped}, MARK),
        "Priors that stand in the model itself": fact_rows(provenance.get("declared") or {}),
        "Held fixed, by the model or around it": fact_rows(provenance.get("fixed") or {}),
        "Likelihood links": fact_rows(links, set(links) if "links" in swapped else (), MARK),
        "Seconds, compilation included": fact_rows(timings),
        "Versions": fact_rows(versions),
    }
    return [(title, rows) for title, rows in groups.items() if rows]


def _few(names: Sequence[str]) -> str:
    more = len(names) - MOST_NAMED
    return spoken([*names[:MOST_NAMED], *([f"{more} more"] if more > 0 else [])])


def _counts(counts: Mapping[str, Any]) -> dict[str, Any]:
    said = {"all": counts.get("views"), "fitted": counts.get("used")}
    said |= {"masked (valid=False)": counts.get("masked")}
    if None not in said.values():
        aside = counts["views"] - counts["masked"] - counts["used"]
        said["set aside (beyond the angle limit)"] = aside
    said["saturated"] = counts.get("saturated")
    margin = counts.get("at_margin") or {}
    said |= {f"{name} at the margin of its link": count for name, count in margin.items()}
    return {name: count for name, count in said.items() if count is not None}
