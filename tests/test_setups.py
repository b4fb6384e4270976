"""The named set-ups hang together, and a wrong name is answered with the right ones."""

import dataclasses
import inspect

import numpy as np
import pytest
from cases import each
from numpyro import distributions as dist
from numpyro.distributions.transforms import SigmoidTransform

import polar_bayes as pb
from polar_bayes.errors import SceneError
from polar_bayes.inference.request import OWN_QUANTITIES, resolve
from polar_bayes.models.per_material import per_material
from polar_bayes.physics.instrument import AngleZero, Instrument
from polar_bayes.physics.scene import SCENES, Scene
from polar_bayes.setups import SETUPS, Setup, as_read, default_priors, find_setup


@each("name", SETUPS)
def test_a_setup_hangs_together(name):
    """Its scene has a name, material parameters come first, a link is of a polarization."""
    setup = find_setup(name)
    assert setup is SETUPS[name]
    assert setup.scene == SCENES[name]
    parameters = setup.scene.parameters
    assert len(set(parameters)) == len(parameters)
    assert "refractive_index" in parameters
    assert all(variable in link.observables for variable, link in setup.links.items())
    assert {"dop", "q", "u"} & set(setup.links)
    assert 0.0 < setup.largest_view_zenith <= 90.0


def test_every_named_scene_has_a_setup():
    assert set(SETUPS) == set(SCENES)


def test_the_goniometer_sets_grazing_views_aside_and_trusts_stated_errors_by_a_factor():
    setup = SETUPS["goniometer"]
    assert setup.largest_view_zenith == 78.0
    assert setup.links["q"].parameters == ("stokes_error_factor",)


def test_the_table_cannot_be_changed_by_accident():
    with pytest.raises(TypeError, match="does not support item assignment"):
        SETUPS["mine"] = SETUPS["paper"]


@each("name", ["papper", "", "Paper", 3, None, ["paper"]])
def test_an_unknown_name_is_answered_with_the_known_ones(name):
    with pytest.raises(SceneError) as caught:
        find_setup(name)
    names = "paper, polarimeter, camera, picture, goniometer"
    expected = f"no such scene; give one of {names}, or a polar_bayes.Scene"
    assert str(caught.value) == f"scene={name!r}: {expected}"


def test_the_docstring_of_a_setup_names_every_field():
    for field in Setup.__dataclass_fields__:
        assert f"{field}:" in inspect.getdoc(Setup)


def test_a_set_up_is_taken_as_its_capture_was_read():
    """One channel has its analyzer, an ellipsometer its light; nothing changes of any other."""
    angles = np.arange(20.0, 80.0, 5.0)
    s, p = (angles, 1.0 + angles), (angles, 90.0 - angles)
    setup = SETUPS["goniometer"]
    assert as_read(setup, pb.from_goniometer(s, p)) is setup
    for channel, angle in (("s", 0.0), ("p", 90.0)):
        alone = as_read(setup, pb.from_goniometer(**{channel: s}))
        assert alone.scene.instrument.terms[-1] == pb.instrument.Analyzer(angle)
        assert not alone.scene.has(pb.instrument.ChannelGain)
        assert alone.links["intensity"].stated_errors
    whole = as_read(setup, pb.from_goniometer(unpolarized=s))
    assert not whole.scene.has(pb.instrument.Analyzer)
    turned = pb.from_goniometer(s, p)
    turned["u"], turned["u_error"] = 0.1 * turned["q"], turned["q_error"]
    turned["u"].attrs = {"light_angle": -45.0}
    lit = as_read(setup, turned)
    assert lit.scene.surface.beam.polarization.angle == -45.0
    assert lit.links["u"] == lit.links["q"]


def test_lamp_and_viewer_of_mirror_views_share_the_error_of_one_angle():
    """But for a set-up of the caller's own, which is taken as it is given."""
    angles = np.arange(20.0, 80.0, 5.0)
    capture = pb.from_goniometer((angles, 1.0 + angles), (angles, 90.0 - angles))
    setup = SETUPS["polarimeter"]
    found = as_read(setup, capture)
    apart = {"light_zenith", "light_azimuth", "view_zenith_scale"}
    names = {each.name for each in setup.known}
    assert {each.name for each in found.known} == names - apart | {"incidence_angle"}
    aside = capture.assign(view_azimuth=capture["view_azimuth"] + 30.0)
    assert as_read(setup, aside) is setup
    own = dataclasses.replace(setup, known=setup.known[:1])
    assert as_read(own, capture) is own
    by_stage = capture.assign_attrs(angle_set_by="stage")
    whole = dataclasses.replace(found, scene=found.scene.known_to(found.known))
    prior = default_priors(whole, by_stage)
    assert prior["incidence_angle_offset"] is pb.priors.ANGLE_ZERO["stage"]
    own = {"incidence_angle_offset": dist.Normal(0.0, 0.01)}
    assert default_priors(dataclasses.replace(whole, priors=own), by_stage) == own
    zero = dataclasses.replace(setup.scene, instrument=Instrument((AngleZero(),)))
    found = as_read(dataclasses.replace(setup, scene=zero), capture)
    assert {each.name for each in found.known} == names - apart


