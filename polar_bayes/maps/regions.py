r"""Means of regions of a map, and their contrasts, including errors that pixels share.

Given the shared parameters, pixels are independent. With $u_k$ the standard score of shared
parameter k and $b_{ik} = dE[x_i]/du_k$, the mean of a region of N pixels has the variance

$$ \frac{1}{N^2} \sum_i \left(\sigma_i^2 - \sum_k b_{ik}^2\right) + \sum_k \bar b_k^2 . $$
"""

import os
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pandas as pd
import xarray as xr
from arviz_base import xarray_sel_iter
from arviz_base.labels import BaseLabeller
from scipy.special import ndtri

from polar_bayes.errors import CaptureError, FitError
from polar_bayes.importers.detector import read_image
from polar_bayes.inference.batching import IMAGE, Status, cut
from polar_bayes.inference.result import CENTRAL_95, Provenance, provenance_of
from polar_bayes.maps.lazy import CHUNK, checked_status, map_parameters

MOST_OF_SETUP = 0.5
"""Share of errors of the set-up in the variance of a mean above which first order may not do."""


class _Sums(NamedTuple):
    """Sums of one parameter over the pixels of every region, each (region, ...)."""

    mean: np.ndarray
    own_variance: np.ndarray
    slope: np.ndarray  # (shared, region, ...)
    pull: np.ndarray
    pull_variance: np.ndarray

    @property
    def sd(self) -> np.ndarray:
        """Standard deviation of the mean, with shared errors counted once, (region, ...)."""
        return np.sqrt(self.own_variance + np.sum(self.slope**2, axis=0))

    @property
    def is_pull_known(self) -> np.ndarray:
        """True where pixels are more informative than their priors, (region, ...)."""
        return ~(np.sqrt(self.pull_variance) > self.sd)


def region_means(
    maps: xr.Dataset, labels: xr.DataArray | np.ndarray, *, against: object = None
) -> xr.Dataset:
    """Return the mean of each parameter over every region of a map, or contrasts of regions.

    The answer is that of the map's own model: pixels have priors of their own and are independent
    given what they share, which is counted once. Where pixels are alike, their priors all pull the
    same way, and the mean of many pixels shows it; the answer tells that pull. Such a region is
    better fitted as one capture, or as patches with `model="hierarchical"`.

    Args:
        maps: Of `polar_bayes.fit_pixels`, or opened from a store, which is read block by block.
        labels: The region of each pixel, (y, x): truth values (a mask), integers or texts. False,
            0 and the empty text are no region.
        against: Label of a region from which the others are subtracted.

    Returns:
        Over the axis `region`: each parameter (its mean over the pixels with an answer; with
        `against` the difference), `<name>_sd`, `<name>_interval` (its normal 95% interval, axis
        `bound`), `<name>_prior_pull` (by how much the priors of the pixels move that mean, if
        pixels are alike; NaN without a known prior, and where pixels are as wide as theirs), and
        the numbers `pixels` and `unanswered`. The attribute `cautions` lists sentences.

    Raises:
        FitError: It holds no maps, the labels do not fit, or no region has an answer.

    Source:
        The laws of total mean and variance; the pull is that of a normal prior and likelihood.
    """
    names = map_parameters(maps)
    if not names or "status" not in maps:
        hint = "give what fit_pixels returns"
        raise FitError("it holds no maps", where="region_means", hint=hint)
    number, found = _numbered(maps, labels)
    reference = None if against is None else _position(found, against)
    counts = np.zeros((2, len(found)), int)
    sums: dict[str, _Sums] = {}
    for place in cut(maps, CHUNK):
        block, region = maps.isel(place), number[place["y"], place["x"]].ravel()
        is_good = (checked_status(block) == Status.GOOD).transpose(*IMAGE).to_numpy().ravel()
        for at, which in enumerate((is_good, ~is_good)):
            counts[at] += np.bincount(region[which & (region >= 0)], minlength=len(found))
        use = np.flatnonzero(is_good & (region >= 0))
        for name in names:
            added = _sums_of(block, name, use, region[use], len(found))
            old = sums.get(name)
            sums[name] = added if old is None else _Sums(*map(np.add, old, added))
    if not counts[0].any():
        what = "no pixel of any region has an answer"
        raise FitError(what, where="region_means: labels", hint="see pb.maps.count_pixels")
    variables: dict[str, tuple] = {
        "pixels": (("region",), counts[0]),
        "unanswered": (("region",), counts[1]),
    }
    shown = np.delete(np.arange(found.size), [] if reference is None else reference)
    cautions, worst = list[str](), (0.0, "")
    for name, total in sums.items():
        means = _of_regions(total, counts[0], reference)
        sd = means.sd
        cautions += _cautions(name, found, means, shown)
        worst = max(worst, _error_share(maps, means, shown))
        interval = means.mean + ndtri(CENTRAL_95).reshape(-1, *[1] * sd.ndim) * sd
        attrs = {key: maps[name].attrs.get(key, "") for key in ("units", "symbol")}
        axes = ("region", *_own_dims(maps, name))
        variables[name] = (axes, means.mean, attrs)
        variables[f"{name}_sd"] = (axes, sd, attrs)
        variables[f"{name}_interval"] = (("bound", *axes), interval, attrs)
        pull = np.where(means.is_pull_known, means.pull, np.nan)
        variables[f"{name}_prior_pull"] = (axes, pull, attrs)
    cautions += _setup_cautions(provenance_of(maps), *worst)
    own = {dim: x for dim, x in maps.coords.items() if any(dim in v[0] for v in variables.values())}
    answer = xr.Dataset(variables, {**own, "region": found, "bound": list(CENTRAL_95)})
    return answer.isel(region=shown).assign_attrs(cautions=cautions)


