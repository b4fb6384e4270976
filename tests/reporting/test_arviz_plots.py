"""A result is a plain tree: ArviZ draws of the answer of every method what it draws of any tree."""

import arviz_plots
import arviz_stats
import jax
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
import xarray as xr
from cases import each
from plates import LINKS, PLATE
from synthetic_results import make_result
from toy_models import capture, line

import polar_bayes as pb
from polar_bayes.errors import FitError
from polar_bayes.scenes import fit_request as fitting

pytestmark = pytest.mark.usefixtures("without_comparisons")

METHODS = {
    "nuts": pb.methods.Nuts(chains=2, warmup=100, draws=100, most_draws=100, block=50),
    "laplace": pb.methods.Laplace(chains=2, draws=100),
    "importance": pb.methods.Importance(),
    "point": pb.methods.Point(starts=2),
}
FIRST = ("plot_forest", "plot_ppc_pit", "plot_loo_pit", "plot_psense_dist", "plot_rank")
"""One of each group that a plot reads."""

OF_DRAWS = (
    "plot_dist", "plot_pair", "plot_ppc_dist", "plot_ppc_interval", "plot_prior_posterior",
    "plot_trace", "plot_trace_dist", "plot_autocorr", "plot_ess", *FIRST,
)  # fmt: skip
OF_AN_ESTIMATE = ("plot_dist", "plot_forest", "plot_pair", "plot_ppc_interval", "plot_trace_dist")


@pytest.fixture(autouse=True)
def figures_go() -> None:
    with matplotlib.rc_context({"backend": "agg"}):
        yield
        plt.close("all")


@pytest.fixture(scope="module")
def fitted() -> dict[str, xr.DataTree]:
    return {}


def result_of(name: str, fitted: dict[str, xr.DataTree]) -> xr.DataTree:
    """One fit for each method, as small as it goes."""
    if name not in fitted:
        asked = {"model": line, "scene": PLATE, "links": LINKS, "seed": 7}
        jax.config.update("jax_disable_most_optimizations", True)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(fitting, "PRIOR_DRAWS", 100)
            patch.setattr("polar_bayes.inference.program.BLOCK", 100)
            fitted[name] = pb.fit(capture(), method=METHODS[name], **asked)
        jax.config.update("jax_disable_most_optimizations", False)
    return fitted[name]


def draw(plot: str, result: xr.DataTree) -> arviz_plots.PlotCollection:
    plt.close("all")
    return getattr(arviz_plots, plot)(result)


@each("plot", FIRST, quick=2)
def test_arviz_draws_what_chains_found(plot: str, fitted) -> None:
    drawn = draw(plot, result_of("nuts", fitted))
    assert drawn.viz["figure"].item().get_axes()


@pytest.mark.thorough
@each("name", ["nuts", "laplace", "importance"])
@each("plot", OF_DRAWS)
def test_arviz_draws_the_draws_of_every_method(name: str, plot: str, fitted) -> None:
    drawn = draw(plot, result_of(name, fitted))
    assert drawn.viz["figure"].item().get_axes()


@pytest.mark.thorough
@each("plot", OF_AN_ESTIMATE)
def test_arviz_draws_an_estimate(plot: str, fitted) -> None:
    assert draw(plot, result_of("point", fitted))


def test_arviz_sums_it_up(fitted) -> None:
    table = arviz_stats.summary(result_of("nuts", fitted), round_to="none")
    assert set(table.index) == {"level", "slope"}


# --- readings in one row --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def masked() -> xr.DataTree:
    return make_result(views=14, materials=("leaf", "fruit"), masked=(2, 5), limit=80.0)


@pytest.mark.thorough
@each("plot", ["plot_ppc_pit", "plot_loo_pit", "plot_ppc_dist"])
@each("name", ["dop", "intensity"])
def test_masked_readings_are_set_aside_for_arviz(masked, plot: str, name: str) -> None:
    stacked = pb.diagnostics.stack_readings(masked)
    assert getattr(arviz_plots, plot)(stacked, var_names=name)


def test_stacking_keeps_what_was_fitted_and_nothing_else(masked) -> None:
    stacked = pb.diagnostics.stack_readings(masked)
    kept = masked["constant_data"]["valid"].to_numpy() == 1
    observed = masked["observed_data"]["dop"].to_numpy()[kept]
    assert stacked["observed_data"]["dop"].dims == ("dop_reading",)
    np.testing.assert_array_equal(stacked["observed_data"]["dop"], observed)
    draws = masked["log_likelihood"]["dop"].to_numpy()[..., kept]
    np.testing.assert_array_equal(stacked["log_likelihood"]["dop"], draws)
    assert stacked["posterior"].identical(masked["posterior"])
    assert stacked.attrs == masked.attrs
    assert masked["observed_data"]["dop"].dims == ("material", "wavelength", "view")


def test_what_holds_no_readings_is_refused() -> None:
    with pytest.raises(FitError, match="it holds no readings"):
        pb.diagnostics.stack_readings(xr.DataTree())