def request_of(**asked):
    protocol = pb.simulation.Protocol(views=12, wavelengths=())
    usual = dict.fromkeys(("scene", "priors", "links", "largest_view_zenith"))
    usual |= {"capture": pb.simulate("leaf", scene="camera", protocol=protocol)}
    return resolve(**usual | {"model": "per_material", "seed": 0, "precision": "double"} | asked)


def test_what_is_known_counts_more_than_a_prior_of_a_scene_file():
    """And is refused where the model has no such error."""
    stated = {"priors": dict(request_of().priors), "known": {"light_zenith": 0.2}}
    request = request_of(**stated)
    assert request.priors["light_zenith_offset"].scale == 0.2
    assert request.swapped == ("uncertainty of light_zenith (0.2)",)
    by_capture = request.capture.assign_attrs(light_zenith_uncertainty=0.1)
    request = request_of(capture=by_capture)
    assert request.swapped == ("uncertainty of light_zenith (by the capture)",)

    def perfect(data, scene, priors, links):
        per_material(data, scene.perfectly_known, priors, links)

    with pytest.raises(pb.FitError, match=r"priors\['light_zenith_offset'\]: no such parameter"):
        request_of(model=perfect, known=stated["known"])


def test_a_set_up_with_other_quantities_is_told():
    setup = SETUPS["camera"]
    assert not request_of(scene=setup).swapped
    request = request_of(scene=dataclasses.replace(setup, known=setup.known[:1]))
    assert (request.scene_name, *request.swapped) == ("camera", OWN_QUANTITIES)


def test_an_uncertainty_is_known_of_any_prior():
    """NumPyro states no variance of a distribution that is transformed."""
    gain = dist.TransformedDistribution(dist.Normal(2.0, 0.5), SigmoidTransform())
    u = request_of(priors={"dolp_gain": gain}).standard_uncertainties(["dolp_gain"])["dolp_gain"]
    z = np.linspace(-4.0, 8.0, 2001)
    weight, x = np.exp(-2.0 * (z - 2.0) ** 2), 1.0 / (1.0 + np.exp(-z))
    exact = np.cov(x, aweights=weight) ** 0.5
    assert u == pytest.approx(exact, rel=5.0 / np.sqrt(10_000.0))


@pytest.mark.thorough
def test_channels_of_different_light_are_not_combined():
    angles = np.arange(20.0, 80.0, 5.0)
    s, p = pb.from_goniometer(s=(angles, angles)), pb.from_goniometer(p=(angles, angles))
    with pytest.raises(pb.CaptureError, match="channel of intensity is p, that of s s"):
        pb.capture.combine({"s": s, "p": p})


def test_every_parameter_is_explained_in_words():
    table = pb.setups.prior_table()
    plain = {"roughness", "albedo", "refractive_index", "subsurface_fraction"}
    plain |= {"cauchy_a", "cauchy_b"}
    unexplained = set(table.index[table["meaning"] == table.index.str.replace("_", " ")])
    assert unexplained <= plain


def test_a_table_prints_every_column_within_80_characters():
    text = repr(pb.setups.prior_table("goniometer"))
    assert all(column in text for column in pb.setups.prior_table("goniometer").columns)
    assert max(map(len, text.splitlines())) <= 80


@pytest.mark.thorough
def test_a_discrepancy_of_more_functions_has_as_many_weights():
    layout = pb.simulation.Protocol(views=24, wavelengths=(), azimuths=(180.0,))
    plate = pb.simulate("glass", scene="goniometer", protocol=layout)
    local = pb.instrument.Instrument((pb.instrument.Discrepancy(basis=6, length=15.0),))
    fitted = pb.fit(plate, scene=Scene(pb.SmoothSurface(), instrument=local), method="point")
    assert fitted["posterior"]["discrepancy_weights"].shape[-1] == 6
