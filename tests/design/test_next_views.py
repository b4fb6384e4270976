"""Designs against closed forms and brute force; what constraints and a capture allow."""

import itertools

import numpy as np
import numpyro
import pytest
import xarray as xr
from cases import each
from design_lines import ASKED, NOISE, PRIOR, angles, line, line_capture, precision_of, rows_of
from numpyro import distributions as dist
from plates import KNOWN, ON_PLATE, PLATE, plate_capture
from synthetic_results import make_result

import polar_bayes as pb
from polar_bayes.design.optimal_design import fedorov_exchange
from polar_bayes.physics.input_quantities import SampleLean, ToneCurve
from polar_bayes.simulation import Protocol

START = np.array([40.0, 50.0])
GRID = np.linspace(10.0, 80.0, 8)
pytestmark = pytest.mark.usefixtures("without_comparisons")


def on_a_line(candidates=GRID, **asked) -> xr.Dataset:
    return pb.next_views(
        line_capture(START), angles(candidates), model=line, draws=2, **ASKED, **asked
    )


def test_a_line_is_best_seen_from_its_ends() -> None:
    """D-optimal for a straight line: half of the readings at either end (Atkinson, chapter 11)."""
    found = on_a_line(count=4, constraints=pb.design.Constraints(repeatable=True))
    assert sorted(found["view_zenith"].to_numpy()) == [10.0, 10.0, 80.0, 80.0]
    for step in range(5):
        zeniths = [*START, *found["view_zenith"].to_numpy()[:step]]
        covariance = np.linalg.inv(precision_of(zeniths))
        row = found.isel(step=step).sel(parameter=["level", "slope"])
        np.testing.assert_allclose(row["expected_sd"], np.diag(covariance) ** 0.5, rtol=1e-6)
        np.testing.assert_allclose(row["interval_width"], 3.92 * row["expected_sd"], rtol=1e-4)


@each(
    "criterion",
    [pb.design.DOptimal(), pb.design.AOptimal(), pb.design.SingleParameter("level")],
    ids=repr,
)
def test_no_other_choice_is_better(criterion: pb.design.DOptimal) -> None:
    """Against all choices of three of eight, where greedy steps with exchange find the best."""
    base, rows = np.linalg.inv(np.cov(rows_of(START).T) + np.eye(2)), rows_of(GRID)
    each = rows[:, :, None] * rows[:, None, :] / 0.3**2

    def loss(information: np.ndarray) -> np.ndarray:
        return criterion.loss(np.linalg.inv(information), ["level", "slope"])[0]

    apart = np.eye(len(GRID), dtype=bool)
    chosen = fedorov_exchange(loss, base[None], each[None], np.ones(len(GRID), bool), apart, 3)
    every = [base + each[list(three)].sum(axis=0) for three in itertools.combinations(range(8), 3)]
    assert chosen.losses[-1] == pytest.approx(loss(np.array(every)[None]).min())
    assert (np.diff(chosen.losses) < 0.0).all()


def test_exchange_mends_what_greed_got_wrong() -> None:
    """The best single view is in no best pair: greed takes it, exchange gives it back."""
    base = 1e-3 * np.eye(2)
    rows = np.array([[0.8, 0.8], [1.0, 0.0], [0.0, 1.0]])
    each, apart = rows[:, :, None] * rows[:, None, :], np.eye(3, dtype=bool)

    def loss(information: np.ndarray) -> np.ndarray:
        return np.trace(np.linalg.inv(information), axis1=-2, axis2=-1)[0]

    assert int(np.argmin(loss((base + each)[None]))) == 0
    chosen = fedorov_exchange(loss, base[None], each[None], np.ones(3, bool), apart, 2)
    assert set(chosen.picks) == {1, 2}
    assert chosen.exchanges > 0


def test_constraints_limit_the_views() -> None:
    constraints = pb.design.Constraints(view_zenith=(0.0, 65.0), minimum_separation=12.0)
    found = on_a_line(np.arange(5.0, 80.0, 2.5), count=3, constraints=constraints)
    zeniths = np.sort(found["view_zenith"].to_numpy())
    assert zeniths.max() <= 65.0
    assert np.diff(zeniths).min() >= 12.0 - 1e-6
    assert np.abs(zeniths[:, None] - START).min() >= 12.0 - 1e-6


@pytest.mark.thorough
def test_light_and_viewer_keep_apart() -> None:
    constraints = pb.design.Constraints(from_light=10.0)
    there = np.array([[45.0, 0.0, 45.0, 0.0], [45.0, 180.0, 45.0, 0.0], [56.0, 0.0, 45.0, 0.0]])
    assert constraints.allows(there, there[:0]).tolist() == [False, True, True]
    assert not constraints.allows(there, there).any()  # measured already
    assert pb.design.Constraints(repeatable=True).allows(there, there).all()


