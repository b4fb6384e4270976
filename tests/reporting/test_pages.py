"""Pages word by word: what a reader is told by results of every kind, as it was approved.

    PYTHONPATH=tests python tests/reporting/test_pages.py

takes the present words as the approved ones. Every row, sentence, link and alternative text is a
line of `approved/NAME.txt`. Words change only with a reason, which the commit that changes them
states.
"""

import difflib
import re
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from cases import each
from pages import EVIL, Page, blank_pictures, faults_of
from plates import plate_capture
from synthetic_accuracy import make_accuracy
from synthetic_calibrations import NAMES, make_calibration
from synthetic_maps import make_maps
from synthetic_results import SMALL, edit_provenance, make_result, moved, pool, with_law, worse

import polar_bayes as pb
from polar_bayes.inference.batching import MethodUsed, Status
from polar_bayes.reporting.report import render

pytestmark = pytest.mark.usefixtures("unpainted")

APPROVED = Path(__file__).with_name("approved")
SHAPE = (10, 20)
MEANS = {
    "roughness": np.full(SHAPE, 0.5),
    "subsurface_fraction": np.linspace(0.2, 0.4, 200).reshape(SHAPE),
    "concentration_scale": np.full(SHAPE, 300.0),
}


def populations(**asked: object) -> xr.DataTree:
    """Twelve members of two populations, of which one has a name that is markup."""
    names = ("leaf", EVIL, "a" * 60, *map(str, range(9)))
    members = {"materials": names, "views": 8, "draws": 60}
    return pool(make_result(**SMALL | members | asked), "refractive_index", "roughness")


def colored() -> xr.DataTree:
    """An index by Cauchy's law, and a model of the user's own."""
    source = f"def story(data):\n    # {EVIL}\n    return 1 < 2\n"
    swapped = ["scene", "model", *(f"prior of p{i}" for i in range(7)), "prior of roughness"]
    swapped += [f"{EVIL} held fixed"]
    own = {
        "model": "story",
        "model_source": source,
        "swapped": swapped,
        "declared": {"tilt": "Normal"},
    }
    own["model_settings"] = {"pooled": ["roughness"], "process": {"kernel": "matern52"}}
    return edit_provenance(with_law(), **own, fixed={EVIL: 1.45})


def odd() -> xr.DataTree:
    """Names that are markup, endless, or made of spaces."""
    names = (EVIL, "a" * 200, "b c " * 60)
    result = make_result(**{**SMALL, "views": 6}, materials=names, discrepancy=True)
    about = {"capture": {EVIL: EVIL, "name": EVIL + "n" * 300}, "scene": EVIL, "problems": [EVIL]}
    failed = {"comparisons_failed": {"without_instrument": EVIL}}
    return edit_provenance(result, **about, **failed, priors={EVIL: EVIL})


def mixed(**asked: object) -> xr.Dataset:
    """A map with 160 good pixels of 200: 100 by weights, 50 by a fitted proposal, 10 by NUTS."""
    status, method = np.full(200, Status.GOOD), np.full(200, MethodUsed.IMPORTANCE)
    method[100:150], method[150:160] = MethodUsed.ADAPTED, MethodUsed.NUTS
    status[160:195], method[160:195] = Status.MASKED, MethodUsed.NONE
    status[195:197], method[195:197] = Status.TOO_FEW_VIEWS, MethodUsed.NONE
    status[197:199], method[197:199] = Status.NOT_TRUSTED, MethodUsed.LAPLACE
    status[199], method[199] = Status.NOT_CONVERGED, MethodUsed.NONE
    flags = {"status": status.reshape(SHAPE), "methods": method.reshape(SHAPE)}
    return make_maps(MEANS, **flags, **asked)


def truth(name: str = "leaf") -> xr.Dataset:
    spread = ((np.arange(200) * 37 % 200 + 0.5) / 200).reshape(SHAPE)
    return xr.Dataset({"true_roughness": (("y", "x"), spread)}, attrs={"name": name})


def map_in_colors() -> xr.Dataset:
    """A map of five parameters and four wavelengths, not all of which are drawn."""
    names = ("refractive_index", "roughness", "subsurface_fraction", "angle_zero", "dark_level")
    means = {name: np.full((3, 4), 0.5) for name in names}
    means["refractive_index"] = np.full((3, 4, 4), 1.5)
    colors = (400.0, 500.0, 600.0, 700.0)
    return make_maps(means, wavelengths=colors, method="laplace", scene=EVIL, priors={EVIL: EVIL})


WRONG = {"narrow": {"roughness": 0.7}, "shifted": {"refractive_index": 0.4}}
"""Roughness is told too narrowly, and the index too high."""


