"""Shifts and widths against closed forms, and against climbs with exact gradients."""

import jax
import linear
import numpy as np
import pytest
import xarray as xr
from plates import LINKS, plate_capture

import polar_bayes as pb
from polar_bayes.diagnostics.parameters import label_coordinates
from polar_bayes.inference.program import compile_program
from polar_bayes.inference.request import resolve
from polar_bayes.numerics.optimize import find_mode
from polar_bayes.observation.data import observe
from polar_bayes.scenes.posterior_change import Baseline, compile_density, fit_laplace


def request_of(capture, scene, links=LINKS, model="per_material"):
    return resolve(capture, model, scene, None, links, None, 0, "double")


def no_progress(stage: str, fraction: float) -> None:
    pass


def density_of(capture, scene, **options):
    request = request_of(capture, scene, **options)
    return compile_density(request, observe(request.capture))


@pytest.fixture(scope="module")
def line() -> xr.Dataset:
    return plate_capture(np.linspace(20.0, 75.0, 15), 0.1, seed=4)


def test_in_a_linear_model_shift_and_width_are_exact(line: xr.Dataset) -> None:
    options = {"links": linear.LINKS, "model": linear.model}
    full = density_of(line, linear.SCENE, **options)
    peak = fit_laplace(full, jax.random.key(0), no_progress)
    mean, covariance = linear.posterior(line["q"].to_numpy(), full.labels)
    sd = np.sqrt(np.diagonal(covariance))
    np.testing.assert_allclose(peak.z, mean, atol=1e-5)
    np.testing.assert_allclose(peak.covariance, covariance, rtol=1e-4, atol=1e-7)

    fewer = density_of(line, linear.SCENE.without(pb.instrument.AngleZero), **options)
    noise = full.noise_sd(peak.z)
    np.testing.assert_allclose(noise["q"], linear.NOISE)
    change = Baseline(peak, noise, None).compare(fewer)
    less, narrower = linear.posterior(line["q"].to_numpy(), fewer.labels)
    here = [full.labels.index(label) for label in fewer.labels]
    np.testing.assert_allclose(change.shift[here], (less - mean[here]) / sd[here], atol=1e-4)
    ratio = np.sqrt(np.diagonal(narrower)) / sd[here]
    np.testing.assert_allclose(change.sd_ratio[here], ratio, rtol=1e-4)
    assert ratio.min() < 0.999  # what is left out no longer widens the rest
    assert np.isnan(change.shift[full.labels.index("angle_zero")])

    column = linear.columns(np.linspace(0.0, 1.0, 15))["angle_zero"]
    moves = mean[full.labels.index("angle_zero")] * column / linear.NOISE
    np.testing.assert_allclose(change.largest_move, np.abs(moves).max(), rtol=1e-3)
    np.testing.assert_allclose(change.rms_move, np.sqrt(np.mean(moves**2)), rtol=1e-3)


@pytest.mark.thorough
def test_on_a_plate_they_are_those_of_climbs_with_exact_gradients(
    plate: xr.Dataset, full: pb.Scene
) -> None:
    scenes = (full, full.without(pb.instrument.Leakage))
    densities = [density_of(plate, scene) for scene in scenes]
    peak = fit_laplace(densities[0], jax.random.key(1), no_progress)
    change = Baseline(peak, densities[0].noise_sd(peak.z), None).compare(densities[1])
    ends = []
    for density, start in zip(densities, (peak.z, change.fit.z), strict=True):
        exact = jax.jit(jax.value_and_grad(density.program.potential))

        def potential(z, exact=exact, data=density.data):
            value, gradient = exact(z, data)
            return float(value), np.asarray(gradient)

        assert density.potential(start) == pytest.approx(potential(start)[0], rel=1e-12)
        ends.append(find_mode(potential, start + 0.01))
    theirs = [densities[0].labels.index(label) for label in densities[1].labels]
    sd = np.sqrt(np.diagonal(ends[0].covariance))[theirs]
    shift = (ends[1].z - ends[0].z[theirs]) / sd
    np.testing.assert_allclose(change.shift[theirs], shift, atol=0.02)
    ratio = np.sqrt(np.diagonal(ends[1].covariance)) / sd
    np.testing.assert_allclose(change.sd_ratio[theirs], ratio, rtol=0.01)
    assert np.abs(shift).max() > 0.1


@pytest.mark.thorough
def test_labels_are_those_of_the_tables_of_a_fit() -> None:
    capture = pb.simulate(
        "glass", scene="goniometer", protocol=pb.simulation.Protocol(wavelengths=(450.0, 550.0))
    )
    scene = pb.Scene(
        pb.SmoothSurface(),
        pb.Unpolarized(),
        pb.StokesMixing(),
        instrument=pb.instrument.Instrument((pb.instrument.Discrepancy(basis=4),)),
    )
    request = request_of(capture, scene)
    data = observe(request.capture)
    program = compile_program(request.bind(), data)
    coordinates = label_coordinates(program, request.capture)
    labels, sites = zip(*((each.label, each.site) for each in coordinates), strict=True)
    assert set(labels) == {
        "discrepancy_amplitude",
        *(f"discrepancy_weights[{number}]" for number in range(4)),
        "refractive_index[450]",
        "refractive_index[550]",
        "stokes_error_factor",
        "subsurface_fraction",
    }
    assert [label.partition("[")[0] for label in labels] == list(sites)


@pytest.mark.thorough
def test_noise_is_known_of_links_without_a_variance_too() -> None:
    """Log odds have no stated variance; to first order it is that of the odds' slope."""
    capture = pb.simulate("leaf", protocol=pb.simulation.Protocol(views=8, wavelengths=()), seed=1)
    density = density_of(capture, pb.Scene(pb.SmoothSurface()), links=pb.links.LogitNormalLink())
    z = np.zeros(density.program.size)
    z[density.labels.index("logit_scale")] = -2.0
    sd, center = density.noise_sd(z), density.noise_free(z)["dop"]
    expected = float(np.exp(-2.0)) * center * (1.0 - center)
    np.testing.assert_allclose(sd["dop"], expected, rtol=0.15)
    assert np.isfinite(sd["intensity"]).all()
