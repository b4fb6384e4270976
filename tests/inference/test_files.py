"""Result files: what was written is what is read, and whatever is wrong is told in one line."""

import json
import math
import re
import warnings
from types import SimpleNamespace

import arviz_base as az
import numpy as np
import pytest
import xarray as xr
from cases import each
from mutations import ODD_ATTRIBUTES, mutate_tree, pick
from synthetic_accuracy import make_accuracy
from synthetic_calibrations import make_calibration
from synthetic_maps import make_maps
from synthetic_results import edit_provenance, make_result, pool, replace

import polar_bayes as pb
from polar_bayes.calibration.verdict import check_calibration
from polar_bayes.diagnostics import convergence
from polar_bayes.diagnostics.compare import compare_without
from polar_bayes.diagnostics.predictive import predictive_checks
from polar_bayes.diagnostics.sensitivity import sensitivity
from polar_bayes.diagnostics.view import view_of
from polar_bayes.inference.result import assemble, posterior_of
from polar_bayes.observation.data import ANGLES

SMALL = {"views": 4, "draws": 30, "chains": 2}
AUTO = {
    "tolerance": 0.1,
    "met": True,
    "chosen": "nuts",
    "steps": [
        {"name": "laplace", "taken": False, "why": "Pareto k", "seconds": 1.0, "monte_carlo": None},
        {"name": "nuts", "taken": True, "why": "", "seconds": 2.0, "monte_carlo": 0.02},
    ],
}
OTHER = {
    **{"part": "Beckmann", "alternative": "GGX", "path": "surface.distribution", "defines": []},
    **{"log_bayes_factor": -1.0, "shift": {"roughness": [0.5]}},
}
TAILS = {"pareto_k": 0.3, "ess": 500.0, "shares": {"roughness": [[0.02, 0.03]]}}
MANY = pool(
    edit_provenance(
        make_result(**SMALL, wavelengths=(450.0, 550.0), materials=("a", "b")),
        auto=AUTO,
        bounds={"roughness": [0.0, None]},
        alternatives=[OTHER],
        tails=TAILS,
        comparisons_failed={"without_discrepancy": "why"},
    ),
    "roughness",
)
RESULTS = (
    MANY,
    make_result(views=4, draws=60, method="laplace", wavelengths=()),
    make_result(views=4, method="point", wavelengths=()),
)
THAT = view_of(RESULTS[1])
CALIBRATION = make_calibration(count=40, wavelengths=(450.0, 550.0), readings={"dop": 1.0})


def outcome(function, tree):
    """None after a refusal in one line; anything else is returned, or raised."""
    try:
        return function(tree)
    except pb.PolarBayesError as error:
        message = str(error)
    assert message.isprintable()
    assert ": " in message
    assert "; " in message
    return None


OF_FITS = (
    pb.summary,
    pb.verdict,
    lambda tree: json.dumps(pb.diagnostics.json_summary(tree), allow_nan=False),
    lambda tree: pb.show(tree)._repr_html_(),
    pb.inference.auto_sentences,
    pb.diagnostics.population_summary,
    pb.diagnostics.stack_readings,
    predictive_checks,
    sensitivity,
    lambda tree: pb.diagnostics.compare_fits({"this": tree, "that": THAT}),
)
OF_CALIBRATIONS = (
    pb.summary,
    pb.verdict,
    pb.calibration.calibration_readings,
    lambda tree: pb.show(tree)._repr_html_(),
    lambda tree: pb.calibration.compare_calibrations({"this": tree, "that": CALIBRATION}),
)
OF_STUDIES = (pb.summary, pb.benchmark.accuracy_sentences, lambda tree: pb.show(tree)._repr_html_())


def check_mutations(trees, functions, random, count):
    """Count how many of the damaged trees are refused when they enter."""
    refused = 0
    for _ in range(count):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what NumPy and xarray say of the mutation itself
            damaged = mutate_tree(pick(random, trees), random)
        found = [outcome(function, damaged) for function in functions]
        refused += found[0] is None
    return refused


DAMAGED = [
    *((RESULTS, OF_FITS, [11, seed], 50, range(7, 27)) for seed in range(3)),
    *(([CALIBRATION], OF_CALIBRATIONS, [12, seed], 40, range(16, 35)) for seed in range(2)),
    ([make_accuracy()], OF_STUDIES, [13], 120, range(39, 72)),
]
"""Trees, what is done with them, a seed, how many are damaged, and how many are refused."""


