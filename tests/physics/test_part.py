"""What parts share: settings that are numbers or names."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from cases import each

from polar_bayes.errors import SceneError
from polar_bayes.physics.coat import ClearCoat
from polar_bayes.physics.part import (
    Part,
    check_part,
    check_setting,
    like,
    names_in,
    parameters_of,
    value_of,
)
from polar_bayes.physics.surface import RoughSurface, SmoothSurface


@each("dtype", [np.float32, np.float64])
def test_a_number_takes_the_precision_of_the_parameters(dtype: type) -> None:
    parameters = {"albedo": jnp.asarray(0.25, dtype)}
    assert value_of(0.5, parameters).dtype == dtype
    assert value_of("albedo", parameters) is parameters["albedo"]
    assert like([1.0, 2.0], parameters["albedo"]).dtype == dtype


def test_names_come_once_and_in_order() -> None:
    assert names_in("b", 1.0, "a", "b") == ("b", "a")
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


def test_parts_are_frozen_values() -> None:
    assert RoughSurface() == RoughSurface()
    assert hash(RoughSurface()) == hash(RoughSurface())
    with pytest.raises(dataclasses.FrozenInstanceError):
        RoughSurface().shadowing = None
    assert SmoothSurface().simpler() == ()
