"""A validated fit, with cached quantities.

Diagnostics, figures and pages take a tree or a view of it. A tree is checked and gets a view of its
own; whoever calls several functions makes one view with `view_of` and gives it to all of them.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any, Concatenate

import numpy as np
import xarray as xr

from polar_bayes.diagnostics.parameters import Scalar, scalars
from polar_bayes.inference.files import check_fit
from polar_bayes.inference.result import Provenance, provenance_of


@dataclasses.dataclass(frozen=True, eq=False)
class FitView:
    """A validated fit; the tree must not change while the view is in use.

    Args:
        result: The tree.
        computed: Results of functions that `once` decorates, by function and arguments.
    """

    result: xr.DataTree
    computed: dict[tuple[object, ...], Any] = dataclasses.field(default_factory=dict, repr=False)

    @functools.cached_property
    def provenance(self) -> Provenance:
        """Provenance of the fit, without null entries."""
        return provenance_of(self.result)

    @functools.cached_property
    def posterior(self) -> xr.Dataset:
        """The group `posterior`."""
        return self.result["posterior"].to_dataset()

    @functools.cached_property
    def scalars(self) -> list[Scalar]:
        """Every scalar of the posterior, the material first."""
        return scalars(self.posterior)

    @functools.cached_property
    def prior(self) -> dict[str, Scalar]:
        """Every scalar of the prior draws by its label; empty without prior draws."""
        return self.scalars_of("prior")

    @functools.cached_property
    def stats(self) -> Mapping[str, xr.DataArray]:
        """Statistics of the sampler by name, each (chain, draw); empty without any."""
        if "sample_stats" not in self.result.children:
            return {}
        return {str(name): stat for name, stat in self.result["sample_stats"].data_vars.items()}

    @functools.cached_property
    def method(self) -> str:
        """Kind of the fit's method, as recorded or inferred from its statistics."""
        if method := self.provenance.get("method"):
            return str(method)
        if "loss" in self.stats or self.posterior.sizes.get("draw", 0) == 1:
            return "point"
        return "nuts" if "diverging" in self.stats else "laplace"

    def scalars_of(self, group: str) -> dict[str, Scalar]:
        """Return every scalar of a group of draws by its label; empty without the group."""
        if group not in self.result.children:
            return {}
        return {scalar.label: scalar for scalar in scalars(self.result[group].to_dataset())}

    def truth(self, scalar: Scalar) -> float:
        """Return the true value of a parameter; NaN where the capture does not state it."""
        if "constant_data" not in self.result.children:
            return np.nan
        true = self.result["constant_data"].data_vars.get(f"true_{scalar.name}")
        if true is None or not set(true.dims) <= set(scalar.index):
            return np.nan
        return float(true.isel({dim: scalar.index[str(dim)] for dim in true.dims}))


def view_of(result: xr.DataTree | FitView, source: str = "result") -> FitView:
    """Return the view of a fit after checking it; errors name the source."""
    if isinstance(result, FitView):
        return result
    check_fit(result, source)
    return FitView(result)


def once[**P, R](
    compute: Callable[Concatenate[FitView, P], R],
) -> Callable[Concatenate[xr.DataTree | FitView, P], R]:
    """Cache a function of a view, for each view and further arguments."""

    @functools.wraps(compute)
    def wrapper(result: xr.DataTree | FitView, *args: P.args, **kwargs: P.kwargs) -> R:
        fit, key = view_of(result), (compute, args, *kwargs.items())
        if key not in fit.computed:
            fit.computed[key] = compute(fit, *args, **kwargs)
        found: R = fit.computed[key]
        return found

    return wrapper
