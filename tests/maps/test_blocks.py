"""A pixel's answer is its own: how an image is cut and who stands beside it changes no bit.

The programs are compiled as users compile them: rearranged arithmetic would show here.
"""

import numpy as np
import pytest
import xarray as xr
from cases import each
from plate_images import ASKED, NAMES, mapped, planned, plate_image

import polar_bayes as pb
from polar_bayes.inference.batching import MethodUsed, Status
from polar_bayes.inference.problem_batch import random_keys
from polar_bayes.maps import fit_map as verb
from polar_bayes.maps.fit_map import MapPlan, fit_block, fit_pixels, with_pixel_numbers

# Chains too short to be believed are as good as any to compare bits.
SHORT = pb.methods.CorrectedLaplace(
    draws=64, candidates=8, rounds=1, sampler=pb.methods.Nuts(warmup=50, draws=50, most_draws=50)
)


@pytest.fixture(scope="module")
def image() -> xr.Dataset:
    """One pixel more than fills a batch, and some that the approximation does not fit."""
    noise = np.random.default_rng(3).choice([0.01, 0.02, 0.1, 0.3], (3, 43))
    return plate_image(3, 43, noise=noise, seed=9)


@pytest.fixture(scope="module")
def plan(image: xr.Dataset) -> MapPlan:
    return planned(image, SHORT)


@pytest.fixture(scope="module")
def whole(image: xr.Dataset, plan: MapPlan) -> xr.Dataset:
    maps = mapped(image, plan)
    for method in (MethodUsed.IMPORTANCE, MethodUsed.ADAPTED, MethodUsed.NUTS):
        assert (maps["method"] == method).any(), method
    return maps


def assert_same_bits(one: xr.Dataset, other: xr.Dataset) -> None:
    assert set(one.data_vars) == set(other.data_vars)
    for name, values in one.items():
        assert values.dtype == other[name].dtype
        assert values.dims == other[name].dims
        assert values.values.tobytes() == other[name].values.tobytes(), name


@pytest.mark.thorough
@each("block", [100, 43, 17])
def test_blocks_of_any_size_give_the_same_bits(image, plan, whole, block):
    assert_same_bits(mapped(image, plan, block), whole)


def assert_without_answer(pixels: xr.Dataset, status: Status) -> None:
    assert (pixels["status"] == status).all()
    assert (pixels["method"] == MethodUsed.NONE).all()
    assert (pixels["steps"] == 0).all()
    own = [f"{name}{ending}" for name in NAMES for ending in ("", "_sd", "_quantile")]
    assert all(np.isnan(pixels[name]).all() for name in (*own, "pareto_k", "ess", "condition"))


@pytest.mark.thorough
def test_a_block_in_which_nothing_was_read_is_masked(image: xr.Dataset, plan: MapPlan) -> None:
    """A corner of a picture, for example, beside what is shown."""
    nothing = with_pixel_numbers(image.assign(valid=xr.zeros_like(image["q"], bool))).isel(y=[1])
    assert_without_answer(fit_block(nothing, plan), Status.MASKED)


@pytest.mark.thorough
def test_a_pixel_alone_gets_the_same_bits(image, plan, whole):
    sampled = np.argwhere((whole["method"] == MethodUsed.NUTS).values)[-1]
    for y, x in ((0, 0), (2, 42), sampled):
        place = {"y": slice(y, y + 1), "x": slice(x, x + 1)}
        alone = fit_block(with_pixel_numbers(image).isel(place), plan)
        assert_same_bits(alone, whole.isel(place))


@pytest.mark.thorough
def test_a_mirrored_image_has_mirrored_modes(image, plan, whole):
    mirrored = mapped(image.isel(x=slice(None, None, -1)), plan).isel(x=slice(None, None, -1))
    # Draws follow the number of a pixel, which has changed; where it climbs to does not.
    for name in ("steps", "condition"):
        assert mirrored[name].values.tobytes() == whole[name].values.tobytes(), name


@pytest.mark.thorough
def test_chunks_on_threads_give_the_same_bits(image: xr.Dataset, whole: xr.Dataset) -> None:
    lazy = fit_pixels(image.chunk(y=2, x=15), method=SHORT, **ASKED)
    assert lazy.chunks["x"] == (15, 15, 13)
    assert lazy.chunks["y"] == (2, 1)
    assert set(lazy.data_vars) == set(whole.data_vars)
    assert_same_bits(lazy.compute(scheduler="threads"), whole)


