"""The front door: what it offers, what opening it costs, and that it leaves others whole.

Imports are counted in fresh processes, by the modules that are there afterwards; nothing is timed.
"""

import inspect
import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest

import polar_bayes as pb

HEAVY = ("jax", "numpyro", "arviz", "matplotlib", "xarray", "netCDF4")


def run(code):
    """Return the output of a fresh interpreter; its errors fail the test."""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=600
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


# --- names ----------------------------------------------------------------------------------------

CONTRACT = {
    *("load_capture", "simulate", "from_goniometer", "from_polarizer", "choose_effects", "fit"),
    *("fit_pixels", "report", "Scene", "Geometry", "RoughSurface", "GGX", "Beckmann"),
    *("PointSource", "Disc", "UniformSky", "Unpolarized", "Lambertian", "Depolarizer"),
    *("TurbidMedium", "ClearCoat", "ThinFilm", "DopMixing", "StokesMixing"),
    *("physics", "instrument", "links", "methods", "models", "importers", "calibration"),
    *("design", "benchmark", "plots"),
}
"""Names that other people's code may rely on."""


def namespaces() -> dict[str, Any]:
    """The package and the packages in it that load their names lazily."""
    found = {"pb": pb}
    for name in pb.__all__:
        thing = getattr(pb, name)
        if inspect.ismodule(thing) and hasattr(thing, "__all__"):
            found[f"pb.{name}"] = thing
    return found


def test_every_public_name_loads_and_says_what_it_is() -> None:
    for place, namespace in namespaces().items():
        assert len(namespace.__all__) == len(set(namespace.__all__)), place
        for name in namespace.__all__:
            thing = getattr(namespace, name)
            if callable(thing):
                assert inspect.getdoc(thing), f"{place}.{name}"
                assert thing.__module__.startswith("polar_bayes."), f"{place}.{name}"


def test_the_names_of_the_contract_are_there() -> None:
    assert set(pb.__all__) >= CONTRACT
    assert dir(pb) == list(pb.__all__)


def test_the_package_says_its_version_as_its_metadata_do() -> None:
    assert pb.__version__ == version("polar_bayes")


def test_a_name_that_does_not_exist_is_an_attribute_error() -> None:
    for namespace in namespaces().values():
        with pytest.raises(AttributeError, match="fitt"):
            namespace.fitt  # noqa: B018


def test_every_error_can_be_caught_as_one_kind():
    for name in ("CaptureError", "SceneError", "FitError", "OutputError"):
        assert issubclass(getattr(pb, name), pb.PolarBayesError)
        assert issubclass(getattr(pb, name), ValueError)


# --- what opening it costs ------------------------------------------------------------------------

LOADED = f"""
import sys
from importlib.metadata import version
from pathlib import Path
heavy = {HEAVY!r}
loaded = sorted({{name.split(".")[0] for name in sys.modules}} & set(heavy))
assert not loaded, loaded
"""


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("import polar_bayes", ""),
        ("import polar_bayes\npolar_bayes.CaptureError", ""),
        ("from polar_bayes.cli import main\nassert main(['--help']) == 0", "Usage: polar-bayes"),
        (
            "from polar_bayes.cli import commands, main\n"
            "for name in commands.commands:\n    assert main([name, '--help']) == 0",
            "Usage: polar-bayes fit",
        ),
    ],
    ids=["the package", "an error", "help", "help of every command"],
)
def test_no_array_library_is_loaded_before_it_is_needed(code: str, said: str) -> None:
    printed = run(code + LOADED)
    assert said in printed if said else not printed


QUIET = """
import os, sys
import polar_bayes as pb
pb.Geometry
assert "jax" in sys.modules and "TF_CPP_MIN_LOG_LEVEL" not in os.environ
import jax
from polar_bayes.numerics.compile import compiled
assert jax.config.jax_compilation_cache_dir is None
jax.jit(lambda x: x + 2.0)(1.0)
compiled(lambda x: x + 1.0)(1.0)
print(jax.config.jax_compilation_cache_dir)
"""


@pytest.mark.thorough
def test_programs_are_kept_on_the_disk_from_the_first_that_is_compiled(tmp_path, monkeypatch):
    """What JAX compiled before does not keep them from it; the environment stays what it was."""
    for name in [name for name in os.environ if "COMPILATION_CACHE" in name or "TF_CPP" in name]:
        monkeypatch.delenv(name)
    tmp_path.chmod(0o700)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder = Path(run(QUIET).strip())
    assert folder == tmp_path / "cache" / "polar_bayes" / "compiled"
    assert list(folder.glob("*-cache"))
    monkeypatch.setenv("JAX_ENABLE_COMPILATION_CACHE", "false")
    assert run(QUIET).strip() == "None"