def calibrated(**asked: object) -> xr.DataTree:
    return make_calibration(**{"failed": (3, 50, 77)} | asked)


def strange_calibration() -> xr.DataTree:
    """Fifteen parameters with markup for names, checked with other priors than were fitted."""
    names = tuple(f"parameter_{at}" for at in range(15))
    own = {"capture": EVIL, "scene": EVIL, "versions": {"a": EVIL}, "priors": {EVIL: EVIL * 20}}
    asked = {"names": names, "count": 60, "truth": {"priors": "Uniform(0, 1)"}}
    return calibrated(**asked, **own, failed=(1,), method=EVIL)


def strangely_compared() -> str:
    other = calibrated(names=tuple(f"parameter_{at}" for at in range(15)), count=60, failed=())
    return render(strange_calibration(), comparisons={f"{EVIL}2": other})


def study_in_a_fit() -> xr.DataTree:
    result = make_result(**SMALL)
    result["accuracy"] = make_accuracy()["accuracy"]
    return result


CASES: dict[str, Callable[[], str]] = {
    "fit": lambda: render(make_result(wavelengths=(450.0, 550.0), views=20, discrepancy=True)),
    "failed fit": lambda: render(moved(1.0)),
    "scattered": lambda: render(make_result(**SMALL | {"draws": 250}, noise=4.0)),
    "doubted": lambda: render(
        edit_provenance(make_result(**SMALL), prior_probability={"roughness": [0.997]})
    ),
    "markup": lambda: render(odd()),
    "populations": lambda: render(populations(method="laplace")),
    "color": lambda: render(colored()),
    "map": lambda: render(
        mixed(scene="paper", model="per_material", priors={"roughness": "Beta(2, 3)"}),
        truth=truth(),
        uncorrected=make_maps(MEANS, width=0.5, method="laplace"),
    ),
    "calibration": lambda: render(
        calibrated(), comparisons={"laplace": calibrated(**WRONG, method="laplace")}
    ),
    "bad calibration": lambda: render(calibrated(**WRONG, readings={"dop": 0.7}, method="laplace")),
    "accuracy": lambda: render(make_accuracy()),
    "study in a fit": lambda: render(study_in_a_fit()),
    "comparison": lambda: render(
        {
            "plain": make_result(**SMALL),
            "other": edit_provenance(
                worse(1.0), model="hierarchical", priors={"roughness": "Beta(1, 9)"}
            ),
            EVIL: edit_provenance(moved(5.0, slice(4)), problems=["no mode was reached"]),
        }
    ),
}
MORE: dict[str, Callable[[], str]] = {
    "laplace": lambda: render(
        edit_provenance(
            make_result(**SMALL, method="laplace"),
            comparisons_failed={"without_discrepancy": "Fit: no mode was found; add views"},
        )
    ),
    "point": lambda: render(make_result(**SMALL, method="point")),
    "a method of ones own": lambda: render(
        edit_provenance(make_result(**SMALL, method="laplace"), method="my <b>own</b>")
    ),
    "two readings": lambda: render(make_result(**{**SMALL, "views": 2})),
    "failed population": lambda: render(
        edit_provenance(populations(), problems=["the mode is not settled"])
    ),
    "map without truth": lambda: render(mixed()),
    "map in colors": lambda: render(map_in_colors()),
    "map without answers": lambda: render(
        make_maps(MEANS, status=np.full(SHAPE, Status.NOT_CONVERGED)), truth=truth()
    ),
    "map of nothing": lambda: render(make_maps(MEANS, status=np.full(SHAPE, Status.MASKED))),
    "calibration in colors": lambda: render(
        calibrated(names=NAMES[:1], wavelengths=(450.0, 650.0), count=60, failed=range(10))
    ),
    "calibration without answers": lambda: render(calibrated(count=30, failed=range(30))),
    "strange calibration": strangely_compared,
    "doubtful accuracy": lambda: render(make_accuracy(doubts="its R-hat is 1.3")),
    "alike": lambda: render({"a": make_result(**SMALL), "b": worse(1e-3)}),
}


def approved_file(name: str) -> Path:
    return APPROVED / f"{name.replace(' ', '_')}.txt"


def check_page(name: str, make: Callable[[], str]) -> None:
    page = Page(make())
    assert faults_of(page) == []
    assert "nan" not in page.text.split()
    check_approved(name, page.lines)


def check_approved(name: str, lines: list[str]) -> None:
    approved = approved_file(name).read_text().splitlines()
    changed = list(difflib.unified_diff(approved, lines, "approved", "now", n=0, lineterm=""))
    assert not changed, "\n".join(changed)