@each(
    ("trees", "functions", "seed", "count", "refused"),
    DAMAGED,
    ids=[str(seed) for _, _, seed, *_ in DAMAGED],
    quick=1,
)
def test_a_damaged_result_is_refused_in_one_line_or_works(trees, functions, seed, count, refused):
    assert check_mutations(trees, functions, np.random.default_rng(seed), count) in refused


# Matplotlib says that an axis from 1e-300 to 1e300 overflows; the figure is drawn all the same.
@pytest.mark.filterwarnings("ignore:overflow encountered:RuntimeWarning:matplotlib")
@pytest.mark.thorough
@each("seed", range(8))
def test_many_damaged_results_are_refused_in_one_line_or_work(tmp_path, seed):
    random = np.random.default_rng([14, seed])
    page = lambda tree: pb.report(tree, tmp_path / "report")  # noqa: E731
    figures = (
        pb.plots.plot_pairs,
        pb.plots.plot_ranks,
        pb.plots.plot_prior_posterior,
        pb.plots.plot_pit,
        lambda tree: pb.plots.plot_readings(tree, "dop"),
        lambda tree: pb.plots.plot_residuals(tree, "dop"),
        lambda tree: pb.plots.plot_shrinkage(tree, "roughness"),
        lambda tree: pb.plots.plot_spectrum(tree, "absorption"),
        lambda tree: pb.inference.predict_spectrum(tree, [500.0]),
    )
    check_mutations(RESULTS, (*OF_FITS, page, *figures), random, 100)
    pages = (*OF_CALIBRATIONS, pb.plots.plot_calibration, page)
    check_mutations([CALIBRATION], pages, random, 30)
    check_mutations([make_accuracy()], (*OF_STUDIES, pb.plots.plot_accuracy, page), random, 30)


# --- provenance -------------------------------------------------------------------------------


@pytest.mark.thorough
@each("odd", ODD_ATTRIBUTES, ids=lambda odd: str(odd)[:9])
def test_provenance_that_is_no_mapping_is_refused(odd):
    tree = RESULTS[1].copy()
    tree.attrs["polar_bayes"] = odd
    with pytest.raises(pb.FitError, match="attribute polar_bayes: it is no mapping in JSON; give"):
        pb.summary(tree)


@each(
    ("change", "what"),
    [
        ({"counts": {"views": "9"}}, "polar_bayes.counts.views: it is '9', not a count"),
        ({"counts": [1]}, r"polar_bayes.counts: it is \[1\], not a mapping"),
        ({"problems": "none"}, "polar_bayes.problems: it is 'none', not a list"),
        ({"problems": [3]}, r"polar_bayes.problems\[0\]: it is 3, not text"),
        ({"modes": {"weights": [1.0, "x"]}}, r"modes.weights\[1\]: it is 'x', not a finite number"),
        ({"bounds": {"roughness": [0.0]}}, r"bounds.roughness: it is \[0.0\], not a least"),
        ({"auto": {**AUTO, "steps": [{}]}}, r"auto.steps\[0\].name: it is missing"),
        ({"alternatives": ["x"]}, r"alternatives\[0\]: it is 'x', not a mapping"),
        (
            {"alternatives": [{**OTHER, "shift": "x"}]},
            r"alternatives\[0\].shift: it is 'x', not a mapping",
        ),
        (
            {"prior_probability": {"roughness": ["x"]}},
            r"prior_probability.roughness\[0\]: it is 'x', not a number",
        ),
        ({"tails": {**TAILS, "ess": 0}}, "tails.ess: it is 0, not a number a"),
        (
            {"tails": {**TAILS, "shares": {"a": [[0.1]]}}},
            r"tails.shares.a\[0\]: .*, not a share below",
        ),
        ({"method": 3}, "polar_bayes.method: it is 3, not text"),
        ({"largest_view_zenith": math.inf}, "largest_view_zenith: it is inf, not a finite"),
    ],
)
def test_provenance_of_the_wrong_type_is_refused(change, what):
    tree = edit_provenance(RESULTS[1].copy(), **change)
    with pytest.raises(pb.FitError, match=f"result: {what}|result: polar_bayes.{what}"):
        pb.diagnostics.json_summary(tree)


@pytest.mark.thorough
def test_provenance_may_lack_anything():
    tree = RESULTS[0].copy()
    tree.attrs = {}
    assert pb.summary(tree).equals(pb.summary(RESULTS[0]))
    assert pb.inference.auto_sentences(tree) == []
    for name in json.loads(MANY.attrs["polar_bayes"]):
        pb.diagnostics.json_summary(edit_provenance(MANY.copy(), **{name: None}))


