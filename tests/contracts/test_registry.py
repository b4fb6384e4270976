"""One name, one algorithm: every verb runs the settings that a fit runs, or refuses the name."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from plate_images import plate_image
from plates import ON_PLATE, plate_capture
from toy_models import line

import polar_bayes as pb
from polar_bayes.cli.entry import main
from polar_bayes.methods.method import AbstractMethod, find_method, make_method
from polar_bayes.methods.registry import METHODS, method_names

ASKED = ON_PLATE | {"model": line}
"""A model that compiles in a moment: what is asked for counts here, and no answer."""


class Ran(BaseException):
    """Records what a verb was about to run; a base exception that no handler catches."""


CAPTURE, IMAGE = plate_capture(np.linspace(30.0, 75.0, 6), 0.02, seed=1), plate_image(1, 2)
CALIBRATED = ASKED | {"simulations": 20}
VERBS: dict[str, tuple[Callable[[str], object], str]] = {
    "fit": (lambda name: pb.fit(CAPTURE, method=name, **ASKED), "run"),
    "fit_pixels": (lambda name: pb.fit_pixels(IMAGE, method=name, **ASKED), "run_batch"),
    "calibrate": (lambda name: pb.calibrate(CAPTURE, method=name, **CALIBRATED), "run_batch"),
}
"""Each verb, and the function of a method that it calls."""


def run(self: Any, *given: object, **further: object) -> None:
    raise Ran(self)


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("verb", VERBS)
def test_a_verb_runs_what_a_fit_runs_or_refuses_the_name(verb, name, monkeypatch):
    """Methods end with their own settings instead of running."""
    call, function = VERBS[verb]
    able = method_names(one=verb == "fit", many=verb != "fit")
    if name not in able:
        with pytest.raises(pb.FitError, match=f"{name} .*; give one of {able[0]}, ") as refused:
            call(name)
        assert "\n" not in str(refused.value)
        return
    monkeypatch.setattr(type(make_method(name)), function, run)
    with pytest.raises(Ran) as ran:
        call(name)
    (found,) = ran.value.args
    if name == "corrected-laplace":  # an image decides from how many starts
        found = dataclasses.replace(found, starts=None)
    assert found == make_method(name)


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("command", ["fit", "map", "calibrate"])
def test_a_command_hands_the_name_on(command, name, monkeypatch, tmp_path):
    given: list[Any] = []

    def note(*_: object, **settings: object) -> None:
        given.append(settings["method"])
        raise pb.FitError("this is as far as it goes", where="here")

    for owner, function in ((pb, "fit"), (pb, "calibrate"), (pb.maps, "map_file")):
        monkeypatch.setattr(owner, function, note)
    pb.save_capture(CAPTURE, tmp_path / "capture.nc")
    asked = [command, str(tmp_path / "capture.nc"), "--method", name]
    assert main([*asked, "--out", str(tmp_path / "out.nc")]) == 1
    able = method_names(one=command == "fit", many=command != "fit")
    assert bool(given) == (name in able)
    if given:
        assert find_method(given[0], command) == make_method(name)


def test_a_study_compares_the_methods_of_a_fit() -> None:
    for name in method_names(one=True):
        if name != "auto":
            assert pb.methods.STUDY_METHODS[name] == make_method(name)


@pytest.mark.parametrize("name", METHODS)
def test_what_is_registered_is_what_the_class_can_do(name: str) -> None:
    method, entry = make_method(name), METHODS[name]
    assert isinstance(method, AbstractMethod) == entry.fits_one
    assert entry.label
    assert entry.subject
    assert find_method(method, "fit") is method


def test_default_methods_are_named() -> None:
    assert pb.calibrate.__wrapped__.__kwdefaults__["method"] is None
    with pytest.raises(pb.FitError, match="no such method"):
        find_method("hmc", "fit", one=True)
