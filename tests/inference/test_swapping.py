"""Three ways to another model: by keyword, by an edited file, by handlers; and what is recorded."""

from pathlib import Path

import numpy as np
import numpyro
import pytest
import xarray as xr
from cases import each
from numpyro import distributions as dist
from numpyro import handlers
from numpyro.infer.reparam import LocScaleReparam
from plates import ON_PLATE, plate_capture

import polar_bayes as pb
from polar_bayes.inference.result import provenance_of
from polar_bayes.models.hierarchical import Hierarchical
from polar_bayes.models.per_material import per_material
from polar_bayes.models.sites import declare_readings

MODELS = Path(__file__).parents[2] / "models"
FEW = pb.methods.Laplace(draws=100, chains=2)
pytestmark = pytest.mark.usefixtures("without_comparisons")


@pytest.fixture(scope="module")
def capture() -> xr.Dataset:
    return plate_capture(np.linspace(20.0, 80.0, 12), 0.02, seed=3)


def fit(capture: xr.Dataset, **asked) -> xr.DataTree:
    return pb.fit(capture, **ON_PLATE | {"method": FEW} | asked)


def mean(result: xr.DataTree, name: str) -> float:
    return float(result["posterior"][name].mean())


def test_by_keyword(capture: xr.Dataset) -> None:
    prior = dist.TruncatedNormal(1.4, 0.001, low=1.2, high=2.0)
    result = fit(capture, priors={"refractive_index": prior})
    assert abs(mean(result, "refractive_index") - 1.4) < 0.01
    assert "prior of refractive_index" in provenance_of(result)["swapped"]


@pytest.mark.thorough
def test_by_an_edited_file(capture: xr.Dataset, tmp_path: Path) -> None:
    text = (MODELS / "per_material.py").read_text()
    edited = text.replace(
        "draw_independent(name, data, priors)",
        "draw_independent(name, data, OWN if name in OWN else priors)",
    ).replace(
        "def per_material(",
        "from numpyro import distributions as dist\n\n"
        'OWN = {"subsurface_fraction": dist.Beta(1.0, 30.0)}\n\n\ndef mine(',
    )
    assert edited != text
    (tmp_path / "mine.py").write_text(edited)
    space: dict = {}
    exec(compile(edited, tmp_path / "mine.py", "exec"), space)
    result = fit(capture, model=space["mine"])
    said = provenance_of(result)
    assert said["model"] == "mine"
    assert said["declared"] == {"subsurface_fraction": "Beta"}
    assert "subsurface_fraction" not in said["priors"]
    assert "model" in said["swapped"]


def index_above_one(data, scene, priors, links):
    """A model with a parameter of its own, and one that derives from it."""
    excess = numpyro.sample("excess", priors["excess"])
    fraction = numpyro.sample("subsurface_fraction", priors["subsurface_fraction"])
    index = numpyro.deterministic("refractive_index", 1.0 + excess)
    parameters = {"subsurface_fraction": fraction, "refractive_index": index}
    declare_readings(parameters, data, scene, priors, links)


@pytest.mark.thorough
def test_a_model_reads_priors_by_any_name(capture: xr.Dataset) -> None:
    own = {"excess": dist.LogNormal(-0.7, 0.2)}
    result = fit(capture, model=index_above_one, priors=own)
    assert set(result["posterior"].data_vars) >= {"excess", "refractive_index"}
    np.testing.assert_allclose(
        result["posterior"]["refractive_index"], 1.0 + result["posterior"]["excess"], rtol=1e-12
    )
    said = provenance_of(result)
    assert said["priors"]["excess"] == "LogNormal(loc=-0.7, scale=0.2)"
    assert said["model_source"].startswith("def index_above_one(")
    with pytest.raises(pb.FitError, match=r"priors\['excess'\]: this parameter has no prior"):
        fit(capture, model=index_above_one)


