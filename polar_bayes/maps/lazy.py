"""Lazily opened images and maps; a damaged part of a file gives an error of one line."""

import os
from pathlib import Path
from typing import Any

import lazy_loader
import numpy as np
import pandas as pd
import xarray as xr
from scipy.stats import binomtest
from xarray.backends import BackendArray
from xarray.core import indexing

from polar_bayes.capture.files import load_capture
from polar_bayes.errors import CaptureError, FitError, PolarBayesError
from polar_bayes.inference.batching import IMAGE, Status, cut
from polar_bayes.inference.files import in_present_names
from polar_bayes.inference.result import PROVENANCE, provenance_of
from polar_bayes.numerics.psis import LEVELS
from polar_bayes.observation.data import READINGS
from polar_bayes.paths import as_path
from polar_bayes.physics.input_quantities import quantity_of
from polar_bayes.physics.scene import MATERIAL_PARAMETERS

zarr = lazy_loader.load("zarr")  # 0.1 s that results of other kinds need not wait for

DISAGREEMENT = 3.1
"""Information matrix test (standard normal) that one in a thousand correct models exceeds."""

UNKNOWN = -1
"""Value in chunks that are not written: no check gives both a caution and a problem."""

MOST_BYTES = 2**31
"""Largest size of maps in chunks (Dask) that are loaded into memory."""

REQUEST = "request_sha256"
"""Root attribute with the fingerprint of the request, present from the beginning."""

FINISHED = "capture_sha256"
"""Root attribute with the digest of the readings, written last: only finished maps have it."""

COPY = "copy the store again, or make the map again"


def open_capture(path: str | os.PathLike[str]) -> xr.Dataset:
    """Open a capture; values in a Zarr store are read when they are needed.

    Args:
        path: A netCDF file, or the folder of a Zarr store (its name ends in .zarr).

    Returns:
        The capture; that of a Zarr store is not validated.

    Raises:
        CaptureError: It cannot be read; with a Zarr store also later, when values are read.
    """
    path = as_path(path, "capture")
    if path.suffix != ".zarr":
        return load_capture(path)
    if not path.is_dir():
        raise CaptureError("there is no such store", where=str(path), hint="check the path")
    image = _open_store(path, CaptureError, "write it again with to_zarr", decode_times=False)
    for name, variable in image.variables.items():
        if variable.dtype.kind not in "biufUOT":
            what = f"it holds {variable.dtype.name}, neither numbers nor flags"
            raise CaptureError(what, where=f"{path}: {name}", hint="write it again with to_zarr")
    image.attrs.setdefault("name", path.stem)
    return image


def check_whole(path: Path) -> None:
    """Refuse a store with missing chunks, which would be read as missing readings."""
    for name in READINGS:
        if path.suffix != ".zarr" or not (path / name).is_dir():
            continue
        missing, chunks = _missing(path / name, CaptureError)
        if missing:
            what = f"{missing} of {chunks} chunks are missing"
            hint = "copy the store again, or write it again with to_zarr"
            raise CaptureError(what, where=f"{path}: {name}", hint=hint)


def open_map(path: str | os.PathLike[str]) -> xr.Dataset:
    """Open the maps of a Zarr store, whose values are read when they are needed.

    Args:
        path: What `polar_bayes.maps.map_file` or `polar-bayes map` wrote.

    Returns:
        The maps. Where a chunk is lost, pixels are not fitted (`polar_bayes.maps.count_pixels`).

    Raises:
        CaptureError: It is no path.
        FitError: There is no such store, it is not finished, or it holds no maps; later, when
            values are read: a chunk is damaged.
    """
    store = as_path(path, "map")
    where = str(store)
    if not store.is_dir():
        raise FitError("there is no such store", where=where, hint="check the path")
    maps = in_present_names(_open_store(store, FitError, "make the map again"))
    if PROVENANCE not in maps.attrs or "status" not in maps:
        raise FitError("it holds no maps", where=where, hint="give what `polar-bayes map` wrote")
    if REQUEST in maps.attrs and FINISHED not in maps.attrs:
        hint = "wait, or go on with `polar-bayes map --resume`"
        raise FitError("it is not finished", where=where, hint=hint)
    _check_maps(maps, store)
    return maps