# --- groups and variables ---------------------------------------------------------------------


def _edited(change, group="posterior"):
    tree = RESULTS[0].copy()
    tree[group] = xr.DataTree(change(tree[group].to_dataset()))
    return tree


REFUSED = {
    "text": (lambda x: x.assign(roughness=x["roughness"].astype(str)), "roughness: it holds <U"),
    "complex": (lambda x: x * (1.0 + 0j), "posterior/roughness: it holds complex128, not real"),
    "no chain": (lambda x: x.isel(chain=0), r"roughness: its dims are \(draw.*, not \(chain, draw"),
    "no draws": (lambda x: x.isel(draw=slice(0)), "posterior: it is empty"),
    "a number too large": (
        lambda x: x + 1e200,
        r"it holds a number above 1e\+150, whose square ov",
    ),
    "a wide float": (
        lambda x: x.astype(np.longdouble),
        r"it holds \w+, not real numbers of 64 bits",
    ),
    "no variable": (lambda x: x[[]], "posterior: it is empty"),
    "fewer draws": (
        lambda x: x.isel(draw=slice(9)),
        "its draw has 30 entries, that of posterior 9",
    ),
    "one color": (lambda x: x.isel(wavelength=[0]), "its wavelength has 2 entries, that of post"),
    "other colors": (
        lambda x: x.assign_coords(wavelength=[1.0, 2.0]),
        "prior/wavelength: its labels are not those of posterior",
    ),
    "colors in words": (
        lambda x: x.assign_coords(wavelength=["red", "blue"]),
        "its labels are not those of posterior",
    ),
}


@each(("change", "what"), REFUSED.values(), ids=REFUSED)
def test_a_posterior_that_does_not_hold_together_is_refused(change, what):
    with pytest.raises(pb.FitError, match=f"result: .*{what}"):
        pb.verdict(_edited(change))


@pytest.mark.thorough
@each("dim", ["row", "parameter"])
def test_a_study_of_nothing_is_refused(dim):
    study = make_accuracy()
    study["accuracy"] = xr.DataTree(study["accuracy"].to_dataset().isel({dim: slice(0)}))
    with pytest.raises(pb.FitError, match="accuracy: it is empty"):
        pb.benchmark.accuracy_sentences(study)


@pytest.mark.filterwarnings("ignore:Duplicate dimension names:UserWarning")
@each("number", [484, 1948, 3742])
def test_a_group_that_xarray_cannot_read_is_refused(number):
    """Cases of `benchmarks/fuzz.py`: edits that xarray allows, and whose group it then refuses."""
    whole = make_result(views=12, chains=2, draws=60)
    tree = mutate_tree(whole, np.random.default_rng([0, 5, number]))
    with pytest.raises(pb.FitError, match="its variables do not fit together"):
        pb.summary(tree)


@pytest.mark.thorough
def test_readings_and_predictions_belong_together():
    tree = _edited(lambda x: x.isel(view=slice(2)), "observed_data")
    with pytest.raises(pb.FitError, match="its view has 4 entries, that of observed_data 2"):
        pb.summary(tree)
    tree = _edited(lambda x: x.rename(view="angle"), "noise_free")
    with pytest.raises(pb.FitError, match=r"noise_free/dop: its dims are .*angle\), not .*view"):
        pb.diagnostics.stack_readings(tree)


@pytest.mark.thorough
def test_other_kinds_of_tree_are_named(tmp_path):
    for function in (
        convergence.summary,
        pb.diagnostics.stack_readings,
        pb.inference.auto_sentences,
        pb.diagnostics.population_summary,
    ):
        for wrong in (CALIBRATION, xr.Dataset(), None, "fit.nc"):
            with pytest.raises(
                pb.FitError, match=r"it holds no (fit|readings); give the tree that"
            ):
                function(wrong)
    odd = MANY.copy()
    odd.attrs["what"] = {"a": 1}
    for call, said in (
        (lambda: check_calibration(MANY), "calibration: it holds no calibration; give the tree"),
        (lambda: pb.save("fit", tmp_path / "fit.nc"), "a str is no result"),
        (lambda: pb.save(odd, tmp_path / "fit.nc"), r"netCDF cannot hold it \(.*\); store numbers"),
        (
            lambda: pb.diagnostics.compare_fits({"a": MANY, "b": CALIBRATION}),
            "compare_fits: b: it holds no fit",
        ),
    ):
        with pytest.raises(pb.FitError, match=said):
            call()


