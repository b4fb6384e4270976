"""Coverage of maps against what can be counted by hand, or is known in closed form."""

import math

import dask.array
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from cases import each
from synthetic_maps import make_maps

import polar_bayes as pb
from polar_bayes.diagnostics import coverage
from polar_bayes.inference.batching import Status
from polar_bayes.maps import lazy as opening

HALF = np.full((40, 50), 0.5)
SPREAD = ((np.arange(2000) + 0.5) / 2000).reshape(40, 50)


def known(**truths: np.ndarray | float) -> xr.Dataset:
    dims = ("y", "x", "wavelength")
    return xr.Dataset(
        {f"true_{name}": (dims[: np.ndim(true)], true) for name, true in truths.items()},
        attrs={"name": "leaf"},
    )


def coverage_of(maps: xr.Dataset, roughness: np.ndarray | float) -> pd.Series:
    """The row of the roughness, whose truth is known."""
    return pb.diagnostics.map_coverage(maps, known(roughness=roughness)).loc["roughness"]


def wilson(share: float, count: int) -> tuple[float, float]:
    z = 1.959963984540054
    middle = (share + z**2 / (2 * count)) / (1 + z**2 / count)
    reach = z / (1 + z**2 / count)
    reach *= math.sqrt(share * (1 - share) / count + z**2 / (4 * count**2))
    return middle - reach, middle + reach


def test_a_truth_that_is_spread_like_the_posterior_is_held_as_often_as_the_interval_says() -> None:
    row = coverage_of(make_maps({"roughness": HALF}), SPREAD)
    assert row[["unknown", "masked", "unanswered", "answered"]].tolist() == [0, 0, 0, 2000]
    for claimed in (50, 80, 95):
        assert row[f"held_{claimed}"] == row[f"held_{claimed}_of_read"] == claimed / 100
        ends = row[f"held_{claimed}_low"], row[f"held_{claimed}_high"]
        np.testing.assert_allclose(ends, wilson(claimed / 100, 2000), rtol=1e-12)
    half = coverage_of(make_maps({"roughness": HALF}, width=0.5), SPREAD)
    assert [half[f"held_{each}"] for each in (50, 80, 95)] == [0.25, 0.4, 0.475]


@pytest.mark.thorough
def test_ends_count_as_inside_in_the_precision_of_the_map() -> None:
    """0.3 in double precision lies below 0.3 in single precision."""
    maps = make_maps({"roughness": np.array([[0.3]])}, width=0.0)
    assert float(maps["roughness"][0, 0]) > 0.3
    assert coverage_of(maps, 0.3)["held_50"] == 1.0


def test_pixels_without_an_answer_are_counted_and_never_held() -> None:
    count = len(Status)
    status = np.array([list(Status), [Status.GOOD] * count])
    true = np.full((2, count), 0.5)
    true[1, -2:] = 9.0, np.nan
    row = coverage_of(make_maps({"roughness": np.full((2, count), 0.5)}, status=status), true)
    # Good: one of the first row and all but one of the second, one of whose truths lies outside.
    counts = [1, 1, count - 2, count]
    assert row[["unknown", "masked", "unanswered", "answered"]].tolist() == counts
    assert row["held_95"] == (count - 1) / count
    assert row["held_95_of_read"] == (count - 1) / (2 * count - 2)


@pytest.mark.thorough
def test_without_answers_there_is_no_share() -> None:
    status = np.full(HALF.shape, Status.NOT_CONVERGED)
    row = coverage_of(make_maps({"roughness": HALF}, status=status), 0.5)
    assert row["unanswered"] == HALF.size
    assert row[["held_50", "held_50_low", "held_50_high"]].isna().all()
    assert row["held_50_of_read"] == 0.0


def test_every_wavelength_has_a_row_and_truths_may_have_fewer_axes() -> None:
    index = np.stack([HALF, HALF + 1.0], axis=-1)
    maps = make_maps(
        {"refractive_index": index, "roughness": HALF, "concentration_scale": HALF},
        wavelengths=(450.0, 650.0),
    )
    truth = xr.Dataset(
        {
            "true_refractive_index": ("wavelength", [0.5, 0.5]),
            "true_roughness": (("x", "y"), SPREAD.T),
            "true_albedo": 0.3,
        },
        coords={"wavelength": [450.0, 650.0]},
    )
    found = pb.diagnostics.map_coverage(maps, truth)
    assert list(found.index) == ["roughness", "refractive_index[450]", "refractive_index[650]"]
    assert found["held_95"].tolist() == [0.95, 1.0, 0.0]


@pytest.mark.thorough
def test_the_image_may_be_read_in_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    maps = make_maps({"roughness": HALF})
    whole = coverage_of(maps, SPREAD)
    monkeypatch.setattr(coverage, "CHUNK", 333)
    pd.testing.assert_series_equal(coverage_of(maps, SPREAD), whole)


@pytest.mark.thorough
def test_maps_that_are_still_to_be_computed_are_computed_once(monkeypatch):
    maps, calls = make_maps({"roughness": HALF}), []

    def late(block: np.ndarray) -> np.ndarray:
        calls.append(block.shape)
        return block

    quantile = maps["roughness_quantile"]
    chunks = dask.array.from_array(quantile.to_numpy(), chunks=(7, 20, 50))
    lazy = maps.assign(roughness_quantile=(quantile.dims, chunks.map_blocks(late, meta=chunks)))
    assert coverage_of(lazy, SPREAD)["held_95"] == 0.95
    assert calls == [(7, 20, 50)] * 2
    monkeypatch.setattr(opening, "MOST_BYTES", 1000)
    with pytest.raises(pb.FitError, match="in chunks and take 0 GB; write them with to_zarr"):
        coverage_of(lazy, SPREAD)


DIFFER = r"different axes \(y 50 x x 40 and y 40 x x 50\)"


@each(
    ("truth", "error", "words"),
    [
        ({"albedo": 0.3}, pb.CaptureError, "leaf: it states the truth of no parameter"),
        (
            {"roughness": SPREAD.T},
            pb.CaptureError,
            DIFFER,
        ),
        (None, pb.FitError, "it holds no maps"),
    ],
)
def test_what_does_not_fit_is_refused(truth, error, words) -> None:
    maps = make_maps({"roughness": HALF}) if truth else xr.Dataset()
    with pytest.raises(error, match=words):
        pb.diagnostics.map_coverage(maps, known(**truth or {"roughness": 0.5}))
