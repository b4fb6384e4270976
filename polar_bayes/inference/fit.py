"""The public verb of one capture: every method by its name, those that choose others too."""

from collections.abc import Callable, Mapping

import xarray as xr
from numpyro import distributions as dist

from polar_bayes.errors import FitError
from polar_bayes.inference import joint_fit as core
from polar_bayes.inference.auto import Auto
from polar_bayes.inference.request import METHODS as CORE
from polar_bayes.inference.request import Method
from polar_bayes.inference.weighted import Importance, Tempered
from polar_bayes.observation.links import AbstractLink
from polar_bayes.physics.scene import Scene
from polar_bayes.progress import Progress, with_progress

METHODS: dict[str, Method] = {
    **CORE,
    "importance": Importance(),
    "tempered": Tempered(),
    "auto": Auto(),
}


@with_progress
def fit(
    capture: xr.Dataset,
    *,
    model: str | Callable = "per_material",
    method: str | Method = "nuts",
    tolerance: float | None = None,
    seconds: float | None = None,
    scene: str | Scene | None = None,
    priors: Mapping[str, dist.Distribution] | None = None,
    links: AbstractLink | Mapping[str, AbstractLink] | None = None,
    largest_view_zenith: float | None = None,
    seed: int = 0,
    precision: str = "double",
    progress: Progress | None = None,
) -> xr.DataTree:
    """Fit one capture.

    Args:
        capture: A Dataset of the capture schema; validated here.
        model: A name in `polar_bayes.inference.request.MODELS` or a callable
            `model(data, scene, priors, links)`.
        method: "nuts", "laplace", "point", "importance" (Laplace, its draws weighed by the
            posterior), "tempered" (draws led from the prior to the posterior; one material in one
            color), "auto" (the cheapest of these that is good enough), or settings such as
            `Nuts(draws=2000)`.
        tolerance: Of "auto": largest error of a posterior mean or standard deviation, in posterior
            standard deviations, above 0 and at most 1; by default 0.1.
        seconds: Of "auto": wall time of the whole fit, by default 60. Only the first method always
            ends; what is not done by then is abandoned, and the best answer so far is returned.
        scene: A name in `SETUPS` or a `Scene`; by default the set-up that the capture names in
            its attribute `setup`, else "paper".
        priors: Distributions that replace or extend `polar_bayes.priors.PRIORS`.
        links: One link for the polarization, or a mapping from variable to link.
        largest_view_zenith: Views beyond it are set aside and counted. Unit degree.
        seed: The same seed gives the same result on the same machine, unless "auto" ran out of
            time.
        precision: "double" or "single".
        progress: Called with the name of a stage and the fraction of it that is done.

    Returns:
        A DataTree with the groups posterior, sample_stats, log_likelihood, log_prior,
        posterior_predictive, noise_free, prior, prior_predictive, observed_data and
        constant_data, and effects for a scene of `polar_bayes.choose_effects`;
        `polar_bayes.verdict` says whether it converged, and
        `polar_bayes.inference.auto_sentences` what "auto" did and why.

    Raises:
        CaptureError: The capture does not hold what a fit needs.
        SceneError: No such scene.
        FitError: A model, method, prior or link cannot be used, or the memory is too small.
    """
    return core.fit(
        capture,
        model=model,
        method=_settings(method, tolerance, seconds),
        scene=scene,
        priors=priors,
        links=links,
        largest_view_zenith=largest_view_zenith,
        seed=seed,
        precision=precision,
        progress=progress,
    )


def _settings(method: str | Method, tolerance: float | None, seconds: float | None) -> str | Method:
    """What is asked for; names that the core knows stay names."""
    wishes = {"tolerance": tolerance, "seconds": seconds}
    given = {name: value for name, value in wishes.items() if value is not None}
    if given and method != "auto":
        raise FitError(
            f"{' and '.join(given)} needs method='auto'",
            where=f"fit: method={method!r}",
            hint="leave it out, or give method='auto'",
        )
    if given:
        return Auto(**given)
    if not isinstance(method, Method):
        if not isinstance(method, str) or method not in METHODS:
            raise FitError(
                "no such method",
                where=f"method={method!r}",
                hint=f"give one of {', '.join(METHODS)}, or settings such as Nuts(draws=2000)",
            )
        return method if method in CORE else METHODS[method]
    return method
