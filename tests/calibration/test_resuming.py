"""Calibrations in a store: what they share with maps is in `contracts/test_stores.py`."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cloudpickle
import numpy as np
import numpyro.distributions as dist
import pytest
import xarray as xr
from plate_images import ASKED, LINKS
from plates import PLATE, plate_capture
from stores import StoredCalibration, assert_same_bits, copied, stored

import polar_bayes as pb
from polar_bayes.calibration.calibrate import make_plan
from polar_bayes.calibration.runner import CalibrationPlan, fit_block
from polar_bayes.inference.request import resolve
from polar_bayes.maps.blocks import digest

pytestmark = pytest.mark.thorough

VIEWS = np.array([30.0, 42.0, 68.0, 80.0])


@pytest.fixture(autouse=True, scope="module")
def kind(tmp_path_factory: pytest.TempPathFactory) -> Iterator[StoredCalibration]:
    with stored("calibration", tmp_path_factory.mktemp("asked")) as found:
        yield found


@pytest.fixture(scope="module")
def whole(kind: StoredCalibration) -> xr.DataTree:
    return kind.run(None)


@pytest.fixture(scope="module")
def begun(kind: StoredCalibration, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return kind.break_off(tmp_path_factory.mktemp("begun") / "sbc.nc.fits")


def test_more_or_fewer_simulations_are_the_same_question(kind, whole, begun, tmp_path) -> None:
    """A block that was cut short at 30 is not fitted again: the rest of it is."""
    store = copied(begun, tmp_path)
    few = kind.run(store, simulations=30, resume=True)
    assert_same_bits(few, whole.isel(simulation=slice(30)))
    more = kind.run(store, resume=True)
    assert_same_bits(more, whole)
    assert json.loads(more.attrs["polar_bayes"])["fits found in the store"] == 30
    fits = [pb.load(path)["fits"].sizes["simulation"] for path in store.glob("*.nc")]
    assert sum(fits) == kind.total


def test_another_question_is_refused(kind, begun) -> None:
    for other, topic in (
        ({"truth": {"priors": {"refractive_index": dist.Uniform(1.2, 2.0)}}}, "truth"),
        ({"readings": False}, "readings"),
        ({"capture": plate_capture(VIEWS + 1e-9, 0.03, seed=0)}, "capture"),
    ):
        with pytest.raises(pb.FitError, match=f"begun with another {topic}; repeat the command as"):
            kind.run(begun, resume=True, **other)


def test_what_cannot_be_gone_on_with_is_refused(kind, begun, tmp_path) -> None:
    with pytest.raises(pb.FitError, match="resume: there is no store to go on with"):
        kind.run(None, resume=True)
    earlier = copied(begun, tmp_path / "earlier")
    kind.journal(earlier).rename(earlier / "ledger")  # as it was called before
    with pytest.raises(pb.OutputError, match="no calibration that this version can resume; give"):
        kind.run(earlier, resume=True)
    with pytest.raises(pb.OutputError, match="it could not be written"):
        kind.run(tmp_path / "nowhere" / "fits")
    with pytest.raises(pb.FitError, match="no scheduler answers there"):
        kind.run(None, scheduler="tcp://127.0.0.1:9")


def planned(priors: dict[str, dist.Distribution] | None = None) -> CalibrationPlan:
    capture = plate_capture(VIEWS, 0.03, seed=0)
    request = resolve(capture, ASKED["model"], PLATE, priors, LINKS, None, 0, "double")
    return make_plan(request, None, pb.methods.Importance(), True)


def test_a_plan_that_was_sent_makes_the_same_block(whole) -> None:
    """As a worker gets it."""
    plan = planned()
    sent = cloudpickle.loads(cloudpickle.dumps(plan))
    assert sent.key == plan.key
    found = fit_block(sent, np.array([3, 17]))
    assert_same_bits(found, whole.isel(simulation=[3, 17]))


def test_a_model_s_code_and_what_it_encloses_are_part_of_the_question() -> None:
    def make(offset: float):
        return lambda data: data + offset

    assert digest(make(1.0)) == digest(make(1.0))
    assert digest(make(1.0)) != digest(make(2.0))
    assert digest(lambda data: data + 1) != digest(lambda data: data - 1)
    assert digest({"a": np.ones(3)}) != digest({"a": np.ones(3) + 1e-15})


ASK = """
import json
import numpyro.distributions as dist
from polar_bayes.calibration.runner import topics_of
from test_resuming import planned
print(json.dumps(topics_of(planned({"refractive_index": dist.TruncatedNormal(1.5, 0.1, low=1.2)}))))
"""


def test_the_question_is_the_same_in_every_process() -> None:
    """However the process orders its sets."""
    paths = os.pathsep.join([str(Path(__file__).parents[1]), str(Path(__file__).parent), *sys.path])
    told = []
    for order in ("1", "2"):
        asked = {**os.environ, "PYTHONPATH": paths, "PYTHONHASHSEED": order}
        done = subprocess.run(
            [sys.executable, "-c", ASK], capture_output=True, text=True, check=True, env=asked
        )
        told.append(json.loads(done.stdout.splitlines()[-1]))
    assert told[0] == told[1]
