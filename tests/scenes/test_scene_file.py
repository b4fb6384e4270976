"""Scene files: what a result was asked for, written, read, and fitted again."""

import dataclasses
import re
from pathlib import Path

import pytest
from cases import each
from numpyro import distributions as dist
from plates import plate_capture
from synthetic_results import edit_provenance

import polar_bayes as pb
from polar_bayes.inference.request import OWN_QUANTITIES
from polar_bayes.inference.result import provenance_of
from polar_bayes.setups import SETUPS

PLATE = plate_capture([20.0, 35.0, 50.0, 60.0, 70.0], 0.01, seed=2)
pytestmark = pytest.mark.usefixtures("without_comparisons")


@pytest.fixture(scope="module")
def fitted():
    return pb.fit(
        PLATE,
        scene=dataclasses.replace(SETUPS["goniometer"], scene=pb.Scene(pb.SmoothSurface())),
        method=pb.methods.Laplace(draws=100),
        priors={"refractive_index": dist.Uniform(1.3, 1.8 + 1e-9)},
        links={"q": pb.links.StokesLink(stated_errors=True)},
    )


def test_a_fit_by_the_file_of_a_fit_has_the_same_draws(fitted, tmp_path: Path):
    pb.save_scene(fitted, tmp_path / "plate.toml")
    again = pb.fit(PLATE, **pb.load_scene(tmp_path / "plate.toml"))
    assert again["posterior"].equals(fitted["posterior"])
    own, other = provenance_of(fitted), provenance_of(again)
    for key in ("scene_parts", "priors", "links", "method_parts", "largest_view_zenith"):
        assert own[key] == other[key]


def test_a_file_keeps_the_input_quantities_of_a_set_up(tmp_path: Path):
    """Those of the set-up that it names are added to a scene, unless the file says otherwise."""
    setup, few = SETUPS["picture"], SETUPS["picture"].known[1:2]
    asked = {"method": pb.methods.Laplace(draws=50), "links": {"q": pb.links.StokesLink()}}
    fitted = pb.fit(PLATE, scene=dataclasses.replace(setup, known=few), **asked)
    pb.save_scene(fitted, tmp_path / "few.toml")
    stated = pb.load_scene(tmp_path / "few.toml")
    assert stated["scene"].scene == setup.scene.known_to(few)
    again = pb.fit(PLATE, **stated)
    assert again["posterior"].equals(fitted["posterior"])
    assert OWN_QUANTITIES in provenance_of(again)["swapped"]


@pytest.mark.thorough
def test_what_a_file_states_as_it_is_shipped_is_not_swapped(tmp_path: Path):
    file = tmp_path / "plate.toml"
    pb.save_scene("goniometer", file)
    file.write_text(file.read_text() + "[priors]\nangle_zero = 'Normal(0.0, 0.75)'\n")
    said = provenance_of(pb.fit(PLATE, method="point", **pb.load_scene(file)))
    assert said["scene"] == "goniometer"
    assert said["scene_chosen_by"] == "caller"
    assert said["swapped"] == []


@each("name", SETUPS)
def test_the_file_of_a_set_up_names_it(name, tmp_path: Path):
    pb.save_scene(name, tmp_path / "setup.toml")
    assert pb.load_scene(tmp_path / "setup.toml") == {"scene": name}


WRONG = {
    "setup =": "it is no TOML",
    "quantities = 'some'": "quantities is 'some'; give 'listed'",
    "setups = 'paper'": "there is no entry 'setups'; did you mean setup",
    "setup = 'papr'": "no such scene; give one of paper",
    "model = 'mine'": "no such model; give one of per_material",
    "method = 'Nuts(samples=3)'": "there is no setting samples; did you mean draws",
    "largest_view_zenith = 'far'": "largest_view_zenith is 'far'; give a number",
    "priors = 'Normal(0, 1)'": "write a table",
    "[scene]\nsurfac = 'SmoothSurface()'": "no entry 'surfac'; did you mean surface",
    "[scene]\nmixing = 'DopMixing()'": "it has no surface",
    "[scene]\nsurface = 'SmotSurface()'": "scene.surface: SmotSurface is not known here; did you",
    "[scene]\nsurface = 'Lambertian()'": "is no such part; give SmoothSurface",
    "[links]\nq = 'Beckmann()'": "links.q: Beckmann is not known here",
    "[priors]\nangle_zero = 0.5": "priors.angle_zero: 0.5 is no text; quote it",
}


def test_parts_that_do_not_suit_each_other_are_refused_with_the_file(tmp_path: Path):
    file = tmp_path / "filmed.toml"
    parts = "surface = 'RoughSurface()'\nsubsurface = 'Lambertian()'\nmixing = 'StokesMixing()'\n"
    for wrong, where in (
        ("ThinFilm(1.4, 100.0)", ": way_out"),
        ("ThinFilm(0.5)", ".coat: ThinFilm"),
    ):
        file.write_text(f"[scene]\n{parts}coat = '{wrong}'\n")
        with pytest.raises(pb.SceneError, match=f"^{re.escape(f'{file}: scene{where}: ')}"):
            pb.load_scene(file)


@each("text", WRONG)
def test_a_mistake_in_a_file_gets_one_line(text, tmp_path: Path):
    file = tmp_path / "wrong.toml"
    file.write_text(text)
    with pytest.raises(pb.PolarBayesError, match="(?s).*" + WRONG[text].replace("(", r"\(")):
        pb.load_scene(file)


FILMED = "Scene(RoughSurface(), Lambertian(), StokesMixing(), ThinFilm(1.4, 100.0))"

OWN = {
    "stacked": ({"scene_parts": "0.50 x Scene(); 0.50 x Scene()"}, "it stacks several scenes"),
    "none": ({"scene_parts": None}, "it states no scene"),
    "model": ({"model": "mine"}, "a file cannot describe its model mine"),
    "part": ({"scene_parts": "Scene(surface=Mine())"}, "Mine is not known here"),
    "prior": ({"priors": {"albedo": "Mine()"}}, "priors.albedo: Mine is not known here"),
    "film": ({"scene_parts": FILMED}, r"^scene: way_out: RoughExit\(\) with ThinFilm: .*RoughPass"),
}


@each("what", OWN)
def test_what_a_file_cannot_describe_is_refused(what, fitted):
    edit, says = OWN[what]
    with pytest.raises(pb.PolarBayesError, match=says):
        pb.scenes.scene_text(edit_provenance(fitted.copy(), **edit))