def test_a_tree_that_arviz_made_is_summed_up():
    random = np.random.default_rng(5)
    draws = {"mu": random.normal(size=(4, 500)), "tau": random.normal(size=(4, 500, 3))}
    tree = az.from_dict(
        {
            "posterior": draws,
            "sample_stats": {"diverging": np.zeros((4, 500), bool), "lp": draws["mu"]},
            "log_likelihood": {"y": random.normal(size=(4, 500, 8))},
            "observed_data": {"y": random.normal(size=8)},
            "constant_data": {"x": np.array(["a", "b"])},
        }
    )
    assert list(pb.summary(tree).index) == ["mu", "tau[0]", "tau[1]", "tau[2]"]
    assert pb.verdict(tree).passed
    with pytest.raises(pb.FitError, match="no readings of dop to draw, for it has no observed_dat"):
        pb.plots.plot_readings(tree, "dop")


@pytest.mark.thorough
@each("group", sorted(set(RESULTS[1].children) - {"posterior"}))
def test_any_group_but_the_posterior_may_be_missing(group):
    tree = RESULTS[1].copy()
    del tree[group]
    for function in OF_FITS[:5]:
        function(tree)
    if group in ("observed_data", "noise_free", "posterior_predictive", "constant_data"):
        with pytest.raises(pb.FitError, match=f"no readings of dop to draw, for it has no {group}"):
            pb.plots.plot_readings(tree, "dop")


@pytest.mark.thorough
def test_a_report_leaves_out_what_a_result_lacks(tmp_path):
    tree = RESULTS[2].copy()
    for group in ("noise_free", "constant_data", "prior"):
        del tree[group]
    page = pb.report(tree, tmp_path / "report").read_text()
    assert "Readings of" not in page
    assert "roughness" in page


@pytest.mark.thorough
def test_comparisons_have_the_labels_of_the_fit():
    program = SimpleNamespace(
        auxiliary=(),
        dims={"absorption": ("wavelength",)},
        events={"absorption": ()},
        plates={"wavelength": 2},
        observed=(),
    )
    views = {name: ("view", np.zeros(3)) for name in ANGLES}
    capture = xr.Dataset(views, {"wavelength": [450.0, 650.0]})
    data = SimpleNamespace(
        dims=(("view", 3), ("wavelength", 2)),
        valid=np.ones((3, 2), bool),
        saturated=np.zeros((3, 2), bool),
        intensity_unit=1.0,
        measured=slice(None),
    )
    parameters = {"absorption": np.zeros((1, 5, 2))}
    names = ("predictive", "center", "log_likelihood", "log_prior")
    draws = SimpleNamespace(parameters=parameters, **{name: {} for name in names})
    comparison = posterior_of(program, parameters)
    tree = assemble(
        program, capture, data, draws, draws, {}, {"without_instrument": comparison}, {"seed": 0}
    )
    assert tree["without_instrument"]["wavelength"].values.tolist() == [450.0, 650.0]
    assert list(compare_without(tree, "instrument").index) == ["absorption[450]", "absorption[650]"]


# --- checksums --------------------------------------------------------------------------------


def test_a_file_of_an_earlier_version_has_the_present_names(tmp_path):
    tails = {"k_hat": 0.4, "effective_draws": 900.0, "shares": {}}
    stated = {"k_hat": 0.3, "tails": tails, "method_parts": "Nuts(effective_draws=900.0)"}
    fit, calibration, study = make_result(), make_calibration(), make_accuracy()
    fit.attrs["polar_bayes"] = json.dumps(json.loads(fit.attrs["polar_bayes"]) | stated)
    calibration["fits"] = calibration["fits"].to_dataset().rename(method="approach")
    table = study["accuracy"].to_dataset().rename(ess="effective_draws", pareto_k="k_hat")
    table.attrs["reference_effective_draws"] = table.attrs.pop("reference_ess")
    study["accuracy"].dataset = table
    for name, old in {"fit": fit, "calibration": calibration, "study": study}.items():
        pb.save(old, tmp_path / f"{name}.nc")
    maps = make_maps({"roughness": np.full((2, 3), 0.2)}).rename(method="approach")
    maps.to_zarr(tmp_path / "map.zarr", consolidated=False)

    read = json.loads(pb.load(tmp_path / "fit.nc", "fit").attrs["polar_bayes"])
    assert read["pareto_k"] == 0.3
    assert read["method_parts"] == "Nuts(ess=900.0)"
    assert read["tails"] == {"pareto_k": 0.4, "ess": 900.0, "shares": {}}
    assert "method" in pb.load(tmp_path / "calibration.nc")["fits"]
    assert "method" in pb.load(tmp_path / "map.zarr")
    again = pb.load(tmp_path / "study.nc")["accuracy"]
    assert {"ess", "pareto_k"} <= set(again)
    assert "reference_ess" in again.attrs