def test_a_fit_tells_its_capture_scene_and_priors() -> None:
    """A goniometer's capture holds the degree of polarization, too, which is not fitted."""
    plate = plate_capture(np.linspace(20.0, 60.0, 6), 0.01, seed=2)
    plate = plate.assign(dop=abs(plate["q"]), dop_error=plate["q_error"])
    asked = ON_PLATE | {"priors": {"refractive_index": dist.Uniform(1.3, 1.8)}}
    fit = pb.fit(plate, method=pb.methods.Laplace(draws=50), **asked)
    told, found = pb.next_views(fit, count=1), pb.next_views(plate, count=1, result=fit, **asked)
    xr.testing.assert_identical(told.drop_attrs(), found.drop_attrs())


def lamp(data, scene, priors, links):
    """A level read the more sharply, the brighter the view; brightness grows with the zenith."""
    level = numpyro.sample("level", dist.Normal(0.0, PRIOR))
    glow = numpyro.sample("glow", dist.Normal(0.5, 0.001))
    seen = glow * (1.0 + data.geometry.view_zenith / 90.0)
    with numpyro.plate("view", data.shape[-1]):
        sensor = dist.Normal(seen, 0.1).mask(data.valid)
        numpyro.sample("intensity", sensor, obs=data.readings["intensity"])
        noise = dist.Normal(level, NOISE / data.brightness).mask(data.valid)
        numpyro.sample("q", noise, obs=data.readings["q"])


@pytest.mark.thorough
def test_new_views_are_as_bright_as_predicted_and_old_ones_as_recorded() -> None:
    capture = line_capture(START)
    capture["intensity"] = ("view", [0.3, 0.6], {"saturation_level": 1.0})
    found = pb.next_views(capture, angles([9.0, 45.0, 72.0]), count=1, model=lamp, draws=4, **ASKED)
    assert found["view_zenith"].item() == 72.0
    precision = 1.0 / PRIOR**2 + np.sum(np.array([0.3, 0.6]) ** 2) / NOISE**2
    expected = [precision**-0.5, (precision + 0.9**2 / NOISE**2) ** -0.5]
    np.testing.assert_allclose(found["expected_sd"].sel(parameter="level"), expected, rtol=2e-3)
    with pytest.raises(pb.FitError, match="the model does not observe intensity"):
        on_a_line(readings={"q": None, "intensity": pb.links.StudentTLink()})


@pytest.mark.thorough
def test_a_fit_may_say_what_the_parameters_may_be() -> None:
    """A line tells the same of its parameters wherever they are, so only the draws differ."""

    def fitted(drawn: np.ndarray) -> xr.DataTree:
        draws = xr.DataArray(drawn, dims=("parameter", "chain", "draw"))
        posterior = xr.Dataset({"level": draws[0], "slope": draws[1]})
        return xr.DataTree.from_dict({"posterior": posterior})

    drawn = np.random.default_rng(0).normal(0.0, 0.1, (2, 1, 30))
    drawn[0, 0, 3] = np.nan
    found = on_a_line(count=1, result=fitted(drawn))
    np.testing.assert_allclose(found["expected_sd"], on_a_line(count=1)["expected_sd"])
    with pytest.raises(pb.FitError, match="none of its draws is finite"):
        on_a_line(result=fitted(drawn * np.nan))


@pytest.mark.thorough
def test_the_choice_is_said_in_words() -> None:
    found = on_a_line(count=2)
    assert pb.verdict(found).sentences[0] == (
        "Look next at zenith 10, azimuth 180; then at zenith 80, azimuth 180."
    )
    assert list(pb.summary(found)) == ["now", "after 1", "after 2"]
    (limits,) = pb.verdict(found).sentences[-1:]
    assert limits.startswith("Candidates had zeniths from 10 to 80 degrees, however near to the l")
    apart = on_a_line(count=2, constraints=pb.design.Constraints(from_light=20.0))
    assert "at least 20 degrees from the light" in pb.verdict(apart).sentences[-1]


@each(
    ("asked", "match"),
    [
        ({"count": 0}, "give whole numbers of at least 1"),
        ({"count": 9}, "only 6 of 8 candidates can be taken together"),
        ({"apart": ("color",)}, "give some of wavelength, reading"),
        ({"apart": ("wavelength",)}, "the capture has no wavelengths to choose from"),
        ({"candidates": [10.0, 95.0]}, r"view_zenith\[view=1\]: 95 is no direction"),
        (
            {"criterion": pb.design.SingleParameter("bend")},
            "no parameter of the material has that name",
        ),
        ({"readings": {"q": None, "dop": pb.links.BetaLink()}}, "would count twice"),
        ({"readings": ("dop",)}, "the noise of dop is not known"),
        ({"readings": {"q": pb.links.NormalLink()}}, "new readings of q have another link"),
        ({"readings": ("color",)}, "there is no such reading"),
        ({"readings": ()}, "new views record nothing"),
        ({"result": xr.DataTree()}, "next_views: result: it holds no fit"),
        ({"result": make_result(views=4, chains=1, draws=4)}, "it has no draws of level"),
    ],
)
def test_what_cannot_be_is_told(asked, match) -> None:
    with pytest.raises(pb.FitError, match=match):
        on_a_line(**asked)


