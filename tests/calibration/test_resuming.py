"""A calibration that was broken off goes on to the same bits; another question is refused."""

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import cloudpickle
import jax
import numpy as np
import numpyro.distributions as dist
import pytest
import xarray as xr
from cases import each
from numpyro import handlers
from plates import LINKS, PLATE, plate_capture

import polar_bayes as pb
from polar_bayes import interrupts
from polar_bayes.calibration import runner as module
from polar_bayes.calibration.calibrate import make_plan
from polar_bayes.inference.request import resolve
from polar_bayes.maps.blocks import digest, locked_ledger
from polar_bayes.models.per_material import per_material

ASKED = {
    "model": handlers.condition(per_material, data={"stokes_error_factor": 1.0}),
    "scene": PLATE,
    "links": LINKS,
    "method": "importance",
}
COUNT = 40


@pytest.fixture(scope="module")
def capture() -> xr.Dataset:
    return plate_capture(np.array([30.0, 42.0, 68.0, 80.0]), 0.03, seed=0)


@pytest.fixture(autouse=True, scope="module")
def small_blocks():
    """Blocks of few fits; compilation is what they cost, so it is done in haste."""
    jax.config.update("jax_disable_most_optimizations", True)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(pb.methods.Importance, "group_size", 12)
        yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.fixture(scope="module")
def whole(capture: xr.Dataset) -> xr.DataTree:
    return pb.calibrate(capture, simulations=COUNT, **ASKED)