def test_a_file_gives_back_what_was_saved(tmp_path):
    for number, tree in enumerate((*RESULTS, CALIBRATION, make_accuracy())):
        path = tmp_path / f"{number}.nc"
        pb.save(tree, path)
        with xr.open_datatree(path, engine="netcdf4", decode_times=False) as opened:
            assert set(opened.attrs) == {"polar_bayes"}
            xr.testing.assert_identical(pb.load(path), opened.load())
            assert set(opened.children) == set(tree.children)


@each("part", ["posterior/roughness", "posterior/wavelength", "provenance"])
def test_a_flipped_bit_is_an_error_and_no_value(tmp_path, part):
    tree = edit_provenance(RESULTS[0].copy(), model_source="x" * 80_000 + "rainy" + "x" * 80_000)
    pb.save(tree, tmp_path / "fit.nc")
    pb.load(tmp_path / "fit.nc")
    content = bytearray((tmp_path / "fit.nc").read_bytes())
    found = b"rainy" if part == "provenance" else tree[part].values.tobytes()
    content[content.index(found) + 2] ^= 1
    (tmp_path / "damaged.nc").write_bytes(content)
    with pytest.raises(pb.FitError, match=r"damaged\.nc: its checksum is wrong"):
        pb.load(tmp_path / "damaged.nc")


def test_a_result_is_no_capture(tmp_path):
    pb.save(RESULTS[1], tmp_path / "fit.nc")
    with pytest.raises(pb.CaptureError, match=r"fit\.nc: view_zenith: it is missing"):
        pb.load_capture(tmp_path / "fit.nc")


# --- what no fit gives ------------------------------------------------------------------------


def _with_draws(method, name, values, **provenance):
    tree = edit_provenance(make_result(method=method, wavelengths=()), **provenance)
    draws = tree["posterior"][name].to_numpy() * 0.0
    return replace(tree, "posterior", name, draws + values)


@pytest.mark.thorough
@each("method", ["nuts", "laplace", "importance"])
def test_draws_that_are_all_equal_are_a_problem(method):
    kind = "nuts" if method == "nuts" else "laplace"
    judged = pb.verdict(edit_provenance(_with_draws(kind, "roughness", 0.2), method=method))
    assert not judged.passed
    assert any("All draws are equal: roughness; nothing is known" in p for p in judged.problems)


@each("method", ["nuts", "laplace", "point"])
@each(
    ("name", "value", "provenance", "words"),
    [
        ("refractive_index", -1.0, {}, r"refractive_index \[1, inf\] 100% of its draws"),
        ("subsurface_fraction", 1.1, {}, r"subsurface_fraction \[0, 1\] 100%"),
        ("roughness", 0.5, {"bounds": {"roughness": [None, 0.4]}}, r"roughness \[0, 0.4\] 100%"),
        ("exposure", -0.1, {"bounds": {"exposure": [-9.0, None]}}, r"exposure \[0, inf\] 100%"),
    ],
)
def test_draws_that_their_prior_rules_out_are_a_problem(method, name, value, provenance, words):
    judged = pb.verdict(_with_draws(method, name, value, **provenance))
    assert not judged.passed
    problem = next(p for p in judged.problems if p.startswith("Outside its range"))
    assert re.search(words, problem)


@pytest.mark.thorough
def test_one_draw_beyond_the_end_is_a_problem_and_rounding_is_none():
    tree = make_result(wavelengths=())
    draws = tree["posterior"]["roughness"].to_numpy().copy()
    bounds = {"roughness": [float(draws.min()), float(draws.max())]}
    assert pb.verdict(edit_provenance(tree, bounds=bounds)).passed
    single = replace(tree, "posterior", "roughness", draws.astype("float32"))
    assert pb.verdict(single).passed
    draws[0, 0] = draws.max() + 1e-4
    assert not pb.verdict(replace(tree, "posterior", "roughness", draws)).passed


@pytest.mark.thorough
def test_a_name_that_the_users_own_model_declares_means_what_it_wants():
    tree = make_result(wavelengths=())
    tree = replace(tree, "posterior", "roughness", tree["posterior"]["roughness"].to_numpy() - 0.4)
    assert not pb.verdict(tree).passed
    assert pb.verdict(edit_provenance(tree, declared={"roughness": "Normal"})).passed
