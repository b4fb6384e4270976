"""A result at a glance: the report's words, and the tree stays what it is."""

import numpy as np
import pytest
from pages import EVIL, Page
from plates import plate_capture
from synthetic_results import SMALL, make_result, moved

import polar_bayes as pb
from polar_bayes.errors import FitError

pytestmark = pytest.mark.usefixtures("unpainted")


def test_a_failed_fit_looks_like_one() -> None:
    assert 'class="pb-card bad"' in pb.show(moved(1.0))._repr_html_()


def test_names_run_nothing() -> None:
    result = make_result(**SMALL, materials=(EVIL, "b"), name=EVIL)
    page = Page(pb.show(result)._repr_html_())
    assert not {"script", "img"} & set(page.tags)


def test_a_capture_is_checked_before_it_is_shown() -> None:
    capture = plate_capture(np.linspace(20.0, 70.0, 5), 0.02, seed=1)
    with pytest.raises(pb.CaptureError, match="no such variable"):
        pb.show(capture.assign(view_zenit=capture["view_zenith"]))


def test_what_is_no_result_is_refused() -> None:
    with pytest.raises(FitError, match="it holds no fit"):
        pb.show("fit.nc")
