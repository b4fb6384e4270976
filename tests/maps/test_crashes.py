"""What no test of one process can show: a process killed at any moment, a worker of a cluster lost.

Each map is made by processes of their own, which compile for themselves; bits must agree all the
same.
"""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import xarray as xr
from cases import each
from plate_images import plate_image

pytestmark = pytest.mark.thorough

SCRIPT = """
import sys
import polar_bayes as pb
from plate_images import ASKED
from polar_bayes.maps import store
store.BLOCK = 512
capture, out, resume, scheduler = sys.argv[1:]
pb.maps.map_file(
    capture,
    out,
    resume=resume == "resume",
    scheduler=scheduler if scheduler != "none" else None,
    progress=lambda done, every: print(done, flush=True),
    method=pb.methods.CorrectedLaplace(
        draws=64, sampler=pb.methods.Nuts(warmup=50, draws=50, most_draws=50)
    ),
    **ASKED,
)
"""
"""A map in blocks of 512 pixels, which says how many are done."""


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("image") / "plates.zarr"
    plate_image(64, 96, noise=0.08, seed=5).chunk(y=16, x=32).to_zarr(file, consolidated=False)
    return file


@pytest.fixture(scope="module")
def whole(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> xr.Dataset:
    out = tmp_path_factory.mktemp("whole") / "map.zarr"
    with started(capture, out) as process:
        assert process.wait() == 0
    return read(out)


def started(
    capture: Path, out: Path, *, resume: bool = False, scheduler: str = "none"
) -> subprocess.Popen:
    paths = os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    return subprocess.Popen(
        [sys.executable, "-c", SCRIPT, capture, out, "resume" if resume else "new", scheduler],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": paths, "JAX_ENABLE_COMPILATION_CACHE": "false"},
    )


def read(out: Path) -> xr.Dataset:
    return xr.open_zarr(out, consolidated=False).load()


@each("moment", [0, 1, 5, 11])
def test_a_killed_map_goes_on_to_the_bits_of_one_that_was_not(
    capture: Path, whole: xr.Dataset, tmp_path: Path, moment: int
) -> None:
    """Killed as soon as so many of the twelve blocks are done, or half a second into the work."""
    out = tmp_path / "map.zarr"
    with started(capture, out) as process:
        assert process.stdout is not None
        for _ in range(moment):
            process.stdout.readline()
        if not moment:
            while not out.exists():
                time.sleep(0.05)
            time.sleep(0.5)
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
    assert out.with_name("map.zarr.progress").exists()
    with started(capture, out, resume=True) as process:
        assert process.stdout is not None
        first = int(process.stdout.readline())
        assert process.wait() == 0
    assert first > 512 * max(moment - 1, 0)  # what was done is not done again
    xr.testing.assert_identical(read(out), whole)


def test_ten_kills_in_a_row_change_no_bit(capture: Path, whole: xr.Dataset, tmp_path: Path) -> None:
    """Four are killed when they have done another block, six some seconds after their start."""
    out = tmp_path / "map.zarr"
    for kill in range(10):
        with started(capture, out, resume=kill > 0) as process:
            assert process.stdout is not None
            if kill % 3:
                time.sleep(kill)
            else:
                assert process.stdout.readline()
            process.send_signal(signal.SIGKILL)
            process.wait()
    with started(capture, out, resume=True) as process:
        assert process.wait() == 0
    xr.testing.assert_identical(read(out), whole)
    assert not out.with_name("map.zarr.progress").exists()


def test_a_killed_worker_loses_nothing_and_changes_no_bit(
    capture: Path, whole: xr.Dataset, tmp_path: Path
) -> None:
    distributed = pytest.importorskip("distributed")
    out = tmp_path / "map.zarr"
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=":0"
        ) as cluster,
        started(capture, out, scheduler=cluster.scheduler_address) as process,
    ):
        assert process.stdout is not None
        process.stdout.readline()
        victim = next(iter(cluster.workers.values()))
        os.kill(victim.pid, signal.SIGKILL)
        assert process.wait() == 0
    xr.testing.assert_identical(read(out), whole)