def region_table(found: xr.Dataset) -> pd.DataFrame:
    """Return the results of `region_means` as a table.

    Args:
        found: Of `region_means`.

    Returns:
        A row for each region and parameter, with the columns `region`, `parameter`, `pixels`,
        `unanswered`, `mean`, `sd`, `q2.5`, `q97.5` and `prior_pull`. A parameter of several values
        has a row for each, named as in ArviZ: `absorption[550.0]`.
    """
    names = [str(name) for name in found.data_vars if f"{name}_interval" in found]
    tables = []
    for name, at, _ in xarray_sel_iter(found[names], skip_dims={"region"}):
        low, high = found[f"{name}_interval"].sel(at).transpose("bound", "region").to_numpy()
        columns = {
            "region": found["region"],
            "parameter": BaseLabeller().make_label_flat(name, at, at),
            "pixels": found["pixels"],
            "unanswered": found["unanswered"],
            "mean": found[name].sel(at),
            "sd": found[f"{name}_sd"].sel(at),
            "q2.5": low,
            "q97.5": high,
            "prior_pull": found[f"{name}_prior_pull"].sel(at),
        }
        tables.append(pd.DataFrame(columns))
    return pd.concat(tables).sort_values("region", kind="stable", ignore_index=True)


def load_labels(path: str | os.PathLike[str]) -> np.ndarray:
    """Read labels of regions from an image file.

    Args:
        path: An image with one channel of gray values, PNG or TIFF, or an array in a .npy file.

    Returns:
        Integers or truth values, (y, x).

    Raises:
        CaptureError: It cannot be read, has colors, or does not hold labels.
    """
    values, _ = read_image(path, "labels")
    if values.ndim != len(IMAGE) or values.dtype.kind not in "biu":
        what = f"it has values of shape {values.shape} and type {values.dtype}"
        hint = "save it with one channel of whole numbers: one gray value for each region"
        raise CaptureError(what, where=f"labels {path}", hint=hint)
    return values


