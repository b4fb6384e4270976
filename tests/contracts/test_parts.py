"""Contract of the parts of a scene: frozen values whose settings are numbers or names."""

import dataclasses
import inspect
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from cases import each

import polar_bayes as pb
from polar_bayes.errors import SceneError
from polar_bayes.physics.coat import ClearCoat
from polar_bayes.physics.dispersion import Sellmeier
from polar_bayes.physics.instrument import AbstractInstrumentTerm
from polar_bayes.physics.part import (
    Part,
    absence,
    check_part,
    check_setting,
    like,
    parameters_of,
    value_of,
)
from polar_bayes.physics.stokes import Light
from polar_bayes.physics.surface import RoughSurface, SmoothSurface
from polar_bayes.priors import support_bounds

SETTINGS: dict[type, tuple] = {
    pb.Disc: (5.0,),
    pb.physics.SunAndSky: (0.05,),
    pb.physics.CoatStack: ((pb.ClearCoat(), pb.ThinFilm()),),
    pb.physics.AnisotropicSlopes: ("roughness_azimuth",),
    pb.physics.LinearPolarization: ("light_degree", "light_angle"),
    pb.TurbidMedium: ("polarized_fraction",),
    pb.instrument.Analyzer: (30.0,),
    pb.instrument.Saturation: (0.5,),
}
"""Settings of the parts that cannot be made without any."""


def every_part() -> dict[str, Any]:
    """A value of every part that a user can put into a scene."""
    found = {}
    for namespace in (pb.physics, pb.instrument, pb.input_quantities):
        for name in namespace.__all__:
            part = getattr(namespace, name)
            concrete = inspect.isclass(part) and not inspect.isabstract(part)
            if concrete and issubclass(part, Part) and part is not Part:
                found[name] = part(*SETTINGS.get(part, ()))
    return found


PARTS = every_part()


@each("part", PARTS.values(), ids=PARTS)
def test_every_part_is_a_frozen_value_that_its_repr_makes_again(part: Part) -> None:
    assert dataclasses.replace(part) == part
    assert hash(dataclasses.replace(part)) == hash(part)
    names = vars(pb.physics) | vars(pb.instrument) | vars(pb.input_quantities)
    assert eval(repr(part), names) == part
    for field in dataclasses.fields(part):
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(part, field.name, None)


EVERY_PART = each("part", PARTS.values(), ids=PARTS)


@EVERY_PART
def test_every_part_reads_parameters_that_have_a_prior_or_that_its_settings_name(part):
    assert len(part.parameters) == len(set(part.parameters))
    named = {value for value in vars(part).values() if isinstance(value, str)}
    assert set(part.parameters) <= set(pb.PRIORS) | named


@each("part", PARTS.values(), ids=PARTS)
def test_what_is_simpler_than_a_part_can_stand_in_its_place(part: Part) -> None:
    """A replacement is another part of the same contract, and reads no further parameter."""
    contract = type(part).__mro__[type(part).__mro__.index(Part) - 1]
    for simpler in part.simpler():
        assert simpler != part
        assert simpler is None or isinstance(simpler, contract)
        assert simpler is None or set(simpler.parameters) <= set(part.parameters)


@each("dtype", [np.float32, np.float64])
def test_a_number_takes_the_precision_of_the_parameters(dtype: type) -> None:
    parameters = {"albedo": jnp.asarray(0.25, dtype)}
    assert value_of(0.5, parameters).dtype == dtype
    assert value_of("albedo", parameters) is parameters["albedo"]
    assert like([1.0, 2.0], parameters["albedo"]).dtype == dtype


def test_names_come_once_and_in_order() -> None:
    assert Sellmeier(("b", 1.0), ("a", "b")).parameters == ("b", "a")
    both = parameters_of(ClearCoat("a", "b"), None, ClearCoat("c", "a"))
    assert both == ("a", "b", "c")


@each("value", [0.0, 1, 0.5, "albedo"])
def test_settings_in_range_and_names_pass(value: object) -> None:
    check_setting(value, "here", 0.0, 1.0)


@each("value", [-0.1, 1.1, float("nan"), True, None, "two words", "", np.array([0.5])])
def test_other_settings_are_refused_with_what_to_give(value: object) -> None:
    message = r"here: .* is neither a number from 0 to 1 nor a parameter's name; give the number"
    with pytest.raises(SceneError, match=message):
        check_setting(value, "here", 0.0, 1.0)


def test_a_part_of_another_kind_is_refused() -> None:
    with pytest.raises(SceneError, match=r"here: ClearCoat\(.*\) is no such part; give a surface"):
        check_part(ClearCoat(), "here", SmoothSurface, "a surface")
    check_part(RoughSurface(), "here", Part, "a part")


TERMS = {n: x for n, x in PARTS.items() if isinstance(x, AbstractInstrumentTerm) and x.parameters}


@each("term", TERMS.values(), ids=TERMS)
def test_a_fault_that_is_not_there_is_no_conflict_with_a_prior_that_ends_there(term) -> None:
    for name in term.neutral.keys() & pb.PRIORS.keys():
        if term.neutral[name] in support_bounds(pb.PRIORS[name]):
            fault = absence(name)
            assert fault is not None
            assert fault.value == term.neutral[name]


@each("term", TERMS.values(), ids=TERMS)
def test_a_term_at_its_neutral_values_changes_nothing(term: AbstractInstrumentTerm) -> None:
    assert set(term.neutral) <= set(term.parameters)
    zeniths = jnp.array([0.0, 30.0, 60.0, 89.0])
    geometry = pb.Geometry(zeniths, jnp.full(4, 180.0), zeniths, jnp.zeros(4))
    light = Light(jnp.array([0.1, 0.2, 0.5, 1.0]), jnp.array([0.0, 0.4, 0.9, -0.3]), jnp.zeros(4))
    known = {name: jnp.array([value]) for name, value in term.neutral.items()}
    # What has no neutral value must not matter then: weights of a function of amplitude 0.
    parameters = {name: known.get(name, jnp.ones((3, 1))) for name in term.parameters}
    for there, here in zip(term.aim(parameters, geometry)[:4], geometry[:4], strict=True):
        np.testing.assert_array_equal(there, here)
    for there, here in zip(term.record(parameters, geometry, light), light, strict=True):
        np.testing.assert_allclose(there, here, rtol=1e-14)
