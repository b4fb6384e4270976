"""Which prior each parameter of a model gets, and which ones are refused."""

import difflib
import math
from collections.abc import Iterable, Iterator, Mapping
from typing import override

import jax
import jax.numpy as jnp
import numpy as np
from numpyro import distributions as dist

from polar_bayes.errors import FitError
from polar_bayes.priors.support import support_bounds
from polar_bayes.priors.table import PRIORS, RANGES


class PriorTable(Mapping[str, dist.Distribution]):
    """The priors that a model may read: the table with a caller's replacements."""

    # It notes which names are read, so that a model need not list its parameters.

    def __init__(self, overrides: Mapping[str, dist.Distribution] | None = None) -> None:
        if not isinstance(overrides, Mapping | None):
            raise FitError(
                f"a {type(overrides).__name__} does not name what it replaces",
                where="priors",
                mend="give a mapping such as {'roughness': HalfNormal(0.1)}",
            )
        self._rows = {**PRIORS, **(overrides or {})}
        self._read: dict[str, None] = {}

    @property
    def read(self) -> tuple[str, ...]:
        """The names that were read so far, in that order."""
        return tuple(self._read)

    @override
    def __getitem__(self, name: str) -> dist.Distribution:
        return in_this_precision(self.row(name))

    def row(self, name: str) -> dist.Distribution:
        """The prior as it was given."""
        if name not in self._rows:
            raise FitError(
                "this parameter has no prior",
                where=f"priors[{name!r}]",
                mend=f"give one: priors={{{name!r}: <a NumPyro distribution>}}",
            )
        self._read[name] = None
        return self._rows[name]

    @override
    def __iter__(self) -> Iterator[str]:
        return iter(self._rows)

    @override
    def __len__(self) -> int:
        return len(self._rows)


def in_this_precision(prior: dist.Distribution) -> dist.Distribution:
    """A copy of a prior in the floating type of this fit."""
    # Distributions keep what they have computed once, in the precision of that day; a copy made
    # from their arguments alone does not.

    def convert(argument: object) -> object:
        if hasattr(argument, "dtype") and jnp.issubdtype(argument.dtype, jnp.floating):
            return jnp.asarray(np.asarray(argument).astype(jnp.result_type(float)))
        return argument

    return jax.tree.map(convert, prior)


def resolve_priors(
    parameters: Iterable[str], overrides: Mapping[str, dist.Distribution] | None = None
) -> dict[str, dist.Distribution]:
    """The prior of every parameter that a model reads."""
    parameters = tuple(parameters)
    table = PriorTable(overrides)
    for name, prior in (overrides or {}).items():
        _check_override(str(name), prior, parameters)
    return {name: table.row(name) for name in parameters}


def check_support(name: str, prior: dist.Distribution, where: str) -> None:
    """Refuse a distribution that allows values outside the physical range of its parameter."""
    least, most = RANGES.get(name, (-math.inf, math.inf))
    try:
        low, high = support_bounds(prior)
    except jax.errors.ConcretizationTypeError:
        return  # bounds that depend on other parameters are known only when it runs
    if low < least or high > most:
        raise FitError(
            f"{type(prior).__name__} allows values outside {least:g} to {most:g}",
            where=where,
            mend=_in_range(least, most),
        )


def _in_range(least: float, most: float) -> str:
    """What to give instead, in words."""
    if (least, most) == (0.0, 1.0):
        return "give a Beta distribution, or a truncated one"
    if least == 0.0 and math.isinf(most):
        return "give a HalfNormal or LogNormal distribution"
    bound = f"low={least:g}" if math.isinf(most) else f"low={least:g}, high={most:g}"
    return f"truncate it, for example TruncatedNormal(..., {bound})"


def _check_override(name: str, prior: object, parameters: tuple[str, ...]) -> None:
    where = f"priors[{name!r}]"
    if name not in parameters:
        near = difflib.get_close_matches(name, parameters, n=1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise FitError(
            "no such parameter in this model",
            where=where,
            mend=f"{hint}the parameters are {', '.join(parameters)}",
        )
    if not isinstance(prior, dist.Distribution):
        raise FitError(
            f"a {type(prior).__name__} is not a NumPyro distribution",
            where=where,
            mend="give an object such as numpyro.distributions.Normal(0.0, 1.0)",
        )
    _check_shape(name, prior, where)
    check_support(name, prior, where)


def _check_shape(name: str, prior: dist.Distribution, where: str) -> None:
    """Refuse what would be repeated over the wrong axes, or cannot be differentiated."""
    if prior.support.is_discrete:
        raise FitError(
            f"{type(prior).__name__} is discrete, and samplers follow gradients",
            where=where,
            mend="give a continuous distribution",
        )
    usual = PRIORS.get(name)
    if usual is None:
        return  # a parameter of the user's own has the shape that its reader expects
    if len(prior.event_shape) != len(usual.event_shape):
        to_event = "one number" if not usual.event_shape else "a vector: use .expand([n])"
        raise FitError(
            f"one draw of it has shape {tuple(prior.event_shape)}",
            where=where,
            mend=f"give a distribution of {to_event}{'.to_event(1)' if usual.event_shape else ''}",
        )
    if prior.batch_shape and prior.batch_shape[-1] != 1:
        raise FitError(
            f"it is {prior.batch_shape[-1]} distributions side by side",
            where=where,
            mend="give one, or one per wavelength in shape (wavelength, 1): views share it",
        )
