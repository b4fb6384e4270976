"""Stacked posterior of several scenes: draws of each fit in proportion to its weight.

Source:
    Yao, Vehtari, Simpson & Gelman (2018), Bayesian Analysis 13, 917.
"""

import json
import time
from collections.abc import Hashable, Mapping

import jax
import numpy as np
import xarray as xr

from polar_bayes.diagnostics.convergence import verdict
from polar_bayes.diagnostics.parameters import SAMPLE_DIMS
from polar_bayes.errors import FitError
from polar_bayes.inference.problem import make_problem
from polar_bayes.inference.result import PROVENANCE, provenance_of
from polar_bayes.methods.auto import Auto
from polar_bayes.methods.importance import Importance
from polar_bayes.methods.least_squares import Point
from polar_bayes.methods.method import AbstractMethod
from polar_bayes.numerics.psis import FINITE_VARIANCE
from polar_bayes.progress import Progress
from polar_bayes.scenes.comparison import FitArguments, compare_candidates
from polar_bayes.scenes.fit_request import Keep, fit_request
from polar_bayes.scenes.neighbors import STOPPED, try_alternatives
from polar_bayes.scenes.sentences import film_cautions

OF_DRAWS = (
    *("posterior", "sample_stats", "log_prior", "log_likelihood"),
    *("posterior_predictive", "noise_free"),
)
"""Groups that contain posterior draws."""

SHARED = ("prior", "prior_predictive", "observed_data", "constant_data")
"""Groups that are taken from the scene of largest weight."""


def fit_best_scenes(
    arguments: FitArguments,
    method: AbstractMethod,
    progress: Progress,
    keep: Keep | None = None,
) -> xr.DataTree:
    """Compare scenes, fit those that remain by a method, and stack their posteriors."""
    if isinstance(method, Point):
        raise FitError(
            "a point estimate has no width to compare scenes by",
            where="fit: scene='auto', method='point'",
            hint="use method='laplace', or compare_scenes and then a scene of your choice",
        )
    comparison = compare_candidates(arguments, progress)
    weights = comparison.weights
    alone = len(weights) == 1
    as_compared = not comparison.lifted  # otherwise the stated priors are others
    with jax.enable_x64(arguments.precision == "double"):
        fits = {
            name: comparison.fits[name]
            if as_compared
            and (
                method == Importance()
                or (
                    isinstance(method, Auto)
                    and method.tolerance is None
                    and _serves_as_chains(comparison.fits[name], method.rounds)
                )
            )
            else fit_request(
                comparison.requests[name],
                method,
                progress,
                time.perf_counter(),
                with_comparisons=False,  # other scenes were compared already
            )
            for name in weights
        }
        result = next(iter(fits.values())) if alone else stack_fits(fits, weights)
        result["scenes"] = xr.DataTree(comparison.to_dataset())
        cautions = film_cautions(comparison)
        _add_provenance(result, scene="auto", alternatives_failed=STOPPED, scene_cautions=cautions)
        if keep is not None:
            keep(result.copy())
        request = comparison.requests[max(weights, key=lambda name: weights[name])]
        key = jax.random.key(arguments.seed)
        alternatives = try_alternatives(
            request,
            make_problem(request, key),
            {str(name): draws.to_numpy() for name, draws in result["posterior"].data_vars.items()},
            key,
            progress,
            compared=list(comparison.scenes.values()),
        )
    _add_provenance(result, **alternatives)
    return result


def _add_provenance(result: xr.DataTree, **more: object) -> None:
    """Replace provenance entries; a comparison that was made removes its failure."""
    provenance = json.loads(result.attrs[PROVENANCE]) | more
    if "alternatives" in more:
        provenance.pop("alternatives_failed", None)
    result.attrs[PROVENANCE] = json.dumps(provenance, sort_keys=True)


def _serves_as_chains(weighted: xr.DataTree, rounds: int) -> bool:
    """Return whether weighted draws converged in so many rounds, with a finite variance."""
    known = provenance_of(weighted)
    if known.get("pareto_k") is None or known.get("rounds", 1) > rounds:
        return False
    return known["pareto_k"] <= FINITE_VARIANCE and verdict(weighted).converged