@pytest.mark.thorough
def test_by_condition(capture: xr.Dataset) -> None:
    held = handlers.condition(per_material, data={"refractive_index": np.float64(1.45)})
    result = fit(capture, model=held)
    assert "refractive_index" not in result["posterior"]
    assert set(result["observed_data"].data_vars) == {"q"}
    said = provenance_of(result)
    assert said["fixed"] == {"refractive_index": 1.45}
    assert said["model"] == "condition(per_material)"
    assert "refractive_index held fixed" in said["swapped"]
    # A lower index is a darker plate: its body must seem brighter than with the index free.
    free = fit(capture)
    assert mean(result, "subsurface_fraction") != mean(free, "subsurface_fraction")


@pytest.fixture
def plates(capture: xr.Dataset) -> xr.Dataset:
    several = [plate_capture(np.linspace(20.0, 80.0, 12), 0.02, seed=seed) for seed in range(5)]
    return xr.concat(several, dim="patch").assign_attrs(capture.attrs)


POOLED = Hierarchical(pooled=("subsurface_fraction",))
MOVED = handlers.reparam(POOLED, config={"subsurface_fraction_base": LocScaleReparam(0.0)})


@pytest.mark.thorough
def test_by_reparam_the_posterior_stays(plates: xr.Dataset) -> None:
    careful = pb.methods.Nuts(target_acceptance=0.99)
    two = [fit(plates, model=model, method=careful, seed=2) for model in (POOLED, MOVED)]
    assert provenance_of(two[1])["model"] == "reparam(Hierarchical)"
    assert "subsurface_fraction_base_decentered" in two[1]["posterior"]
    assert all(pb.verdict(result).passed for result in two)
    for name in ("refractive_index", "subsurface_fraction_spread"):
        one, other = (result["posterior"][name].to_numpy() for result in two)
        # Four standard errors of a difference of means of 450 effective draws each.
        assert abs(one.mean() - other.mean()) < 4.0 * np.sqrt(2.0 / 450.0) * one.std()


@each("handler", [handlers.substitute, handlers.do])
def test_handlers_that_would_be_lost_are_refused(capture: xr.Dataset, handler) -> None:
    held = {"refractive_index": np.float64(1.45)}
    # What is known of a model with the same values in another handler is not known of this one.
    fit(capture, model=handlers.condition(per_material, data=held), method="point")
    model = handler(per_material, data=held)
    with pytest.raises(pb.FitError, match=r"use numpyro\.handlers\.condition"):
        fit(capture, model=model)


def half_hearted(data, scene, priors, links):
    fraction = numpyro.sample("subsurface_fraction", dist.Normal(0.5, 0.1))
    index = numpyro.sample("refractive_index", priors["refractive_index"])
    parameters = {"subsurface_fraction": fraction, "refractive_index": index}
    declare_readings(parameters, data, scene, priors, links)


def blind(data, scene, priors, links):
    numpyro.sample("refractive_index", priors["refractive_index"])


def forgetful(data, scene, priors, links):
    numpyro.sample("refractive_index", priors["refractive_index"])
    with numpyro.plate("view", data.dims[-1][1]):
        numpyro.sample("q", dist.Normal(0.0, 1.0))


def with_counter(data, scene, priors, links):
    numpyro.sample("layers", dist.Poisson(2.0))
    per_material(data, scene, priors, links)


@each(
    ("model", "said"),
    [
        (
            half_hearted,
            r"sample\('subsurface_fraction'\): Normal allows values outside 0 to 1; give",
        ),
        (blind, "observes none of the readings"),
        (forgetful, r"sample\('q'\): it is drawn, not observed"),
        (with_counter, "Poisson is discrete"),
    ],
)
def test_a_model_that_cannot_work_is_refused(capture: xr.Dataset, model, said: str) -> None:
    with pytest.raises(pb.FitError, match=said) as caught:
        fit(capture, model=model)
    assert "\n" not in str(caught.value)