def _check_maps(maps: xr.Dataset, store: Path) -> None:
    """Refuse metadata that do not describe maps."""
    try:
        provenance_of(maps)
    except FitError as error:
        raise FitError("its provenance cannot be read", where=str(store), hint=COPY) from error
    if "quantile" in maps.dims and not np.array_equal(maps["quantile"], LEVELS):
        raise FitError("its levels are not those of a map", where=f"{store}: quantile", hint=COPY)
    for name, variable in maps.variables.items():
        where, is_flag = f"{store}: {name}", name in ("status", "method", "criticism")
        if variable.dtype.kind not in ("iu" if is_flag else "iufUOT"):
            what = f"it holds {variable.dtype.name}, which no map does"
            raise FitError(what, where=where, hint=COPY)
        mean = str(name).removesuffix("_sd").removesuffix("_quantile").removesuffix("_slope")
        own = set(maps[mean].dims) if mean in maps else set(IMAGE)
        if (
            name in maps.data_vars
            and not set(IMAGE) <= set(variable.dims) - {"quantile", "shared"} == own
        ):
            raise FitError("its axes are not those of a map", where=where, hint=COPY)
        if is_flag and not _has_meanings(variable):
            raise FitError("its flags have no meanings", where=where, hint=COPY)
        is_ours = REQUEST in maps.attrs  # to_zarr of a user leaves out chunks of zeros
        if is_ours and name in maps.coords and _missing(store / str(name), FitError)[0]:
            raise FitError("its values are missing", where=where, hint=COPY)


def _has_meanings(flags: xr.Variable) -> bool:
    """Return whether every value of a flag has a meaning."""
    meanings = str(flags.attrs.get("flag_meanings", "")).split()
    numbered = flags.attrs.get("flag_values", list(range(len(meanings))))
    values = flags.attrs.get("flag_masks", numbered)
    listed = list(values) if isinstance(values, list | tuple | np.ndarray) else [values]
    are_whole = all(isinstance(value, int | np.integer) for value in listed)
    return 0 < len(meanings) == len(listed) and are_whole


def _missing(array: Path, error: type[PolarBayesError]) -> tuple[int, int]:
    """Count the missing chunks of an array, and all its chunks."""
    try:
        opened = zarr.open_array(array, mode="r")
        return opened.nchunks - opened.nchunks_initialized, opened.nchunks
    except Exception as cause:  # the libraries below raise nearly every type for a broken store
        what = "it cannot be read as Zarr"
        hint = "copy the store again, or write it again"
        raise error(what, where=f"{array.parent}: {array.name}", hint=hint) from cause


def _open_store(path: Path, error: type[PolarBayesError], hint: str, **options: Any) -> xr.Dataset:
    """Open a Zarr store lazily; errors name the broken chunk of a variable."""
    where = str(path)
    try:
        opened = xr.open_dataset(path, engine="zarr", consolidated=False, cache=False, **options)
    except Exception as cause:  # the libraries below raise nearly every type for a broken store
        raise error("it cannot be read as Zarr", where=where, hint=hint) from cause
    for name, variable in opened.variables.items():
        if name not in opened.xindexes:
            guarded = _Guarded(variable.copy(deep=False), f"{where}: {name}", error, hint)
            variable.data = indexing.LazilyIndexedArray(guarded)
    return opened


class _Guarded(BackendArray):
    """A variable of a store; errors name the chunk that cannot be read."""

    def __init__(
        self, variable: xr.Variable, where: str, error: type[PolarBayesError], hint: str
    ) -> None:
        self.shape, self.dtype = variable.shape, variable.dtype
        self._variable, self._where, self._error, self._hint = variable, where, error, hint

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        return indexing.explicit_indexing_adapter(
            key, self.shape, indexing.IndexingSupport.OUTER, self._read
        )

    def _read(self, key: tuple) -> np.ndarray:
        try:
            return self._variable[key].to_numpy()
        except Exception as cause:  # codecs raise nearly every type for a broken chunk
            parts = zip(self._variable.dims, key, self.shape, strict=True)
            ranges = [f"{dim}={_range(part, n)}" for dim, part, n in parts if dim in IMAGE]
            region = f"[{', '.join(ranges)}]" if ranges else ""
            raise self._error(
                f"it cannot be read ({cause})", where=f"{self._where}{region}", hint=self._hint
            ) from cause


def _range(part: slice | np.ndarray | int, length: int) -> str:
    """Format the requested range of an axis."""
    if isinstance(part, slice):
        return "{}:{}".format(*part.indices(length))
    return str(part) if np.ndim(part) == 0 else f"{np.min(part)}:{np.max(part) + 1}"


def ensure_loaded(maps: xr.Dataset) -> xr.Dataset:
    """Load maps in chunks (Dask), which would otherwise be fitted again at each access."""
    # Maps in chunks (Dask) would be fitted again at each access, so they are computed once.
    if not any(variable.chunks for variable in maps.variables.values()):
        return maps
    if maps.nbytes > MOST_BYTES:
        what = f"these maps are in chunks and take {maps.nbytes / 2**30:.0f} GB"
        hint = "write them with to_zarr, if they are not yet, and open them with open_map"
        raise FitError(what, where="maps", hint=hint)
    return maps.compute()


