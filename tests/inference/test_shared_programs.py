"""What one fit compiled serves the next, where nothing but readings changed; and only there."""

import dataclasses
import importlib
import json
import os
import subprocess
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import numpy as np
import numpyro
import pytest
import xarray as xr
from cases import each
from compilations import compilations, compiled_fast
from numpyro import distributions as dist
from numpyro import handlers
from plates import LINKS, ON_PLATE, PLATE, plate_capture, plates
from spectral_plates import spectral_plate

import polar_bayes as pb
from polar_bayes.inference import program as programs
from polar_bayes.inference import request
from polar_bayes.inference.compiled_model import CompiledModel
from polar_bayes.inference.model_parts import ModelParts
from polar_bayes.inference.problem import compile_model
from polar_bayes.inference.program import ModelInfo, inspect_model
from polar_bayes.inference.request import resolve
from polar_bayes.maps.residuals import fitted_readings
from polar_bayes.models.per_material import per_material
from polar_bayes.numerics.compile import JitOnce, LRUCache
from polar_bayes.numerics.optimize import ignore_line_search_warnings
from polar_bayes.observation.data import observe
from polar_bayes.scenes.effects import ChosenScene

# The goals let chains of other readings stop at another length.
NUTS = pb.methods.Nuts(chains=2, warmup=50, draws=50, most_draws=100, block=25, ess=20.0)
LAPLACE = pb.methods.Laplace(draws=50, chains=2)
COLORS = np.array([450.0, 650.0])


def one(seed: int) -> xr.Dataset:
    return plate_capture(np.linspace(30.0, 75.0, 6), 0.02, seed)


def several(seed: int) -> xr.Dataset:
    return plates([1.45, 1.55], 0.03, seed=seed)


def colors(seed: int) -> xr.Dataset:
    views = np.linspace(30.0, 75.0, 6)
    return spectral_plate((COLORS, np.array([1.52, 1.5])), error=0.01, seed=seed, views=views)


