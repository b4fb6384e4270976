"""A result at a glance: the report's words, and the tree stays what it is."""

import numpy as np
import pytest
from pages import EVIL, Page
from plates import plate_capture
from synthetic_results import SMALL, make_result, moved

import polar_bayes as pb
from polar_bayes.errors import FitError

pytestmark = pytest.mark.usefixtures("unpainted")


def test_the_verdict_comes_before_the_numbers() -> None:
    text = repr(pb.show(make_result(**SMALL)))
    assert text.startswith("leaf: fit\nThe fit converged.\nThe data determine")
    assert "refractive_index" in text.partition("parameter")[2]


@pytest.mark.thorough
def test_a_failed_fit_says_so_and_claims_nothing() -> None:
    card = pb.show(moved(1.0))
    assert "do not use these numbers" in repr(card)
    assert "The data determine" not in repr(card)
    assert 'class="pb-card bad"' in card._repr_html_()


def test_names_run_nothing() -> None:
    result = make_result(**SMALL, materials=(EVIL, "b"), name=EVIL)
    page = Page(pb.show(result)._repr_html_())
    assert not {"script", "img"} & set(page.tags)


@pytest.mark.thorough
def test_a_long_table_is_cut_and_says_so() -> None:
    result = make_result(**{**SMALL, "views": 4}, materials=tuple(map(str, range(30))))
    assert "The first 40 of 121 rows." in repr(pb.show(result))


def test_a_capture_tells_its_variables_and_what_is_unlikely() -> None:
    capture = plate_capture(np.linspace(20.0, 70.0, 5), 0.02, seed=1)
    text = repr(pb.show(capture.drop_attrs(deep=False)))
    assert text.startswith("capture: capture\nReadings: q")
    assert "Set-up: not stated" in text
    assert "view_zenith" in text.partition("variable")[2]
    with pytest.raises(pb.CaptureError, match="no such variable"):
        pb.show(capture.assign(view_zenit=capture["view_zenith"]))


def test_a_scene_a_set_up_and_priors_tell_what_they_hold() -> None:
    text = repr(pb.show(pb.setups.SETUPS["goniometer"].scene))
    assert "surface: SmoothSurface()" in text
    assert "gain of the s channel over the p channel" in text
    assert "links: q StokesLink(" in repr(pb.show(pb.setups.SETUPS["goniometer"]))
    text = repr(pb.show({"angle_zero": pb.PRIORS["angle_zero"]}))
    assert "offset of both zenith angles" in text
    assert "degree" in text
    assert "Normal(loc=0, scale=0.75)" in text


def test_what_is_no_result_is_refused() -> None:
    with pytest.raises(FitError, match="it holds no fit"):
        pb.show("fit.nc")
