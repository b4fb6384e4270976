"""Where a map is computed: on the device that JAX is told to use, whatever it is."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.thorough

SCRIPT = """
import jax
from plate_images import ASKED, plate_image
import polar_bayes as pb
from polar_bayes.numerics.compile import JitOnce

jax.config.update("jax_disable_most_optimizations", True)
_, second = jax.devices()
seen = set()
run = JitOnce.__call__

def watched(self, *given):
    found = run(self, *given)
    for array in jax.tree.leaves(found):
        seen.update(array.devices())
    return found

image, method = plate_image(2, 3), pb.methods.CorrectedLaplace(draws=64, sampler=None)
here = pb.fit_pixels(image, method=method, **ASKED)
jax.config.update("jax_default_device", second)
jax.clear_caches()
JitOnce.__call__ = watched
there = pb.fit_pixels(image, method=method, **ASKED)
assert seen == {second}, seen
for name, values in here.items():
    assert values.values.tobytes() == there[name].values.tobytes(), name
"""


def test_a_map_is_computed_on_the_default_device() -> None:
    """Two devices of one CPU stand for a CPU and a GPU; every program runs on the second."""
    paths = os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    flags = "--xla_force_host_platform_device_count=2 " + os.environ.get("XLA_FLAGS", "")
    environment = {**os.environ, "PYTHONPATH": paths, "XLA_FLAGS": flags}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
