"""The report of a map: what became of its pixels, pictures, tables, and coverage where known."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import xarray as xr

from polar_bayes.diagnostics.coverage import map_coverage, map_scalars
from polar_bayes.diagnostics.parameters import Scalar
from polar_bayes.errors import FitError, one_line
from polar_bayes.inference.result import provenance_of
from polar_bayes.pixels.opening import at_hand
from polar_bayes.pixels.stack import IMAGE
from polar_bayes.reporting import map_tables
from polar_bayes.reporting.maps import MOST_PIXELS, plot_maps
from polar_bayes.reporting.page import Picture, fill, picture
from polar_bayes.reporting.provenance import made_by, provenance_groups, swapped_sentence
from polar_bayes.reporting.text import spoken

TRUST = ("pareto_k", "approach", "status")
COLUMNS = 4
"""Parameters of one picture: more would be too small to read."""

BARE = "bare normal approximation of each pixel"
FITTED_BY = {
    "PixelLaplace": "normal approximation of each pixel, checked and corrected",
    "PixelTempering": "tempered draws of each pixel",
    "PixelNuts": "chains in each pixel",
}
UNCHECKED = (
    "The approximation was taken as it is (weighted=False): good means that the climb to the mode "
    "converged, and nothing says how far the numbers can be trusted."
)


def render_map(
    maps: xr.Dataset, truth: xr.Dataset | None = None, uncorrected: xr.Dataset | None = None
) -> str:
    """The page of a map as text."""
    found = map_scalars(maps)
    if any(name not in maps for name in TRUST):
        raise FitError("it holds no maps", where="report", mend="give what fit_pixels returns")
    _check_uncorrected(maps, truth, uncorrected)
    maps, provenance = at_hand(maps), _provenance(maps)
    cases = map_tables.count_cases(maps)
    said, is_enough = map_tables.headline(cases)
    is_bare, fitted_by = _is_bare(provenance), provenance.get("fitted_by", "PixelLaplace")
    size = " x ".join(f"{maps.sizes[dim]:,}" for dim in IMAGE)
    coverage = None if truth is None else _coverage(maps, found, truth, uncorrected)
    content: dict[str, Any] = {
        "kind": "Map report",
        "name": _name(maps, provenance, truth),
        "under": [
            f"{size} pixels. {made_by(provenance, BARE if is_bare else FITTED_BY[fitted_by])}",
            *filter(None, [swapped_sentence(provenance)]),
        ],
        "headline": said,
        "is_enough": is_enough,
        "said": [*map_tables.verdict(cases), *(coverage["said"] if coverage else [])],
        "cautions": [UNCHECKED] if is_bare else [],
        "pictures": list(_pictures(maps, found)),
        "status": map_tables.status_table(cases),
        "approach": map_tables.approach_table(cases),
        "parameters": map_tables.parameter_table(maps, found),
        "coverage": coverage,
        "groups": provenance_groups(provenance),
    }
    return fill("map.html.j2", content)


def _check_uncorrected(
    maps: xr.Dataset, truth: xr.Dataset | None, uncorrected: xr.Dataset | None
) -> None:
    if uncorrected is None:
        return
    where = "report: uncorrected"
    if truth is None:
        raise FitError(
            "it is compared with the truth only", where=where, mend="give truth=capture as well"
        )
    map_scalars(uncorrected)
    if any(uncorrected.sizes[dim] != maps.sizes[dim] for dim in IMAGE):
        raise FitError("it is of another image", where=where, mend="map the same capture")
    if not _is_bare(_provenance(uncorrected), otherwise=True):
        raise FitError(
            "it was corrected as well",
            where=where,
            mend="make it with PixelLaplace(weighted=False)",
        )


def _is_bare(provenance: Mapping[str, Any], *, otherwise: bool = False) -> bool:
    """Whether the approximation was taken as it is."""
    settings = provenance.get("settings") or {}
    return not settings["weighted"] if "weighted" in settings else otherwise


def _provenance(maps: xr.Dataset) -> dict[str, Any]:
    return provenance_of(maps)


def _name(maps: xr.Dataset, provenance: Mapping[str, Any], truth: xr.Dataset | None) -> str:
    """What the capture is called, or the file of the map."""
    file = Path(str(maps.encoding.get("source", "map"))).stem
    known = [(provenance.get("capture") or {}).get("name"), maps.attrs.get("name")]
    known += [None if truth is None else truth.attrs.get("name"), file]
    return one_line(str(next(filter(None, known))))


def _coverage(
    maps: xr.Dataset, found: Sequence[Scalar], truth: xr.Dataset, uncorrected: xr.Dataset | None
) -> dict[str, Any]:
    """Coverage of the maps, and of those that were not corrected, in words and numbers."""
    own = map_coverage(maps, truth)
    other = None if uncorrected is None else map_coverage(uncorrected, truth)
    counts = {"": own} if other is None else {"Corrected: ": own, "Uncorrected: ": other}
    said = map_tables.covered(found, own)
    if other is not None:
        bare = " ".join(map_tables.covered(found, other))
        said += [f"Without the correction: {bare[0].lower()}{bare[1:]}"] if bare else []
    return {
        "table": map_tables.coverage_table(found, own, other),
        "sentences": [
            f"{way}{each}" for way, table in counts.items() for each in map_tables.counted(table)
        ],
        "said": said,
    }


def _pictures(maps: xr.Dataset, found: Sequence[Scalar]) -> Iterator[Picture]:
    """Means, widths and trust, a few parameters and one wavelength at a time."""
    own = {scalar.name: set(scalar.index) for scalar in found}
    names = [name for name, dims in own.items() if dims <= {"wavelength"}]
    step = max(1, -(-max(maps.sizes[dim] for dim in IMAGE) // MOST_PIXELS))
    caption = (
        "Posterior means above, widths of their 95% intervals below them, and how far each pixel "
        "can be trusted. Gray: no answer. One pixel in a hundred lies beyond each end of a scale."
    )
    caption += f" Of every {step} x {step} pixels one is drawn." if step > 1 else ""
    for at in range(0, len(names), COLUMNS):
        some = names[at : at + COLUMNS]
        colored = [name for name in some if "wavelength" in own[name]]
        for turn, wavelength in enumerate(_wavelengths(maps) if colored else [None]):
            shown = some if turn == 0 else colored
            wanted = [f"{name}{ending}" for name in shown for ending in ("", "_quantile")]
            place = "" if wavelength is None else f" at {wavelength:g} nm"
            yield picture(
                plot_maps(maps[[*wanted, *TRUST]], wavelength=wavelength),
                f"Maps of {spoken(shown)}{place}, with Pareto k, approach and status",
                caption if at + turn == 0 else f"The same of {_words(shown)}{place}.",
            )


def _wavelengths(maps: xr.Dataset) -> list[float]:
    """The first, the middle and the last: a map may have hundreds."""
    known = maps["wavelength"].to_numpy().astype(float).tolist()
    return list(dict.fromkeys([known[0], known[len(known) // 2], known[-1]]))


def _words(names: Sequence[str]) -> str:
    return spoken([name.replace("_", " ") for name in names])