def stack_fits(fits: Mapping[str, xr.DataTree], weights: Mapping[str, float]) -> xr.DataTree:
    """Combine draws of several fits over the parameters that they share."""
    trees = {name: fits[name] for name in sorted(weights, key=lambda name: -weights[name])}
    first = next(iter(trees.values()))
    index = _draws_of_each(trees, weights)
    chains = min(tree["posterior"].sizes["chain"] for tree in trees.values())
    shared = _shared([tree["posterior"].to_dataset() for tree in trees.values()])
    groups: dict[str, xr.Dataset] = {}
    for group in (name for name in OF_DRAWS if all(name in t.children for t in trees.values())):
        datasets = [tree[group].to_dataset() for tree in trees.values()]
        # Statistics whose constants differ between scenes are not stacked.
        names = [name for name in _shared(datasets) if name not in ("log_weight", "lp")]
        if not names:
            continue
        parts = [
            each[names]
            .isel(chain=slice(chains), draw=index[name])
            .drop_vars("draw", errors="ignore")
            for name, each in zip(trees, datasets, strict=True)
        ]
        groups[group] = _shuffled(xr.concat(parts, "draw", combine_attrs="override"))
    for group in (name for name in SHARED if name in first.children):
        dataset = first[group].to_dataset()
        groups[group] = dataset[shared] if group == "prior" else dataset
    stacked = xr.DataTree.from_dict(groups)
    stacked.attrs = {**first.attrs, PROVENANCE: _provenance(trees, weights, shared)}
    return stacked


def _draws_of_each(
    trees: Mapping[str, xr.DataTree], weights: Mapping[str, float]
) -> dict[str, np.ndarray]:
    """Select evenly spaced draws of each fit in proportion to its weight, unrepeated."""
    sizes = {name: tree["posterior"].sizes["draw"] for name, tree in trees.items()}
    total = min(sizes[name] / weights[name] for name in trees)
    return {
        name: np.linspace(0, size - 1, max(1, round(total * weights[name]))).astype(int)
        for name, size in sizes.items()
    }


def _shared(datasets: list[xr.Dataset]) -> list[str]:
    """Return variables with the same shape, apart from draws, in all datasets."""

    def shape(variable: xr.DataArray) -> dict[Hashable, int]:
        return {dim: n for dim, n in variable.sizes.items() if dim not in SAMPLE_DIMS}

    first, *others = datasets
    return [
        str(name)
        for name, variable in first.data_vars.items()
        if all(name in each and shape(each[name]) == shape(variable) for each in others)
    ]


def _shuffled(dataset: xr.Dataset) -> xr.Dataset:
    """Permute draws equally in every group, so that each chain mixes the scenes."""
    order = np.random.default_rng(0).permutation(dataset.sizes["draw"])
    return dataset.isel(draw=order).assign_coords(draw=np.arange(order.size))


def _provenance(
    trees: Mapping[str, xr.DataTree], weights: Mapping[str, float], shared: list[str]
) -> str:
    """Return the provenance of the heaviest scene, with the problems of every stacked scene."""
    each = {name: provenance_of(tree) for name, tree in trees.items()}
    found = dict(next(iter(each.values())))
    for key in ("modes", "pareto_k"):
        found.pop(key, None)
    for key in ("priors", "bounds", "prior_probability", "fixed", "declared"):
        found[key] = {n: x for n, x in (found.get(key) or {}).items() if n in shared}
    found["scene_parts"] = "; ".join(
        f"{weights[name]:.2f} x {own.get('scene_parts', '')}" for name, own in each.items()
    )
    verdicts = {name: verdict(tree) for name, tree in trees.items()}
    found["problems"] = [
        f"{name}: {problem.rstrip('.')}"
        for name, own in verdicts.items()
        for problem in (() if own.converged else own.problems)
    ]
    return json.dumps(found, sort_keys=True)
