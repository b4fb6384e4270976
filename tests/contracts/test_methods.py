"""Contract of the methods: on a posterior that is known, each finds it and says how well."""

import dataclasses

import numpy as np
import pytest
import xarray as xr
from cases import each
from toy_models import capture, line, of_line

import polar_bayes as pb

LINKS = {"q": pb.links.StokesLink()}
METHODS = {
    "laplace": pb.methods.Laplace(draws=1000),
    "importance": pb.methods.Importance(),
    "nuts": pb.methods.Nuts(ess=2000.0),
}
QUICK = ("laplace", "importance", "nuts")


def fit(method: object) -> xr.DataTree:
    return pb.fit(capture(), model=line, links=LINKS, method=method, seed=1)


@pytest.mark.parametrize(
    "name",
    [name if name in QUICK else pytest.param(name, marks=pytest.mark.thorough) for name in METHODS],
)
def test_every_method_finds_a_normal_posterior(name: str, tmp_path) -> None:
    """Within five standard errors."""
    result = fit(METHODS[name])
    assert pb.verdict(result).converged  # of the model itself these few readings may say anything
    mean, covariance = of_line(capture()["q"].to_numpy())
    rows = pb.diagnostics.json_summary(result)["parameters"]
    slack = 5.0 / np.sqrt(400.0)
    for number, parameter in enumerate(("level", "slope")):
        sd = np.sqrt(covariance[number, number])
        assert abs(rows[parameter]["mean"] - mean[number]) < slack * sd
        assert abs(rows[parameter]["sd"] / sd - 1.0) < slack
    pb.save(result, tmp_path / "fit.nc")
    assert pb.load(tmp_path / "fit.nc").identical(result)


def test_a_point_fit_finds_the_line_of_least_squares() -> None:
    q = capture()["q"].to_numpy()
    slope, level = np.polyfit(np.linspace(-1.0, 1.0, len(q)), q, 1)
    rows = pb.diagnostics.json_summary(fit(pb.methods.Point(starts=2)))["parameters"]
    np.testing.assert_allclose(
        [rows["level"]["mean"], rows["slope"]["mean"]], [level, slope], atol=0.02
    )


@each("method", [*METHODS.values(), pb.methods.Point(), pb.methods.Auto()], ids=repr)
def test_every_method_is_a_frozen_value_that_its_repr_makes_again(method: object) -> None:
    assert dataclasses.replace(method) == method  # type: ignore[type-var]
    assert hash(dataclasses.replace(method)) == hash(method)  # type: ignore[type-var]
    names = {name: getattr(pb.methods, name) for name in pb.methods.__all__}
    assert eval(repr(method), names) == method
    with pytest.raises(dataclasses.FrozenInstanceError):
        method.no_such_setting = 1  # type: ignore[attr-defined]


@each("name", ["no such method", None, 3.0, pb.methods.Laplace])
def test_what_is_no_method_is_refused(name: object) -> None:
    with pytest.raises(pb.FitError, match="method"):
        fit(name)