@pytest.fixture(scope="module")
def begun(capture: xr.Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a calibration leaves that was broken off after two of its four blocks."""
    store = tmp_path_factory.mktemp("begun") / "sbc.nc.fits"

    def progress(done: int, every: int) -> None:
        assert every == COUNT
        if done >= 24:
            raise BrokenOff

    with pytest.raises(BrokenOff):
        pb.calibrate(capture, simulations=COUNT, store=store, progress=progress, **ASKED)
    return store


class BrokenOff(Exception):  # noqa: N818 - no mistake of a user
    """Stands in for a crash."""


def copied(store: Path, folder: Path) -> Path:
    return Path(shutil.copytree(store, folder / "sbc.nc.fits"))


def assert_same_bits(found: xr.DataTree, expected: xr.DataTree) -> None:
    assert set(found.children) == set(expected.children)
    for name in expected.children:
        xr.testing.assert_identical(found[name].to_dataset(), expected[name].to_dataset())


@pytest.mark.thorough
def test_what_was_broken_off_goes_on_to_the_same_bits(capture, whole, begun, tmp_path) -> None:
    store, seen, said = copied(begun, tmp_path), [], []

    def progress(done: int, every: int) -> None:
        seen.append(done)
        said.extend(interrupts.clean_up())  # as an interrupt does

    left = store / ".polar-bayes-crashed"
    left.mkdir()
    (left / "00000036-00000039.npz").write_bytes(b"half a blo")
    found = pb.calibrate(
        capture,
        simulations=COUNT,
        store=store,
        resume=True,
        progress=progress,
        **ASKED,
    )
    assert said == [f"{store}: what is done is kept; repeat the command with --resume to go on"]
    assert seen[0] > 24
    assert seen[-1] == COUNT
    assert_same_bits(found, whole)
    assert json.loads(found.attrs["polar_bayes"])["fits found in the store"] >= 24


@pytest.mark.thorough
def test_more_or_fewer_simulations_are_the_same_question(capture, whole, begun, tmp_path) -> None:
    """A block that was cut short at 30 is not fitted again: the rest of it is."""
    store = copied(begun, tmp_path)
    few = pb.calibrate(capture, simulations=30, store=store, resume=True, **ASKED)
    assert_same_bits(few, whole.isel(simulation=slice(30)))
    more = pb.calibrate(capture, simulations=COUNT, store=store, resume=True, **ASKED)
    assert_same_bits(more, whole)
    fits = sum(len(np.load(path)["numbers"]) for path in store.glob("*.npz"))
    assert fits == COUNT


@pytest.mark.thorough
def test_a_damaged_block_is_fitted_again(capture, whole, begun, tmp_path) -> None:
    store = copied(begun, tmp_path)
    victim = min(store.glob("*.npz"))
    victim.write_bytes(victim.read_bytes()[:2000])
    found = pb.calibrate(capture, simulations=COUNT, store=store, resume=True, **ASKED)
    assert_same_bits(found, whole)


@pytest.mark.thorough
@each(
    ("other", "topic"),
    [
        ({"seed": 1}, "seed"),
        ({"method": pb.methods.Importance(draws=512)}, "method"),
        ({"priors": {"refractive_index": dist.Uniform(1.2, 2.0 + 1e-9)}}, "priors"),
        ({"truth": {"priors": {"refractive_index": dist.Uniform(1.2, 2.0)}}}, "truth"),
        (
            {"links": {"q": pb.links.StokesLink(degrees_of_freedom=5.0, stated_errors=True)}},
            "links",
        ),
        ({"model": handlers.condition(per_material, data={"stokes_error_factor": 1.1})}, "model"),
        ({"largest_view_zenith": 70.0}, "capture, another largest_view_zenith"),
        ({"readings": False}, "readings"),
    ],
    ids=lambda each: each if isinstance(each, str) else "",
)
def test_another_question_is_refused(capture, begun, other, topic) -> None:
    with pytest.raises(pb.FitError, match=f"begun with another {topic}; repeat the command as"):
        pb.calibrate(capture, store=begun, resume=True, **{**ASKED, **other})


@pytest.mark.thorough
def test_another_layout_is_refused(capture, begun) -> None:
    moved = capture.assign(view_zenith=capture["view_zenith"] + 1e-9)
    with pytest.raises(pb.FitError, match="it was begun with another capture; repeat"):
        pb.calibrate(moved, store=begun, resume=True, **ASKED)


@pytest.mark.thorough
def test_what_cannot_be_gone_on_with_is_refused(capture, begun, tmp_path) -> None:
    with pytest.raises(pb.FitError, match="there already; give another --out, or --resume"):
        pb.calibrate(capture, store=begun, **ASKED)
    with pytest.raises(pb.FitError, match="resume: there is no store to go on with"):
        pb.calibrate(capture, resume=True, **ASKED)
    (tmp_path / "letters.txt").write_text("mine")
    with pytest.raises(pb.FitError, match="it holds no calibration; give another --out"):
        pb.calibrate(capture, store=tmp_path, resume=True, **ASKED)
    with pytest.raises(pb.FitError, match="it could not be written"):
        pb.calibrate(capture, store=tmp_path / "nowhere" / "fits", **ASKED)
    with pytest.raises(pb.FitError, match="no scheduler answers there"):
        pb.calibrate(capture, simulations=20, scheduler="tcp://127.0.0.1:9", **ASKED)


@pytest.mark.thorough
def test_a_second_process_is_refused(capture, begun, tmp_path) -> None:
    store = copied(begun, tmp_path)
    with (
        locked_ledger(store / "ledger", store, "calibration", {}, resume=True),
        pytest.raises(pb.OutputError, match="fits: another process is writing it; wait until"),
    ):
        pb.calibrate(capture, simulations=COUNT, store=store, resume=True, **ASKED)


@pytest.mark.thorough
def test_a_damaged_ledger_is_refused_and_can_be_removed(capture, whole, begun, tmp_path) -> None:
    store = copied(begun, tmp_path)
    content = (store / "ledger").read_bytes()
    (store / "ledger").write_bytes(content.replace(b"-000000", b"-000001", 1))
    with pytest.raises(pb.OutputError, match="ledger: line 2 is damaged; remove that file to fit"):
        pb.calibrate(capture, simulations=COUNT, store=store, resume=True, **ASKED)
    (store / "ledger").unlink()
    found = pb.calibrate(capture, simulations=COUNT, store=store, resume=True, **ASKED)
    assert_same_bits(found, whole)


@pytest.mark.thorough
def test_a_plan_that_was_sent_makes_the_same_block(capture, whole) -> None:
    """As a worker gets it."""
    request = resolve(capture, ASKED["model"], PLATE, None, LINKS, None, 0, "double")
    plan = make_plan(request, None, pb.methods.Importance(), True)
    sent = cloudpickle.loads(cloudpickle.dumps(plan))
    assert sent.key == plan.key
    found = module.fit_block(sent, np.array([17, 3]))
    for name, pit in found.pit.items():
        np.testing.assert_array_equal(pit, whole["prior_sbc"][name].to_numpy()[[17, 3]])
    for name, pit in found.left_out.items():
        np.testing.assert_array_equal(pit, whole["loo_pit"][name].to_numpy()[[17, 3]])


@pytest.mark.thorough
def test_a_model_s_code_and_what_it_encloses_are_part_of_the_question() -> None:
    def make(offset: float):
        return lambda data: data + offset

    assert digest(make(1.0)) == digest(make(1.0))
    assert digest(make(1.0)) != digest(make(2.0))
    assert digest(lambda data: data + 1) != digest(lambda data: data - 1)
    assert digest({"a": np.ones(3)}) != digest({"a": np.ones(3) + 1e-15})


ASK = """
import json
import numpy as np
import numpyro.distributions as dist
import polar_bayes as pb
from plates import plate_capture
from polar_bayes.calibration.calibrate import make_plan
from polar_bayes.calibration.runner import fingerprint_of
from polar_bayes.inference.request import resolve
from test_resuming import ASKED
capture = plate_capture(np.array([30.0, 42.0, 68.0, 80.0]), 0.03, seed=0)
priors = {"refractive_index": dist.TruncatedNormal(1.5, 0.1, low=1.2)}
asked = {**ASKED, "priors": priors}
asked = [asked.get(name) for name in ("scene", "priors", "links")]
request = resolve(capture, ASKED["model"], *asked, None, 0, "double")
print(json.dumps(fingerprint_of(make_plan(request, None, pb.methods.Importance(), True))))
"""


@pytest.mark.thorough
def test_the_question_is_the_same_in_every_process() -> None:
    """However the process orders its sets."""
    paths = os.pathsep.join([str(Path(__file__).parents[1]), str(Path(__file__).parent)])
    told = []
    for order in ("1", "2"):
        asked = {**os.environ, "PYTHONPATH": paths, "PYTHONHASHSEED": order}
        done = subprocess.run(
            [sys.executable, "-c", ASK], capture_output=True, text=True, check=True, env=asked
        )
        told.append(json.loads(done.stdout.splitlines()[-1]))
    assert told[0] == told[1]


SCRIPT = """
import sys
import numpy as np
import polar_bayes as pb
from plates import plate_capture
from test_resuming import ASKED
store, resume, scheduler, out, size, count = sys.argv[1:]
pb.methods.Importance.group_size = int(size)
found = pb.calibrate(
    plate_capture(np.array([30.0, 42.0, 68.0, 80.0]), 0.03, seed=0),
    simulations=int(count),
    store=store,
    resume=resume == "resume",
    scheduler=scheduler if scheduler != "none" else None,
    progress=lambda done, every: print(done, flush=True),
    **ASKED,
)
pb.save(found, out)
"""


def started(
    store: Path,
    out: Path,
    *,
    resume: bool = False,
    scheduler: str = "none",
    size: int = 12,
    count: int = COUNT,
) -> subprocess.Popen:
    paths = [str(Path(__file__).parents[1]), str(Path(__file__).parent)]
    asked = [store, "resume" if resume else "new", scheduler, out, str(size), str(count)]
    return subprocess.Popen(
        [sys.executable, "-c", SCRIPT, *asked],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
    )


@pytest.fixture
def all_in_haste(monkeypatch: pytest.MonkeyPatch) -> None:
    """Processes that are started compile as this one does."""
    monkeypatch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")


@pytest.mark.thorough
@pytest.mark.usefixtures("all_in_haste")
def test_a_killed_calibration_goes_on_to_the_bits_of_one_that_was_not(whole, tmp_path) -> None:
    store, out = tmp_path / "sbc.nc.fits", tmp_path / "sbc.nc"
    with started(store, out) as process:
        assert process.stdout is not None
        process.stdout.readline()
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
    assert not out.exists()
    with started(store, out, resume=True) as process:
        assert process.stdout is not None
        assert int(process.stdout.readline()) > 12
        assert process.wait() == 0
    assert_same_bits(pb.load(out), whole)


@pytest.mark.thorough
@pytest.mark.usefixtures("all_in_haste")
def test_workers_of_a_cluster_make_the_same_bits(tmp_path: Path) -> None:
    """In three blocks of the size that workers know."""
    distributed = pytest.importorskip("distributed")
    given: dict = {"size": 64, "count": 130}
    with started(tmp_path / "fits", tmp_path / "sbc.nc", **given) as process:
        assert process.wait() == 0
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=None
        ) as cluster,
        started(
            tmp_path / "others",
            tmp_path / "cluster.nc",
            scheduler=cluster.scheduler_address,
            **given,
        ) as process,
    ):
        assert process.wait() == 0
    whole = pb.load(tmp_path / "sbc.nc")
    assert_same_bits(pb.load(tmp_path / "cluster.nc"), whole)