@each("name", CASES)
def test_a_page_says_what_was_approved(name: str) -> None:
    check_page(name, CASES[name])


@pytest.mark.thorough
@each("name", MORE)
def test_a_page_of_a_rarer_result_says_what_was_approved(name: str) -> None:
    check_page(name, MORE[name])


CARDS: dict[str, Callable[[], object]] = {
    "fit": lambda: make_result(**SMALL),
    "failed fit": lambda: moved(1.0),
    "thirty materials": lambda: make_result(
        **SMALL | {"views": 4, "draws": 30}, materials=tuple(map(str, range(30)))
    ),
    "capture": lambda: plate_capture(np.linspace(20.0, 70.0, 5), 0.02, seed=1).drop_attrs(
        deep=False
    ),
    "scene": lambda: pb.setups.SETUPS["goniometer"].scene,
    "set-up": lambda: pb.setups.SETUPS["goniometer"],
    "prior": lambda: {"angle_zero": pb.PRIORS["angle_zero"]},
}


def cards() -> list[str]:
    """The lines of every card."""
    lines = [
        line
        for name, make in CARDS.items()
        for line in (f"--- {name}", *repr(pb.show(make())).splitlines())
    ]
    # The third digit of R-hat is that of the processor: rounding swaps ranks of some of 30 draws.
    return [re.sub(r"(1\.\d\d)\d(?=,| and)", r"\1", line) for line in lines]


def test_a_card_says_what_was_approved() -> None:
    check_approved("cards", cards())


@each("group", ["noise_free", "posterior_predictive"])
def test_a_fit_without_predictions_has_a_page(group: str, tmp_path: Path) -> None:
    result = make_result(**SMALL)
    del result[group]
    assert "Parameters" in pb.report(result, tmp_path / "report").read_text()


ASKED_OF_A_REPORT: dict[str, Callable[[], tuple]] = {
    "comparisons: it goes with calibrations only": lambda: (
        make_result(**SMALL), {"comparisons": {"laplace": calibrated()}}
    ),
    "it goes with calibrations only": lambda: (make_accuracy(), {"comparisons": {}}),
    "report: truth: it goes with maps only": lambda: (calibrated(), {"truth": xr.Dataset()}),
    "truth: it goes with maps only": lambda: (make_result(**SMALL), {"truth": truth()}),
    "report: uncorrected: it goes with maps only": lambda: (
        make_result(**SMALL), {"uncorrected": mixed()}
    ),
    "comparisons, laplace: it is no calibration": lambda: compared(laplace=make_result(**SMALL)),
    "give it another name": lambda: compared(importance=calibrated()),
    "too many for one figure": lambda: compared(**{f"c{at}": calibrated() for at in range(5)}),
    "it has other parameters than importance": lambda: compared(other=calibrated(names=NAMES[:1])),
    "it is compared with the truth only; give truth=": lambda: (mixed(), {"uncorrected": mixed()}),
    "it was corrected as well": lambda: (mixed(), {"truth": truth(), "uncorrected": mixed()}),
    "it is of another image": lambda: (
        mixed(), {"truth": truth(), "uncorrected": mixed().isel(y=slice(3))}
    ),
    "it states the truth of no parameter": lambda: (mixed(), {"truth": xr.Dataset()}),
}  # fmt: skip
"""Results and arguments that do not go together, by what is said of them."""


def compared(**others: xr.DataTree) -> tuple[xr.DataTree, dict]:
    return calibrated(), {"comparisons": others}


@each("says", ASKED_OF_A_REPORT)
def test_what_a_report_refuses_leaves_no_folder(says: str, tmp_path: Path) -> None:
    result, arguments = ASKED_OF_A_REPORT[says]()
    with pytest.raises(pb.PolarBayesError, match=re.escape(says)) as error:
        pb.report(result, tmp_path / "report", **arguments)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "report").exists()


@each("wrong", [None, xr.DataTree(), "fit.nc", xr.Dataset()])
def test_what_is_no_result_leaves_no_folder(tmp_path: Path, wrong: object) -> None:
    with pytest.raises(pb.FitError, match="it holds no fit"):
        pb.report(wrong, tmp_path / "report")
    assert not (tmp_path / "report").exists()


def write_all() -> None:
    """Every page, as it is now."""
    APPROVED.mkdir(exist_ok=True)
    with blank_pictures():
        for name, make in (CASES | MORE).items():
            approved_file(name).write_text("\n".join(Page(make()).lines) + "\n")
    approved_file("cards").write_text("\n".join(cards()) + "\n")


if __name__ == "__main__":
    import jax

    jax.config.update("jax_enable_x64", True)
    sys.exit(write_all())
