"""The named set-ups hang together, and a wrong name is answered with the right ones."""

import dataclasses
import inspect

import numpy as np
import pytest
from cases import each

import polar_bayes as pb
from polar_bayes.errors import SceneError
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
    prior = default_priors(
        dataclasses.replace(found, scene=found.scene.known_to(found.known)),
        capture.assign_attrs(angle_set_by="stage"),
    )
    assert prior["incidence_angle_offset"] is pb.priors.ANGLE_ZERO["stage"]


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