# --- Pixels ---------------------------------------------------------------------------------------

CHUNK = 65536
"""Pixels of a chunk of a store, which are read together."""

ANSWERED = (Status.GOOD, Status.CONTRADICTED)
"""Statuses of pixels that have numbers from their model."""


def count_pixels(maps: xr.Dataset) -> dict[str, int]:
    """Count the pixels of each status.

    Args:
        maps: Of `fit_pixels`, or opened from a store.

    Returns:
        How many are good, masked, with too few views, not converged, not trusted, contradicted by
        their readings and not fitted: those whose chunk is lost, or whose numbers are not finite
        though they have an answer.

    Raises:
        FitError: It holds no `status`.
    """
    if "status" not in maps:
        raise FitError(
            "it holds no maps", where="count_pixels", hint="give what fit_pixels returns"
        )
    counts = dict.fromkeys(Status, 0)
    for region in cut(maps, CHUNK):
        found = checked_status(maps.isel(region)).to_numpy()
        for each in Status:
            counts[each] += int(np.sum(found == each))
    return {each.name.lower().replace("_", " "): count for each, count in counts.items()}


def count_criticism(maps: xr.Dataset) -> pd.DataFrame:
    """Count the pixels in which each check found a contradiction to the model.

    Args:
        maps: Of `fit_pixels`, or opened from a store.

    Returns:
        A row for each check ("priors", "noise", "residuals" and "bounds") and for all together
        ("any"), columns caution, problem and not computed. A pixel with a problem is contradicted.
        Empty for maps of earlier versions, which were not checked.

    Raises:
        FitError: It holds no `status`.
    """
    columns = ["caution", "problem", "not computed"]
    if "criticism" not in maps:
        return pd.DataFrame(columns=columns, dtype=int)
    attrs = maps["criticism"].attrs
    words = (name.replace("_", " ").partition(" ") for name in attrs["flag_meanings"].split())
    names = [(check, level) for check, _, level in words]
    masks = dict(zip(names, np.asarray(attrs["flag_masks"]), strict=True))
    for level in columns:
        masks["any", level] = sum(mask for name, mask in masks.items() if name[1] == level)
    checks = list(dict.fromkeys(check for check, _ in masks))
    table = pd.DataFrame(0, index=checks, columns=columns)
    for region in cut(maps, CHUNK):
        block = maps[["status", "criticism", *_answers(maps)]].isel(region).load()
        has_answer = checked_status(block).isin(ANSWERED)
        flags = block["criticism"].where(has_answer, 0).to_numpy()
        for (check, level), mask in masks.items():
            table.loc[check, level] += int(np.sum((flags & mask) != 0))
    return table


def criticism_sentences(maps: xr.Dataset) -> list[str]:
    """State how many pixels contradict the model or give a caution, by check."""
    table, sentences = count_criticism(maps), []
    for level, one, several in (
        ("problem", "pixel is contradicted by its", "pixels are contradicted by their"),
        ("caution", "pixel has a caution from its", "pixels have a caution from their"),
    ):
        counts = table[level]
        if total := int(counts.get("any", 0)):
            by = [f"{n:,} by {check}" for check, n in counts.drop("any").items() if n]
            phrase = one if total == 1 else several
            sentences.append(f"{total:,} {phrase} readings: {', '.join(by)}.")
    if left := int(table["not computed"].get("any", 0)):
        sentences.append(
            f"The residuals of {left:,} pixel{'s' if left > 1 else ''} were not checked: there are "
            "too few readings, or the method searched for no mode."
        )
    return sentences


def shared_parameters(maps: xr.Dataset) -> pd.DataFrame:
    """Return the posterior of the parameters that all pixels share.

    Args:
        maps: Of `fit_pixels`, or opened from a store.

    Returns:
        A row for each shared parameter: quantiles q2.5, q50 and q97.5 (unit of the parameter), the
        number of pixels from which it was estimated, and `disagreement`: a standard normal number
        where all pixels have one value, and large where they have several (information matrix
        test, White 1982). Empty where each pixel has parameters of its own.

    Raises:
        FitError: The provenance of the map cannot be read.
    """
    rows = {}
    for name, found in (provenance_of(maps).get("shared") or {}).items():
        low, middle, high = (found["quantiles"][str(level)] for level in (0.025, 0.5, 0.975))
        rows[name] = [low, middle, high, found["pixels"], found["disagreement"]]
    columns = ["q2.5", "q50", "q97.5", "pixels", "disagreement"]
    return pd.DataFrame.from_dict(rows, orient="index", columns=columns)


