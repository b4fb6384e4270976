"""Shrinkage plots, and what the page says about populations and about what was swapped."""

import numpy as np
import pytest
import xarray as xr
from cases import each
from clipping import clipped
from synthetic_results import make_result, pool

from polar_bayes.diagnostics.population import shrinkage
from polar_bayes.diagnostics.view import view_of
from polar_bayes.errors import FitError
from polar_bayes.reporting import fit_page
from polar_bayes.reporting import text as sentences
from polar_bayes.reporting.plots_fit import MAX_MEMBERS, plot_shrinkage
from polar_bayes.reporting.report import render
from polar_bayes.reporting.text import swapped_sentence

pytestmark = pytest.mark.usefixtures("unpainted")


def pooled(count, *parameters, names=None, **settings):
    materials = names or tuple(f"leaf {i}" for i in range(count))
    chosen = {"wavelengths": (), "views": 8, "draws": 60, "variables": ("dop",), **settings}
    return pool(make_result(materials=materials, **chosen), *(parameters or ("refractive_index",)))


@pytest.mark.thorough
@each("count", [2, 12, 35, 75])
def test_members_of_every_number_are_drawn(count: int) -> None:
    figure = plot_shrinkage(pooled(count, views=4), "refractive_index")
    assert clipped(figure) == []
    (axes,) = figure.axes
    assert len(axes.get_yticks()) == min(count, MAX_MEMBERS)
    label = axes.get_xlabel()
    assert label.startswith("refractive index")
    assert ("60 of 75, evenly" in label) == (count > MAX_MEMBERS)
    said = [text.get_text() for text in figure.legends[0].get_texts()]
    assert "pooled: mean and 95%" in said
    assert "true value" in said


def test_members_stand_in_order_of_their_estimates() -> None:
    result = pooled(5)
    means = shrinkage(result)["mean"].to_numpy()
    names = [f"leaf {i}" for i in np.argsort(means)]
    axes = plot_shrinkage(result, "refractive_index").axes[0]
    assert [text.get_text() for text in axes.get_yticklabels()] == names


@pytest.mark.thorough
def test_a_member_that_says_nothing_alone_is_drawn_as_such() -> None:
    result = pooled(4)
    posterior = result["posterior"].to_dataset()
    rng = np.random.default_rng(3)
    location, spread = (posterior[f"refractive_index_{part}"] for part in ("location", "spread"))
    drawn = location + spread * rng.standard_normal(location.shape)
    posterior["refractive_index"][{"material": 2}] = drawn.to_numpy()
    result["posterior"] = xr.DataTree(posterior)
    assert np.isnan(shrinkage(result)["unpooled"].iloc[2])
    figure = plot_shrinkage(result, "refractive_index")
    said = [text.get_text() for text in figure.legends[0].get_texts()]
    assert "alone it says nothing" in said


@pytest.mark.thorough
def test_a_wide_population_of_a_positive_parameter_has_a_log_axis() -> None:
    result = pooled(6, "roughness")
    posterior = result["posterior"].to_dataset()
    width = np.exp(np.linspace(-3.0, 3.0, 6))
    posterior["roughness"] = np.abs(posterior["roughness"]) * xr.DataArray(width, dims="material")
    posterior["roughness_spread"] = 2.0 + 0.0 * posterior["roughness_spread"]
    result["posterior"] = xr.DataTree(posterior)
    figure = plot_shrinkage(result, "roughness")
    assert figure.axes[0].get_xscale() == "log"
    assert clipped(figure) == []


def test_what_is_not_pooled_cannot_be_drawn() -> None:
    with pytest.raises(FitError, match="choose one of refractive_index"):
        plot_shrinkage(pooled(3), "roughness")
    with pytest.raises(FitError, match="choose one of none"):
        plot_shrinkage(make_result(wavelengths=(), views=4, draws=20), "roughness")


# --- the page -------------------------------------------------------------------------------------


@pytest.mark.thorough
def test_draws_that_are_not_finite_leave_a_page() -> None:
    result = pooled(3)
    posterior = result["posterior"].to_dataset()
    posterior["refractive_index"][{"material": 1, "draw": 3}] = np.nan
    result["posterior"] = xr.DataTree(posterior)
    text = render(result)
    assert 'id="population-table"' in text
    assert "Shrinkage of" not in text


@pytest.mark.thorough
def test_sentences_of_many_colors_name_the_first_and_the_last() -> None:
    result = pooled(3, wavelengths=(450.0, 550.0, 650.0))
    fit = view_of(result)
    (said,) = sentences.between_members(fit)
    assert "a new material would lie between" in said
    assert "at 450 nm and between" in said
    assert said.endswith("at 650 nm (95%).")
    assert "550" not in said
    decided = " ".join(sentences.pooling(fit))
    assert decided.count("refractive index, ") == 3


@pytest.mark.thorough
def test_tables_have_a_cell_for_every_head() -> None:
    fit = view_of(pooled(3, "roughness", "refractive_index"))
    for table in (fit_page.population_table(fit), fit_page.member_table(fit)):
        assert {len(row.cells) + 1 for row in table.rows} == {len(table.columns)}


# --- what was swapped -----------------------------------------------------------------------------


def test_what_was_swapped_is_a_sentence() -> None:
    """Beside those of approved pages."""
    assert swapped_sentence({}) == ""
    assert swapped_sentence({"swapped": []}) == (
        "No part of the model was replaced: scene, links and priors are the package's defaults."
    )
    links = ["links", *(f"prior of p{i}" for i in range(8))]
    assert swapped_sentence({"swapped": links}) == (
        "Replaced by the user: the links and the priors of p0, p1, p2, p3, p4, p5 and 2 more."
    )
