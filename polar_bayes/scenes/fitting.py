"""The verb `fit`: one capture by one scene, or by the scenes that a comparison selects."""

import time
from collections.abc import Callable, Mapping

import jax
import xarray as xr
from numpyro import distributions as dist

import polar_bayes.scenes  # its names load the comparison, and with it diagnostics, on first use
from polar_bayes.capture.schema import validate
from polar_bayes.inference.request import resolve
from polar_bayes.methods.method import AbstractMethod
from polar_bayes.methods.registry import FIT_DEFAULT
from polar_bayes.observation.links import AbstractLink
from polar_bayes.physics.scene import Scene
from polar_bayes.progress import Progress, no_progress, with_progress
from polar_bayes.scenes.fit_request import Keep, choose_method, fit_request


@with_progress
def fit(
    capture: xr.Dataset,
    *,
    model: str | Callable = "per_material",
    method: str | AbstractMethod = FIT_DEFAULT,
    tolerance: float | None = None,
    seconds: float | None = None,
    scene: str | Scene | None = None,
    priors: Mapping[str, dist.Distribution] | None = None,
    links: AbstractLink | Mapping[str, AbstractLink] | None = None,
    known: Mapping[str, float] | None = None,
    largest_view_zenith: float | None = None,
    seed: int = 0,
    precision: str = "double",
    progress: Progress | None = None,
    keep: Keep | None = None,
) -> xr.DataTree:
    """Fit one capture.

    Args:
        capture: A Dataset of the capture schema; validated here.
        model: A name in `polar_bayes.inference.request.MODELS` or a callable
            `model(data, scene, priors, links)`.
        method: "auto" (weighted draws where they reach all of the posterior, else NUTS), "nuts",
            "laplace", "point", "importance" (weighted draws of mixtures at all modes), or settings
            such as `Nuts(draws=2000)`. A name is the same algorithm in maps and calibrations.
        tolerance: Of "auto": largest error of a posterior mean or standard deviation, in posterior
            standard deviations, above 0 and at most 1; by default, 400 effective draws or more.
        seconds: Of "auto": wall time of the whole fit, by default without limit. Only the first
            method always ends; what is not done by then is abandoned, and the best answer so far is
            returned. Also of scene="auto", with any method: of the comparison of scenes.
        scene: A name in `SETUPS` or a `Scene`; by default the set-up that the capture names in
            its attribute `setup`, else "polarimeter". "auto" compares scenes, as
            `polar_bayes.compare_scenes` does, and stacks the posteriors of those that remain.
            With the default method, weighted draws of the comparison that pass the rules of
            convergence serve as they are; the other scenes are sampled.
        priors: Distributions that replace or extend `polar_bayes.priors.PRIORS`.
        links: One link for the polarization, or a mapping from variable to link.
        known: Standard uncertainties of what the set-up is known to, above 0, by input quantity,
            such as `{"light_zenith": 0.2}` (degree); they replace those of the set-up and of
            `priors`. A capture may state the same in its attributes, such as
            `light_zenith_uncertainty`, but what is given here counts more.
        largest_view_zenith: Views beyond it are set aside and counted. Unit degree.
        seed: The same seed gives the same result on the same machine, unless "auto" ran out of
            time.
        precision: "double" or "single".
        progress: Called with the name of a stage and the fraction of it that is done.
        keep: Called with the fit before it is compared with other scenes. An interrupt
            (`KeyboardInterrupt`) of the comparison ends it, and the fit is returned without.

    Returns:
        A DataTree with the groups posterior, sample_stats, log_likelihood, log_prior,
        posterior_predictive, noise_free, prior, prior_predictive, observed_data and
        constant_data, effects for a scene of `polar_bayes.choose_effects`, and scenes for "auto"
        (`polar_bayes.scenes.scene_sentences` says what was chosen and why);
        `polar_bayes.verdict` says whether it converged, and
        `polar_bayes.inference.auto_sentences` what "auto" did and why.

    Raises:
        CaptureError: The capture does not hold what a fit needs.
        SceneError: No such scene.
        FitError: A model, method, prior or link cannot be used, or the memory is too small.
    """
    start_time = time.perf_counter()
    is_search, show = isinstance(scene, str) and scene == "auto", progress or no_progress
    of_method = None if is_search and method != "auto" else seconds
    chosen = choose_method(method, tolerance, of_method)
    if is_search:
        arguments = polar_bayes.scenes.stacking.FitArguments(
            validate(capture), model, priors, links, largest_view_zenith, seed, precision,
            known=known, seconds=seconds,
        )  # fmt: skip
        return polar_bayes.scenes.stacking.fit_best_scenes(arguments, chosen, show, keep)
    limit = largest_view_zenith
    request = resolve(capture, model, scene, priors, links, limit, seed, precision, known=known)
    with jax.enable_x64(precision == "double"):
        return fit_request(request, chosen, show, start_time, keep=keep)