def test_constraints_are_checked() -> None:
    with pytest.raises(pb.FitError, match=r"view_zenith is \(50, 20\)"):
        pb.design.Constraints(view_zenith=(50.0, 20.0))
    with pytest.raises(pb.FitError, match="minimum_separation is -1"):
        pb.design.Constraints(minimum_separation=-1.0)


# --- a plate: physics, other readings, the draws of a fit -----------------------------------------


@pytest.fixture(scope="module")
def plate() -> xr.Dataset:
    return plate_capture(np.array([30.0, 42.0, 75.0]), 0.02, seed=0)


@pytest.mark.thorough
def test_what_is_expected_is_what_a_larger_capture_gives(plate: xr.Dataset) -> None:
    """The expected sds after the views agree with `identify` where these views were measured."""
    found = pb.next_views(plate, draws=1, count=2, **KNOWN)
    zeniths = np.append(plate["view_zenith"], found["view_zenith"])
    assert np.all(found["view_zenith"] == found["light_zenith"])  # a goniometer's mirror
    known = pb.identify(plate_capture(zeniths, 0.02, seed=3), **KNOWN)
    for name in ("refractive_index", "subsurface_fraction"):
        expected = float(known["expected_sd"].sel(parameter=name))
        assert float(found["expected_sd"].sel(parameter=name)[-1]) == pytest.approx(
            expected, rel=0.3
        )
    after, before = found["interval_width"][-1], found["interval_width"][0]
    assert (after < before).all()


@pytest.mark.thorough
def test_another_reading_can_be_added_even_at_the_ends(plate: xr.Dataset) -> None:
    """Brightness brings an exposure and a noise of its own, which the capture knows nothing of."""
    found = pb.next_views(
        plate,
        angles([0.0, 30.0, 45.0, 89.9]),
        readings={"intensity": pb.links.StudentTLink()},
        apart=("reading",),
        count=3,
        draws=4,
        constraints=pb.design.Constraints(repeatable=True),
        **KNOWN,
    )
    assert set(found["reading"].to_numpy()) == {"intensity"}
    assert np.isfinite(found["expected_sd"]).all()
    assert (np.diff(found["criterion"]) < 0.0).all()
    assert pb.verdict(found).sentences[0].count(", intensity") == 3


@pytest.mark.thorough
def test_views_that_are_not_taken_change_nothing() -> None:
    """What the capture alone tells: no exposure was set for the light of candidates."""
    capture = pb.simulate("plastic", protocol=Protocol(views=10, wavelengths=()), seed=0)
    fit = pb.fit(capture, method="laplace")
    sd = [
        pb.next_views(fit, angles(zeniths), count=1, draws=4)["expected_sd"][0]
        for zeniths in ([44.0, 45.0, 46.0], [1.0, 2.0, 80.0])
    ]
    np.testing.assert_allclose(*sd, rtol=1e-9)


def test_a_quantity_known_twice_as_well_does_what_its_prior_does(plate: xr.Dataset) -> None:
    """The same draws with half of the standard uncertainty from the start."""
    links = {"q": pb.links.StokesLink(stated_errors=True)}
    setup = pb.setups.Setup(PLATE, links, known=(SampleLean(), ToneCurve()))
    asked = {"scene": setup, "count": 1, "draws": 4}
    plate = plate.assign_attrs(setup="picture")  # whose quantities are not those of the fit
    fit = pb.fit(plate, scene=setup, method="laplace")
    found = pb.next_views(plate, result=fit, **asked)
    assert found["quantity"].to_numpy().tolist() == ["sample_lean_offset", "tone_curve_offset"]
    np.testing.assert_allclose(found["uncertainty"], [0.2, 0.01], rtol=1e-6)  # single precision
    for name, u in zip(found["quantity"].to_numpy(), found["uncertainty"].to_numpy(), strict=True):
        better = pb.next_views(plate, result=fit, priors={name: dist.Normal(0.0, 0.5 * u)}, **asked)
        np.testing.assert_allclose(
            found["halved_width"].sel(quantity=name), better["interval_width"][0], rtol=1e-6
        )


@pytest.mark.thorough
def test_one_wavelength_at_a_time(plate: xr.Dataset) -> None:
    two = xr.concat([plate, plate], dim="wavelength", data_vars=["q", "q_error"])
    two = two.assign_coords(wavelength=[450.0, 650.0])
    only = angles([30.0, 60.0]).assign_coords(wavelength=[450.0])
    found = pb.next_views(two, only, apart=("wavelength",), count=2, draws=2, **KNOWN)
    assert found["wavelength"].to_numpy().tolist() == [450.0, 450.0]
    width = found["interval_width"].isel(step=-1) / found["interval_width"].isel(step=0)
    assert width.sel(parameter="refractive_index[450]") < width.sel(
        parameter="refractive_index[650]"
    )
    with pytest.raises(pb.FitError, match="500 nm has parameters of its own"):
        pb.next_views(two, only.assign_coords(wavelength=[500.0]), **KNOWN)