def start_sentences(maps: xr.Dataset) -> list[str]:
    """State the number of starts per pixel, and how a sample determined it."""
    provenance = provenance_of(maps)
    compared, settings = provenance.get("starts_compared"), provenance.get("settings") or {}
    if not compared:
        return []
    missed, pixels = compared["missed"], compared["pixels"]
    low, high = binomtest(missed, pixels).proportion_ci(method="wilson")
    return [
        f"Of {pixels} pixels drawn at random, {missed} (95% interval {100 * low:.1f} to "
        f"{100 * high:.1f}%) look good from one start though others find another mode that counts; "
        f"all pixels were searched from {settings['starts']}."
    ]


def shared_cautions(maps: xr.Dataset) -> list[str]:
    """Caution against shared parameters on which the pixels disagree."""
    found, provenance = shared_parameters(maps), provenance_of(maps)
    own, carried = provenance.get("not_shared") or {}, provenance.get("carried") or {}
    cautions = []
    for name in own.get("names", ()):
        has = "intervals contain its standard uncertainty"
        does = has if name in carried else "each pixel has its own"
        cautions.append(
            f"{name}: one value should serve the whole image, but {own['reason']}, so that "
            f"{does} instead. The scene may lack a part that the image shows."
        )
    return cautions + [
        f"{name} is shared by all pixels, and they do not agree about it (information matrix test "
        f"{row['disagreement']:.1f}, above {DISAGREEMENT:g} once in a thousand right models): "
        "intervals may be too narrow. Leave it out of shared=."
        for name, row in found[found["disagreement"] > DISAGREEMENT].iterrows()
    ]


def setup_shares(maps: xr.Dataset) -> pd.DataFrame:
    """Return how much of the variance of an image's pixels errors of the set-up make.

    Args:
        maps: Of `fit_pixels`, or opened from a store, which is read block by block.

    Returns:
        A row for each parameter, and a column for each input quantity that moves all pixels alike:
        the sum of its contributions to the variance over that of the variances of all pixels with
        an answer. Empty where the set-up has none.

    Raises:
        FitError: The provenance of the map, or a chunk, cannot be read.
    """
    quantities = list(provenance_of(maps).get("carried") or {})
    names = map_parameters(maps) if quantities else []
    parts, whole = np.zeros((len(names), len(quantities))), np.zeros((len(names), 1))
    for place in cut(maps, CHUNK) if names else ():
        block = maps.isel(place)
        good = checked_status(block) == Status.GOOD
        for row, name in enumerate(names):
            slope = block[f"{name}_slope"].sel(shared=quantities).where(good).astype(float)
            sd = block[f"{name}_sd"].where(good).astype(float)
            parts[row] += (slope**2).sum([d for d in slope.dims if d != "shared"]).to_numpy()
            whole[row] += float((sd**2).sum())
    share = np.divide(parts, whole, out=np.full(parts.shape, np.nan), where=whole > 0.0)
    return pd.DataFrame(share, names, quantities)


def setup_sentences(maps: xr.Dataset) -> list[str]:
    """State what errors of the set-up contribute to the intervals of the material."""
    shares = setup_shares(maps)
    shares = shares.loc[[name for name in MATERIAL_PARAMETERS if name in shares.index]].dropna()
    if shares.empty:
        return []
    parts = [
        f"{row.sum():.0%} of that of {name} (most by {quantity_of(row.idxmax())})"
        for name, row in shares.iterrows()
    ]
    return [
        "Intervals include errors of the set-up, which are the same in all pixels. They make up a "
        f"part of the variance of pixels: {', '.join(parts)}."
    ]


def map_parameters(maps: xr.Dataset) -> list[str]:
    """Return names of the parameters that have a map."""
    return [str(name) for name in maps.data_vars if f"{name}_quantile" in maps]


def checked_status(maps: xr.Dataset) -> xr.DataArray:
    """Return statuses in memory; pixels with an answer but no numbers count as not fitted."""
    # A chunk that was lost from a store reads as not a number, or as a flag that is not known.
    answers = _answers(maps)
    here = maps[["status", *answers, *(["criticism"] if "criticism" in maps else [])]].load()
    is_known = xr.ones_like(here["status"], dtype=bool)
    for name in answers:
        is_finite = abs(here[name]) < np.inf
        is_known &= is_finite.all([dim for dim in is_finite.dims if dim not in IMAGE])
    if "criticism" in here:
        is_known &= here["criticism"] != UNKNOWN
    is_hole = here["status"].isin(ANSWERED) & ~is_known
    return here["status"].where(~is_hole, Status.NOT_FITTED).astype(here["status"].dtype)


def _answers(maps: xr.Dataset) -> list[str]:
    """Return names of the maps that are finite where a pixel has an answer."""
    return [
        f"{name}{ending}"
        for name in map_parameters(maps)
        for ending in ("", "_sd", "_quantile")
        if f"{name}{ending}" in maps
    ]