# --- what importing leaves behind -----------------------------------------------------------------

WHOLE = """
import sys
from importlib.metadata import version
from pathlib import Path
polar_bayes.fit
import numpyro.distributions
import numpyro.infer.util
assert hasattr(numpyro.distributions, "distribution")
assert isinstance(polar_bayes.PRIORS["roughness"], numpyro.distributions.Distribution)
program = sys.modules["polar_bayes.inference.program"]
assert program.compute_log_probs is numpyro.infer.util.compute_log_probs  # there is only one
"""


EVERY_MODULE = """
import importlib, pkgutil, sys
import arviz, jax, numpyro
from jax._src import xla_bridge

flags = dict(jax.config.values)
validated = numpyro.distributions.Distribution._validate_args
import polar_bayes
polar_bayes.Scene  # the first name that is asked for, before any module
import polar_bayes.models

packages = [(package.__path__, package.__name__) for package in (polar_bayes, polar_bayes.models)]
names = {
    module.name
    for path, package in packages
    for module in pkgutil.walk_packages(path, f"{package}.")
}
for name in sorted(names):
    importlib.import_module(name)
count = sum(name.startswith("polar_bayes.") for name in sys.modules)
assert count > 40, count
assert not xla_bridge._backends, "an import started a backend, so it made an array"
changed = {key for key, value in jax.config.values.items() if flags.get(key, value) != value}
assert not changed, f"an import changed {changed}"
assert numpyro.distributions.Distribution._validate_args is validated
"""

DOUBLE = """
jax.config.update("jax_enable_x64", True)
draw = polar_bayes.PRIORS["refractive_index"].sample(jax.random.key(0))
density = polar_bayes.PRIORS["absorption"].log_prob(jax.numpy.asarray(0.3))
assert draw.dtype == density.dtype == "float64", (draw.dtype, density.dtype)
"""


def test_importing_every_module_makes_no_array_flips_no_flag_and_prints_nothing():
    """ArviZ comes first: it leaves a stand-in for NumPyro, which must not be run twice.

    Double precision may come later.
    """
    assert run(EVERY_MODULE + WHOLE + DOUBLE) == ""


EVERY_NAME = """
import random, sys, threading, warnings
import numpy as np

def spy(original):
    def add(*args, **kwargs):
        caller = sys._getframe(1).f_globals["__name__"]
        assert not caller.startswith("polar_bayes"), f"{caller} adds a filter of warnings"
        return original(*args, **kwargs)
    return add

for name in ("filterwarnings", "simplefilter", "resetwarnings"):
    setattr(warnings, name, spy(getattr(warnings, name)))
random.seed(7)
np.random.seed(7)
import polar_bayes as pb
for name in pb.__all__:
    before = random.getstate(), str(np.random.get_state())
    getattr(pb, name)
    assert (random.getstate(), str(np.random.get_state())) == before, f"{name} draws"
assert threading.enumerate() == [threading.main_thread()]
assert "jax" in sys.modules and "rich" in sys.modules
"""


@pytest.mark.thorough
def test_importing_every_name_draws_nothing_starts_no_thread_and_filters_no_warning():
    """JAX and Rich draw from the global states of NumPy and Python when they are imported."""
    assert run(EVERY_NAME) == ""


# --- others ---------------------------------------------------------------------------------------


@pytest.mark.thorough
@pytest.mark.parametrize("imports", ["import arviz, polar_bayes", "import polar_bayes, arviz"])
def test_arviz_and_numpyro_stay_whole_in_any_order_of_imports(imports):
    """ArviZ leaves a lazy stand-in for NumPyro, which `import numpyro.infer` would run twice."""
    assert run(f"{imports}{WHOLE}") == ""


def test_no_public_name_is_shadowed_by_a_module_of_the_package() -> None:
    """`import polar_bayes.x.y` sets the attribute `x`: no public function may be called so."""
    folder = Path(pb.__file__).parent
    modules = {path.stem for path in folder.iterdir()} | {"models"}
    assert all(inspect.ismodule(getattr(pb, name)) for name in modules & set(pb.__all__))
