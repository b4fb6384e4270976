"""Contract of the methods: on a posterior that is known, each finds it and says how well."""

import dataclasses

import numpy as np
import pytest
import xarray as xr
from cases import each
from plates import at_mirror
from toy_models import VIEWS, capture, least_squares, line, of_line, waves

import polar_bayes as pb
from polar_bayes.inference.batching import Status
from polar_bayes.methods.registry import method_names

LINKS = {"q": pb.links.StokesLink()}
pytestmark = pytest.mark.usefixtures("without_comparisons")
METHODS = {
    "laplace": pb.methods.Laplace(draws=1000),
    "corrected-laplace": pb.methods.CorrectedLaplace(sampler=None),
    "importance": pb.methods.Importance(),
    "nuts": pb.methods.Nuts(ess=2000.0),
    "auto": pb.methods.Auto(),
}


def fit(method: object, model=line) -> xr.DataTree:
    return pb.fit(capture(), model=model, links=LINKS, method=method, seed=1)


def names(**able: bool) -> list:
    """Methods that give draws; chains of every pixel take their time."""
    slow = ["nuts"] if "many" in able else []
    return [
        pytest.param(name, marks=[pytest.mark.thorough] if name in slow else [])
        for name in method_names(**able)
        if name != "point"
    ]


@pytest.mark.parametrize("name", names(one=True))
def test_every_method_finds_a_normal_posterior(name: str, tmp_path) -> None:
    """Within five standard errors."""
    result = fit(METHODS[name])
    assert pb.verdict(result).converged  # of the model itself these few readings may say anything
    mean, covariance = of_line(capture()["q"].to_numpy())
    rows = pb.diagnostics.json_summary(result)["parameters"]
    for number, parameter in enumerate(("level", "slope")):
        slack = 5.0 / np.sqrt(rows[parameter]["ess_bulk"])
        sd = np.sqrt(covariance[number, number])
        assert abs(rows[parameter]["mean"] - mean[number]) < slack * sd
        assert abs(rows[parameter]["sd"] / sd - 1.0) < slack
    pb.save(result, tmp_path / "fit.nc")
    assert pb.load(tmp_path / "fit.nc").identical(result)


@pytest.mark.parametrize("name", names(many=True))
def test_every_method_finds_it_in_every_pixel(name: str) -> None:
    """Within five standard errors, and each pixel by itself."""
    readings = np.stack([capture(seed)["q"] for seed in range(3)])
    image = at_mirror(VIEWS, q=(("y", "x", "view"), readings[None])).assign_attrs(name="lines")
    maps = pb.fit_pixels(image, model=line, links=LINKS, method=METHODS[name], seed=1)
    assert (maps["status"] == Status.GOOD).all()
    for x, q in enumerate(readings):
        mean, covariance = of_line(q)
        slack = 5.0 / np.sqrt(float(maps["ess"][0, x]))
        for number, parameter in enumerate(("level", "slope")):
            sd = np.sqrt(covariance[number, number])
            assert abs(float(maps[parameter][0, x]) - mean[number]) < slack * sd
            assert abs(float(maps[f"{parameter}_sd"][0, x]) / sd - 1.0) < slack


def test_a_point_fit_finds_the_line_of_least_squares() -> None:
    rows = pb.diagnostics.json_summary(fit(pb.methods.Point(starts=2)))["parameters"]
    found = [rows[parameter]["mean"] for parameter in ("level", "slope")]
    np.testing.assert_allclose(found, least_squares(capture()["q"].to_numpy()), atol=0.02)


def test_a_point_fit_descends_from_as_many_starts_as_are_asked() -> None:
    few, many = (fit(pb.methods.Point(starts=number), waves) for number in (16, 256))
    assert many["sample_stats"]["loss"].item() < few["sample_stats"]["loss"].item()


@each("method", [*METHODS.values(), pb.methods.Point()], ids=repr)
def test_every_method_is_a_frozen_value_that_its_repr_makes_again(method: object) -> None:
    assert dataclasses.replace(method) == method  # type: ignore[type-var]
    assert hash(dataclasses.replace(method)) == hash(method)  # type: ignore[type-var]
    namespace = {name: getattr(pb.methods, name) for name in pb.methods.__all__}
    assert eval(repr(method), namespace) == method
    with pytest.raises(dataclasses.FrozenInstanceError):
        method.no_such_setting = 1  # type: ignore[attr-defined]


@each("name", ["no such method", None, 3.0, pb.methods.Laplace])
def test_what_is_no_method_is_refused(name: object) -> None:
    with pytest.raises(pb.FitError, match="method"):
        fit(name)
