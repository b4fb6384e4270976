"""A smoothness prior between neighboring pixels, against dense matrices."""

import numpy as np
import pytest
import xarray as xr
from synthetic_maps import make_maps

import polar_bayes as pb
from polar_bayes.inference.batching import Status

ROWS, COLUMNS, SD, NEIGHBOR = 5, 6, 0.2, 0.1
NAME = "refractive_index"


@pytest.fixture
def maps() -> xr.Dataset:
    random, status = np.random.default_rng(0), np.full((ROWS, COLUMNS), Status.GOOD)
    status[1, 2], status[4, 0] = Status.NOT_TRUSTED, Status.MASKED
    means = 1.45 + SD * random.normal(size=(ROWS, COLUMNS))
    return make_maps({NAME: means}, width=SD * np.sqrt(12.0), status=status)


def dense(maps: xr.Dataset, slope: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Means and standard deviations of good pixels, and of one shared score behind them."""
    places = [tuple(at) for at in np.argwhere(maps["status"].to_numpy() == Status.GOOD)]
    count = len(places)
    b = np.zeros(count) if slope is None else np.array([slope[at] for at in places])
    own = np.diag(1.0 / (SD**2 - b**2))
    information = np.zeros((count + 1, count + 1))
    # Given the score u, pixel i is normal around m_i + b_i u; u is standard normal.
    information[:count, :count] = own
    information[:count, -1] = information[-1, :count] = -own @ b
    information[-1, -1] = 1.0 + b @ own @ b
    m = np.array([float(maps[NAME].to_numpy()[at]) for at in places])
    right = np.append(own @ m, -b @ own @ m)
    for i, (y, x) in enumerate(places):
        for j in [places.index(at) for at in ((y + 1, x), (y, x + 1)) if at in places]:
            information[[i, j], [i, j]] += NEIGHBOR**-2
            information[[i, j], [j, i]] -= NEIGHBOR**-2
    covariance = np.linalg.inv(information)
    return (covariance @ right)[:count], np.sqrt(np.diag(covariance))[:count]


@pytest.mark.parametrize("shares", [False, True])
def test_it_is_the_posterior_of_all_pixels_together(maps: xr.Dataset, *, shares: bool) -> None:
    slope = None
    if shares:
        slope = SD * np.random.default_rng(1).uniform(0.3, 0.9, size=(ROWS, COLUMNS))
        maps[f"{NAME}_slope"] = (("shared", "y", "x"), slope[None])
    found = pb.maps.smooth(maps, NAME, NEIGHBOR)
    good = maps["status"].to_numpy() == Status.GOOD
    mean, sd = dense(maps, slope)
    np.testing.assert_allclose(found[NAME].to_numpy()[good], mean, rtol=1e-6)
    assert np.isnan(found[NAME].to_numpy()[~good]).all()
    # 256 draws know a variance to 9%, and an sd to half of that: four such errors.
    np.testing.assert_allclose(found[f"{NAME}_sd"].to_numpy()[good], sd, rtol=0.5 * 4.0 * 0.09)


def test_a_wide_prior_leaves_a_map_as_it_is(maps: xr.Dataset) -> None:
    found = pb.maps.smooth(maps, NAME, 1e4)
    xr.testing.assert_allclose(found[NAME], maps[NAME].where(maps["status"] == Status.GOOD))
    np.testing.assert_allclose(found[f"{NAME}_sd"].max(), SD, rtol=1e-5)


@pytest.mark.parametrize(
    ("name", "neighbor_sd", "answers", "what"),
    [
        ("roughness", 0.1, 1, "smooth: roughness: no such map"),
        (NAME, 0.0, 1, "neighbor_sd is 0.0; give a number above 0 in the unit of refractive_index"),
        (NAME, NEIGHBOR, 0, "no pixel has an answer"),
    ],
)
def test_what_cannot_be_smoothed_is_refused(maps, name, neighbor_sd, answers, what):
    if not answers:
        maps = maps.assign(status=0 * maps["status"] + Status.NOT_TRUSTED)
    with pytest.raises(pb.FitError, match=what):
        pb.maps.smooth(maps, name, neighbor_sd)