@pytest.fixture
def compiled_already(plan: MapPlan, monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks of twenty pixels, fitted by the programs of the whole image."""

    def estimate_plan(asked: MapPlan, capture: xr.Dataset) -> MapPlan:
        own = estimate(asked, capture)
        assert own.settings == plan.settings
        assert own.request.priors.keys() == plan.request.priors.keys()
        assert own.request.capture["valid"].all()
        return plan

    estimate = verb.estimate_plan
    monkeypatch.setattr(verb, "estimate_plan", estimate_plan)
    monkeypatch.setattr(verb.cut, "__defaults__", (20,))


@pytest.mark.thorough
def test_bad_pixels_are_told_apart_and_poison_no_neighbor(image, whole, compiled_already):
    bad = image.copy(deep=True)
    views = image.sizes["view"]
    valid = np.ones(image["q"].shape, bool)
    bad["q"][0, 0, :] = np.nan  # nothing was read; it comes first of all
    valid[0, 1, :] = False  # masked, and its readings look good
    valid[1, 20, :] = False  # masked, and its readings are nonsense
    bad["q"][1, 20, :] = np.inf
    valid[1, 21, 1:] = False  # one view is left
    bad["q"][1, 22, : views - 1] = np.nan  # one view is left, the other way
    valid[2, 42, 0] = False  # the last of all has one view less
    bad["q"][2, 40, 3] = np.nan  # so has this one, by its reading
    heard: list[tuple[int, int]] = []
    maps = fit_pixels(
        bad.assign(valid=(("y", "x", "view"), valid)),
        method=SHORT,
        progress=lambda done, every: heard.append((done, every)),
        **ASKED,
    )
    assert heard[-1] == (129, 129)
    assert [done for done, _ in heard] == sorted({done for done, _ in heard})
    gone = {(0, 0): Status.MASKED, (0, 1): Status.MASKED, (1, 20): Status.MASKED}
    gone |= {(1, 21): Status.TOO_FEW_VIEWS, (1, 22): Status.TOO_FEW_VIEWS}
    for (y, x), status in gone.items():
        assert_without_answer(maps.isel(y=y, x=x), status)
    assert int((maps["status"] == Status.MASKED).sum()) == 3
    assert int((maps["status"] == Status.TOO_FEW_VIEWS).sum()) == 2
    fewer = [(2, 42), (2, 40)]
    for y, x in fewer:
        assert np.isfinite(maps[NAMES[0]][y, x])
        assert maps[NAMES[0]][y, x] != whole[NAMES[0]][y, x]
    untouched = np.ones((3, 43), bool)
    for y, x in (*gone, *fewer):
        untouched[y, x] = False
    for name, values in maps.items():
        ours, theirs = values.values[..., untouched], whole[name].values[..., untouched]
        assert ours.tobytes() == theirs.tobytes(), name


@pytest.mark.thorough
def test_another_seed_moves_draws_not_modes(image: xr.Dataset, whole: xr.Dataset) -> None:
    few = image.isel(y=slice(1), x=slice(20))
    other = mapped(few, planned(few, SHORT, seed=1))
    there = (other["method"] == MethodUsed.IMPORTANCE).values
    there &= (whole["method"].isel(y=slice(1), x=slice(20)) == MethodUsed.IMPORTANCE).values
    assert there.sum() > 5
    name = NAMES[0]
    one, two = (m[name].isel(y=slice(1), x=slice(20)).values[there] for m in (whole, other))
    assert (one != two).all()
    sd = other[f"{name}_sd"].values[there]
    # 64 weighted points in mirrored pairs; independent draws would scatter by 0.125 sd.
    assert (np.abs(one - two) < 4.0 * 0.125 * 2.0**0.5 * sd).all()


def test_keys_differ_by_number_and_by_seed() -> None:
    numbers = np.array([0, 1, 2**31, 10**8])
    one = random_keys(0, numbers)
    assert len({tuple(key) for key in (*one, *random_keys(1, numbers))}) == 8
    assert (random_keys(0, numbers[::-1]) == one[::-1]).all()
