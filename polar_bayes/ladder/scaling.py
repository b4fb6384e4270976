"""The same method with more draws, or fewer."""

import dataclasses
import functools
import math
from typing import Any

from polar_bayes.inference.nuts import Nuts
from polar_bayes.inference.request import Method
from polar_bayes.ladder.tempered import Tempered


@functools.singledispatch
def with_draws(method: Method, factor: float) -> Method | None:
    """The same settings with so many times the draws.

    Args:
        method: Settings of any method; a dataclass with a field `draws` needs nothing more.
        factor: Above 0.

    Returns:
        The settings; None where the method draws nothing.

    Raises:
        FitError: The method refuses so few.
    """
    draws = getattr(method, "draws", None)
    if not isinstance(draws, int):
        return None
    changed: dict[str, Any] = {"draws": math.ceil(factor * draws)}
    return dataclasses.replace(method, **changed)


@with_draws.register
def _(method: Nuts, factor: float) -> Method:
    scaled = {name: math.ceil(factor * getattr(method, name)) for name in ("draws", "most_draws")}
    return dataclasses.replace(method, effective_draws=factor * method.effective_draws, **scaled)


@with_draws.register
def _(method: Tempered, factor: float) -> Method:
    settings = method.settings
    crowds = max(1, math.ceil(factor * settings.draws / settings.crowd))
    draws = crowds * settings.crowd
    worth = settings.effective_draws * draws / settings.draws
    return Tempered(dataclasses.replace(settings, draws=draws, effective_draws=worth))