@pytest.fixture(autouse=True)
def compile_fast_rather_than_fast_code(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    yield from compiled_fast(monkeypatch, starts=2, typical=20, draws=20, block=50)


@pytest.fixture
def compiled() -> Iterator[list[str]]:
    """Record what JAX compiles or reads from its cache."""
    with compilations() as found:
        yield found


SPECTRAL = pb.models.GpSpectral(coupled=("refractive_index",))


CASES = {
    "hierarchical laplace": ("hierarchical", LAPLACE, several),
    "nuts": ("per_material", NUTS, one),
    "laplace": ("per_material", LAPLACE, one),
    "point": ("per_material", pb.methods.Point(starts=2), one),
    "hierarchical nuts": ("hierarchical", NUTS, several),
    "spectral nuts": (SPECTRAL, NUTS, colors),
}


@pytest.mark.parametrize(
    "case",
    [
        case if case == "laplace" else pytest.param(case, marks=pytest.mark.thorough)
        for case in CASES
    ],
)
def test_other_readings_compile_nothing(case: str, compiled: list[str]) -> None:
    model, method, capture = CASES[case]

    def fit(seed: int, views: int) -> xr.DataTree:
        asked = ON_PLATE | {"model": model, "method": method}
        return pb.fit(capture(seed).isel(view=slice(views)), seed=seed, **asked)

    first = fit(1, 6)
    assert compiled
    compiled.clear()
    second = fit(2, 5)
    assert compiled == []
    assert first["log_likelihood"].sizes["view"] == 6
    assert second["posterior_predictive"].sizes["view"] == 5
    first_index, second_index = (tree["posterior"]["refractive_index"] for tree in (first, second))
    assert not np.isclose(float(first_index.mean()), float(second_index.mean()), rtol=1e-6)


@pytest.mark.parametrize(
    "method", [LAPLACE, pytest.param(NUTS, marks=pytest.mark.thorough)], ids=["laplace", "nuts"]
)
def test_what_was_compiled_for_others_gives_the_same_draws(method) -> None:
    """A fit is the same to the bit, whether or not another one compiled it."""
    asked = ON_PLATE | {"method": method, "seed": 3}
    before = pb.fit(one(1), **asked)
    pb.fit(one(2), **asked)
    again = pb.fit(one(1), **asked)
    xr.testing.assert_equal(before["posterior"].to_dataset(), again["posterior"].to_dataset())
    name = "posterior_predictive"
    xr.testing.assert_equal(before[name].to_dataset(), again[name].to_dataset())


def test_only_programs_of_the_package_have_a_key_for_other_processes() -> None:
    """A function of the user's own keeps its name when it is edited."""

    def own(model: CompiledModel, _: None) -> JitOnce:
        return JitOnce(lambda z: 2.0 * z)

    model = compiled_model(one(1))
    assert model.program.value_and_gradient.key == f"{model.program.key} value_and_gradient"
    assert model.program.key in model.made(fitted_readings, model.program.observed).key
    assert model.made(own, None).key == ""


@pytest.mark.thorough
def test_a_key_of_a_draw_depends_on_its_place_alone() -> None:
    """`fit` splits a round number of keys; the first of them must be those of any number."""
    key = jax.random.key(5)
    many, few = (
        jax.random.key_data(jax.random.split(key, count)) for count in (programs.KEYS, 1234)
    )
    assert np.array_equal(many[:1234], few)


@pytest.mark.thorough
def test_any_number_of_prior_draws_is_served_by_one_program(compiled, monkeypatch):
    monkeypatch.setattr(programs, "BLOCK", 8)
    with jax.enable_x64(True):
        data = observe(one(1))
        program = compiled_model(one(1)).program
        few = programs.from_prior(program, jax.random.key(5), 3, data)
        compiled.clear()
        more = programs.from_prior(program, jax.random.key(5), 7, data)
        assert compiled == []
        many = programs.from_prior(program, jax.random.key(5), 20, data)
        assert "jit(draw)" not in compiled
        alone = program.from_prior(jax.random.split(jax.random.key(5), 20)[19], data)
    assert few.shape == (3, program.size)
    assert np.array_equal(few, many[:3])
    assert np.array_equal(more, many[:7])
    # Inside the loop the compiler may round otherwise.
    np.testing.assert_allclose(many[19], alone, rtol=1e-12)


# --- what is shared, and what is not --------------------------------------------------------------


def compiled_model(capture: xr.Dataset, *, precision: str = "double", **asked: object) -> object:
    usual = {"model": "per_material", "scene": PLATE, "priors": None, "links": LINKS}
    wish = resolve(capture, *(usual | asked).values(), None, 0, precision)
    with jax.enable_x64(precision == "double"):
        data = observe(wish.capture)
        if precision == "single":
            data = data.in_single_precision()
        return compile_model(wish, data)


def held(value: float) -> handlers.condition:
    return handlers.condition(per_material, data={"stokes_error_factor": value})


def shifted(by: float) -> Callable:
    def model(data, scene, priors, links) -> None:
        del scene, priors, links
        mean = numpyro.sample("mean", dist.Normal(by, 1.0))
        with numpyro.plate("view", data.shape[-1]):
            numpyro.sample("q", dist.Normal(mean, 0.5), obs=data.readings["q"])

    return model


WIDE, WIDER = ({"refractive_index": dist.Uniform(1.3, high)} for high in (1.8, 1.9))
STUDENT = pb.links.StokesLink(stated_errors=True, degrees_of_freedom=4.0)
LONGER = plate_capture(np.linspace(30.0, 75.0, 7), 0.02, 1)
SAME: dict[str, tuple[dict, dict]] = {
    "defaults": ({}, {}),
    "a value held": ({"model": held(1.0)}, {"model": held(1.0)}),
    "a model that encloses a value": ({"model": shifted(1.0)}, {"model": shifted(1.0)}),
    "a prior": ({"priors": WIDE}, {"priors": {"refractive_index": dist.Uniform(1.3, 1.8)}}),
}
OTHER: dict[str, tuple[dict, dict]] = {
    "a value held": ({"model": held(1.0)}, {"model": held(1.5)}),
    "a model that encloses a value": ({"model": shifted(1.0)}, {"model": shifted(2.0)}),
    "a prior": ({}, {"priors": WIDE}),
    "a bound of a prior": ({"priors": WIDE}, {"priors": WIDER}),
    "a link": ({}, {"links": {"q": STUDENT}}),
    "a scene": ({}, {"scene": pb.Scene(surface=pb.SmoothSurface())}),
    "the precision": ({}, {"precision": "single"}),
    "a layout": ({}, {"capture": LONGER}),
}


@each("what", SAME)
def test_the_same_question_shares_what_is_compiled(what: str) -> None:
    first, second = SAME[what]
    assert compiled_model(one(1), **first) is compiled_model(one(2), **second)


@pytest.mark.thorough
def test_a_story_is_told_to_the_first_capture_of_a_layout_only(monkeypatch):
    told: list[tuple[int, ...]] = []

    def with_progress(parts, data) -> ModelInfo:
        told.append(data.shape)
        return inspect_model(parts, data)

    monkeypatch.setattr(request, "inspect_model", with_progress)
    asked = (shifted(0.25), PLATE, None, LINKS, None, 0, "double")
    first, again = (resolve(one(seed), *asked) for seed in (1, 2))
    assert told == [(6,)]
    assert first.declared == again.declared == {"mean": "Normal"}
    resolve(plate_capture(np.linspace(30.0, 75.0, 7), 0.02, 1), *asked)
    assert told == [(6,), (7,)]


@each("what", OTHER)
def test_another_question_shares_nothing(what: str) -> None:
    first, second = ({"capture": one(1), **asked} for asked in OTHER[what])
    assert compiled_model(**first) is not compiled_model(**second)


@pytest.mark.thorough
def test_how_a_scene_was_chosen_does_not_count() -> None:
    keys = set()
    for number in range(2):
        scene = ChosenScene(**vars(PLATE))
        object.__setattr__(scene, "ledger", xr.Dataset({"cost": number}))
        keys.add(ModelParts(per_material, scene, {}, LINKS).key())
    assert len(keys) == 1


SOURCE = """
import dataclasses, jax, helper_of_mine
from polar_bayes.observation.links import StokesLink
SCALE = 2.0
def inner(x):
    return [helper_of_mine.shift(SCALE * y) for y in x]
@jax.jit
def jitted(x):
    return x + 1
def model(data, scene, priors, links):
    return jax.vmap(lambda x: jitted(inner(x)))(data)
class Link(StokesLink):
    def reading(self, values):
        return values
@dataclasses.dataclass(frozen=True)
class Model:
    size: int = 1
    def __call__(self, data, scene, priors, links):
        return model(data, scene, priors, links)
"""
HELPER = "def shift(x):\n    return x + 3\n"


def load_anew(folder: Path, *edit: str) -> tuple[str, ...]:
    """Cache keys of the user's model, as a function and as a value, and of the user's link."""
    for name, text in (("model_of_mine", SOURCE), ("helper_of_mine", HELPER)):
        (folder / f"{name}.py").write_text(text.replace(*edit) if edit else text)
        sys.modules.pop(name, None)
    importlib.invalidate_caches()
    mine = importlib.import_module("model_of_mine")
    models = (mine.model, mine.Model(), handlers.condition(mine.model, data={}))
    keys = [ModelParts(model, PLATE, {}, {}).key() for model in models]
    return *keys, ModelParts(per_material, PLATE, {}, {"q": mine.Link()}).key()


def test_a_model_that_is_edited_and_loaded_again_is_another(tmp_path, monkeypatch):
    """It has the same name as before, which is all that a pickle of it says."""
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.syspath_prepend(str(tmp_path))
    before = load_anew(tmp_path)
    assert load_anew(tmp_path) == before
    for edit in (("SCALE = 2.0", "SCALE = 3.0"), ("x + 1", "x - 1"), ("x + 3", "x + 4")):
        edited = load_anew(tmp_path, *edit)
        assert [a != b for a, b in zip(before, edited, strict=True)] == [True, True, True, False]
    edited = load_anew(tmp_path, "return values", "return values + 0.1")
    assert edited[-1] != before[-1]
    del sys.modules["model_of_mine"], sys.modules["helper_of_mine"]


@pytest.mark.thorough
def test_the_last_few_are_kept() -> None:
    made: list[str] = []
    kept: LRUCache[str] = LRUCache(2)

    def ask(key: str) -> str:
        return kept.of(key, lambda: (made.append(key), key)[1])

    for key in ("a", "b", "a", "c", "a", "b"):
        assert ask(key) == key
    assert made == ["a", "b", "c", "b"]  # c took the place of b, which was asked for before a


@pytest.mark.thorough
def test_fits_side_by_side_leave_warnings_as_they_were() -> None:
    """The first ends before the second does: neither may undo what the other needs."""
    first_ended, second_began = threading.Event(), threading.Event()
    before = list(warnings.filters)

    def second() -> None:
        with ignore_line_search_warnings():
            second_began.set()
            first_ended.wait(10.0)
            warnings.warn("The line search algorithm did not converge", stacklevel=1)

    with ThreadPoolExecutor(1) as pool:
        with ignore_line_search_warnings():
            running = pool.submit(second)
            assert second_began.wait(10.0)
        first_ended.set()
        running.result()  # a warning is an error
    assert list(warnings.filters) == before


CELL = """
import dataclasses
import jax
import polar_bayes as pb
def shift(x):
    return x
@dataclasses.dataclass(frozen=True)
class Body(pb.Lambertian):
    def light(self, *given):
        return jax.tree.map(lambda x: shift(x), super().light(*given))
class Model:
    def __init__(self):
        self.itself = self
    def __call__(self, data, scene, priors, links):
        return Body().light(data)
"""


def test_what_is_edited_in_a_notebook_is_another_scene_to_simulate_and_to_fit() -> None:
    """Its classes stay as they are: their functions see what the next cell defines."""
    cells: dict[str, Any] = {"__name__": "__main__"}
    exec(CELL, cells)
    model, body = cells["Model"](), cells["Body"]()
    scene = pb.Scene(pb.SmoothSurface(), body, pb.StokesMixing())
    few = pb.simulation.Protocol(views=4, wavelengths=())

    def asked() -> tuple[str, float]:
        capture = pb.simulate("plastic", scene=scene, protocol=few)
        return ModelParts(model, scene, {}, LINKS).key(), float(capture["dop"].sum())

    before = asked()
    assert asked() == before
    exec("def shift(x):\n    return 2.0 * x", cells)
    after = asked()
    assert after[0] != before[0]
    assert after[1] != before[1]
    assert type(body).light.__globals__ is cells


@pytest.mark.thorough
def test_a_link_that_holds_an_array_simulates() -> None:
    @dataclasses.dataclass(frozen=True)
    class Tabled(pb.links.BetaLink):
        table: np.ndarray = dataclasses.field(default_factory=lambda: np.ones(3))

    few = pb.simulation.Protocol(views=4, wavelengths=())
    found = pb.simulate("plastic", links={"dop": Tabled()}, protocol=few)
    plain = pb.simulate("plastic", links={"dop": pb.links.BetaLink()}, protocol=few)
    xr.testing.assert_equal(found, plain)


MOST_PROGRAMS = {
    "simulate": 1,
    "fit": 12,
    "fit again": 0,
    "next views": 5,
    "identify": 2,
    "choose effects": 11,
    "report": 0,
}
"""Most programs that a verb compiles in a new process, after the verbs above it; 9 of those of
effects are for its scenes."""

COUNTING = """
import json, sys
import jax
jax.config.update("jax_disable_most_optimizations", True)
import polar_bayes as pb
count = []
def listen(event, seconds, **_):
    if event == "/jax/core/compile/backend_compile_duration":
        count.append(event)
jax.monitoring.register_event_duration_secs_listener(listen)
found = {}
def counted(verb, call):
    count.clear()
    result = call()
    found[verb] = len(count)
    return result
capture = counted("simulate", lambda: pb.simulate("plastic", seed=0))
nuts = pb.methods.Nuts(warmup=50, draws=50, most_draws=50, block=50)
result = counted("fit", lambda: pb.fit(capture, method=nuts))
counted("fit again", lambda: pb.fit(pb.simulate("plastic", seed=1), method=nuts))
counted("next views", lambda: pb.next_views(result))
counted("identify", lambda: pb.identify(capture))
counted("choose effects", lambda: pb.choose_effects(capture))
counted("report", lambda: pb.report(result, sys.argv[1]))
print(json.dumps(found))
"""


@pytest.mark.thorough
def test_a_verb_compiles_few_programs(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", COUNTING, str(tmp_path / "report")],
        env=os.environ | {"JAX_ENABLE_COMPILATION_CACHE": "false"},
        capture_output=True,
        text=True,
        check=True,
    )
    found = json.loads(done.stdout.splitlines()[-1])
    assert found == MOST_PROGRAMS