def _numbered(maps: xr.Dataset, labels: xr.DataArray | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the number of each pixel's region, -1 for none, (y, x), and the labels."""
    if isinstance(labels, xr.DataArray) and set(labels.dims) == set(IMAGE):
        labels = labels.transpose(*IMAGE).to_numpy()
    values, shape = np.asarray(labels), tuple(maps.sizes[dim] for dim in IMAGE)
    if values.shape != shape or values.dtype.kind not in "biuU":
        what = f"they are {values.dtype} of shape {values.shape}"
        hint = f"give truth values, integers or texts, one for each of {shape} pixels"
        raise FitError(what, where="region_means: labels", hint=hint)
    found, number = np.unique(values, return_inverse=True)
    is_region = found != np.zeros((), found.dtype)
    if not is_region.any():
        hint = "give a label other than False, 0 or '' to some pixels"
        raise FitError("no pixel is in a region", where="region_means: labels", hint=hint)
    order = np.where(is_region, np.cumsum(is_region) - 1, -1)
    return order[number].reshape(shape), found[is_region]


def _position(labels: np.ndarray, against: object) -> int:
    """Return the index of the region with this label."""
    where = np.flatnonzero(labels == against)
    if not where.size:
        hint = f"give one of {', '.join(map(str, labels[:10]))}"
        raise FitError(f"no region has the label {against}", where="region_means", hint=hint)
    return int(where[0])


def _sums_of(
    block: xr.Dataset, name: str, use: np.ndarray, region: np.ndarray, count: int
) -> _Sums:
    """Return the contributions of the pixels `use` of a block to the sums of regions."""
    own = _own_dims(block, name)

    def values(name: str) -> np.ndarray:
        x = block[name].transpose(..., *IMAGE, *own).to_numpy().astype(float)
        lead = x.ndim - len(IMAGE) - len(own)
        return x.reshape(*x.shape[:lead], -1, *x.shape[lead + len(IMAGE) :]).take(use, axis=lead)

    def total(x: np.ndarray) -> np.ndarray:
        whole = np.zeros((count, *x.shape[1:]))
        np.add.at(whole, region, x)
        return whole

    mean, shares = values(name), f"{name}_slope" in block
    slope = values(f"{name}_slope") if shares else np.zeros((0, *mean.shape))
    variance = np.maximum(values(f"{name}_sd") ** 2 - np.sum(slope**2, axis=0), 0.0)  # its own
    prior_mean, prior_sd = (
        np.broadcast_to(block[name].attrs.get(f"prior_{part}", np.nan), mean.shape[1:] or (1,))
        for part in ("mean", "sd")
    )
    # A pixel that says nothing has the variance of the prior: its pull can be anything.
    gain = variance / np.maximum(prior_sd**2 - variance, 0.01 * prior_sd**2)
    return _Sums(
        total(mean),
        total(variance),
        np.reshape([total(each) for each in slope], (len(slope), count, *mean.shape[1:])),
        total(gain * (prior_mean - mean)),
        total(gain * variance),
    )


def _own_dims(maps: xr.Dataset, name: str) -> list[str]:
    """Return the axes of a parameter within a pixel."""
    return [str(dim) for dim in maps[name].dims if dim not in IMAGE]


def _of_regions(sums: _Sums, count: np.ndarray, reference: int | None) -> _Sums:
    """Return means instead of sums, minus those of the region of reference."""
    size = count.reshape(-1, *[1] * (sums.mean.ndim - 1)).astype(float)
    with np.errstate(divide="ignore", invalid="ignore"):  # regions without an answer are NaN
        mean, slope, pull = (x / size for x in (sums.mean, sums.slope, sums.pull))
        variance, spread = (x / size**2 for x in (sums.own_variance, sums.pull_variance))
    if reference is not None:
        mean, pull = mean - mean[reference], pull - pull[reference]
        slope = slope - slope[:, reference, None]
        variance, spread = variance + variance[reference], spread + spread[reference]
    return _Sums(mean, variance, slope, pull, spread)


def _error_share(maps: xr.Dataset, found: _Sums, shown: np.ndarray) -> tuple[float, str]:
    """Return the largest share of the set-up in the variance of a mean, and its largest error."""
    carried = provenance_of(maps).get("carried") or {}
    if not carried:
        return 0.0, ""
    names = maps["shared"].to_numpy()
    is_error = np.isin(names, list(carried))
    with np.errstate(divide="ignore", invalid="ignore"):  # regions without an answer are NaN
        shares = (found.slope[is_error] ** 2 / found.sd**2)[:, shown]
    shares = np.nan_to_num(shares.reshape(len(shares), -1))
    at = np.argmax(shares.sum(axis=0))
    return float(shares[:, at].sum()), str(names[is_error][np.argmax(shares[:, at])])


def _setup_cautions(provenance: Provenance, share: float, error: str) -> Iterator[str]:
    """Caution against errors of the set-up that a map has to first order, or averages out."""
    shared = tuple(provenance.get("shared") or {})
    if share > MOST_OF_SETUP:
        yield (
            f"Errors of the set-up make up to {share:.0%} of the variance of these means, most by "
            f"{error}, and a map has them to first order only. Let the pixels determine that one, "
            f"by shared={(*shared, error)!r}, or measure it."
        )
    if alone := provenance.get("of_each_pixel"):
        yield (
            f"Each pixel has its own {', '.join(alone)}, where one value should serve the image. "
            "Its error averages out, so that intervals of these means may be too narrow. Let the "
            f"pixels determine it together, by shared={(*shared, *alone)!r}."
        )


def _cautions(name: str, labels: np.ndarray, found: _Sums, shown: np.ndarray) -> Iterator[str]:
    """Caution against regions whose intervals would be wrong if their pixels were alike."""
    pull, chance, sd = np.abs(found.pull), np.sqrt(found.pull_variance), found.sd
    # Where pixels are alike, a 95% interval that is moved by half an sd holds in 92%.
    is_moved = (pull > 0.5 * sd) & (pull > 3.0 * chance)
    is_known = found.is_pull_known
    for at in shown:
        if not np.all(is_known[at]):
            why = "its pixels are as wide as their priors, whose pull on the mean is not known"
        elif np.any(is_moved[at]):
            sds = np.max(pull[at] / sd[at])
            why = f"if its pixels are alike, their priors move the mean by {sds:.1f} sds"
        else:
            continue
        yield f"{name} of region {labels[at]}: {why}. Fit the region as one capture, or as patches."
