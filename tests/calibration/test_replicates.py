"""Repeats and proxies: posteriors of a known property, and the rate of false alarms."""

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from scipy import stats

import polar_bayes as pb

SD = 0.02
DRAWS = stats.norm.ppf((np.arange(400) + 0.5) / 400)


def fits(means: dict[str, np.ndarray], sd: float = SD, true: float | None = None) -> list:
    """Normal posteriors about the means of each repeat; NaN is a fit that failed."""
    count = len(next(iter(means.values())))
    found = []
    for at in range(count):
        posterior = {
            name: (("chain", "draw"), (mean[at] + sd * DRAWS).reshape(2, 200))
            for name, mean in means.items()
        }
        groups = {"posterior": xr.Dataset(posterior)}
        if true is not None:
            groups["constant_data"] = xr.Dataset({f"true_{name}": true for name in means})
        found.append(xr.DataTree.from_dict(groups))
    return found


def test_repeats_that_scatter_as_they_say_raise_few_alarms() -> None:
    """At 5% over both parameters; one run in 10,000 has more alarms by chance."""
    random, runs, alarms, pairs = np.random.default_rng(0), 200, 0, []
    for _ in range(runs):
        means = {name: 0.3 + SD * random.standard_normal(5) for name in ("roughness", "absorption")}
        table = pb.calibration.retest(fits(means))
        alarms += table["conclusion"].str.contains("more than the intervals predict").any()
        pairs.append(table["agreeing"].mean())
    assert alarms <= stats.binom.ppf(0.9999, runs, 0.05)
    assert np.mean(pairs) == pytest.approx(0.95, abs=0.02)


EVEN = stats.norm.ppf((np.arange(12) + 0.5) / 12)


def test_repeats_that_scatter_more_are_told_by_how_much() -> None:
    means = 1.5 + 3.0 * SD * EVEN
    row = retested(means)
    assert row["scatter"] == pytest.approx(means.std(ddof=1), rel=1e-9)
    assert row["expected"] == pytest.approx(SD, rel=0.01)
    assert row["chi_square"] == pytest.approx(np.sum((means - means.mean()) ** 2) / SD**2, rel=0.02)
    assert row["p_value"] < 1e-4
    assert row["agreeing"] < 0.6
    assert row["pairs"] == 66
    said = f"repeats scatter {row['ratio']:.1f} times more than the intervals predict"
    assert row["conclusion"] == said


@pytest.mark.thorough
def test_repeats_that_scatter_less_are_no_alarm_and_failed_ones_are_counted() -> None:
    words = retested(1.5 + 0.1 * SD * EVEN)["conclusion"]
    assert "the rest of the intervals is what all repeats share" in words
    row = retested([0.3, np.nan, 0.31, 0.29])
    assert (row["repeats"], row["failed"], row["pairs"]) == (3, 1, 3)
    assert retested([0.3, np.nan])["conclusion"] == "too few repeats have an answer"


def retested(means) -> pd.Series:
    """What repeats of one parameter say of each other."""
    return pb.calibration.retest(fits({"roughness": np.asarray(means)})).loc["roughness"]


def test_what_are_no_repeats_is_refused() -> None:
    strangers = [*fits({"roughness": np.zeros(1)}), *fits({"absorption": np.zeros(1)})]
    for repeats, said in (
        (strangers[:1], "a single fit has nothing to agree with; give two or more"),
        (strangers, "share no parameter"),
        ([xr.DataTree(), xr.DataTree()], "it holds no fit"),
    ):
        with pytest.raises(pb.FitError, match=said):
            pb.calibration.retest(repeats)


def test_intervals_hold_proxies_as_often_as_they_say() -> None:
    """Each share within 3.9 standard errors: one run in 10,000 strays further by chance."""
    random, count = np.random.default_rng(1), 300
    found = fits({"roughness": 0.3 + SD * random.standard_normal(count)}, true=0.3)
    row = pb.calibration.proxy_coverage(found).loc["roughness"]
    for percent in (50, 80, 95):
        share = percent / 100.0
        assert abs(row[f"held_{percent}"] - share) < 3.9 * np.sqrt(share * (1 - share) / count)
        assert row[f"held_{percent}_low"] < row[f"held_{percent}"] < row[f"held_{percent}_high"]
    assert row["z_mean"] == pytest.approx(0.0, abs=3.9 / np.sqrt(count))
    assert row["z_rms"] == pytest.approx(1.0, abs=3.9 / np.sqrt(2.0 * count))


@pytest.mark.thorough
def test_proxies_may_be_given_and_failed_fits_miss_them() -> None:
    found = fits({"roughness": np.array([0.3, 0.34, np.nan]), "absorption": np.zeros(3)})
    table = pb.calibration.proxy_coverage(found, {"roughness": 0.3})
    assert list(table.index) == ["roughness"]
    row = table.loc["roughness"]
    assert (row["fits"], row["failed"]) == (3, 1)
    assert row["held_50"] == row["held_80"] == pytest.approx(1.0 / 3.0)
    each = pb.calibration.proxy_scores(
        found, [{"roughness": 0.3}, {"roughness": 0.32}, {"absorption": 0.0}]
    )
    assert list(each["fit"]) == [0, 1, 2]
    assert each["z"].to_numpy()[:2] == pytest.approx([0.0, -1.0], abs=0.01)
    assert each["below"].to_numpy()[1] == pytest.approx(stats.norm.cdf(-1.0), abs=0.01)


@pytest.mark.thorough
def test_one_entry_of_a_spectrum_may_have_a_proxy_of_its_own() -> None:
    draws = 1.5 + SD * DRAWS.reshape(1, 400, 1) + np.zeros((1, 400, 2))
    posterior = xr.Dataset(
        {"refractive_index": (("chain", "draw", "wavelength"), draws)},
        {"wavelength": [450.0, 650.0]},
    )
    tree = xr.DataTree.from_dict({"posterior": posterior})
    scores = pb.calibration.proxy_scores([tree], {"refractive_index[650]": 1.52})
    assert list(scores["parameter"]) == ["refractive_index[650]"]
    assert len(pb.calibration.proxy_scores([tree], {"refractive_index": 1.52})) == 2


def test_proxies_that_do_not_fit_are_refused() -> None:
    found = fits({"roughness": np.zeros(2)})
    for proxies in (None, {"gloss": 1.0}):
        with pytest.raises(pb.FitError, match="no proxy is known of any parameter"):
            pb.calibration.proxy_coverage(found, proxies)
    with pytest.raises(pb.FitError, match="1 mappings do not go with 2 fits"):
        pb.calibration.proxy_scores(found, [{"roughness": 0.0}])
