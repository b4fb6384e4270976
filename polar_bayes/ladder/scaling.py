"""The same method with more draws, or fewer."""

import dataclasses
import functools
import math
from typing import Any

from polar_bayes.errors import FitError
from polar_bayes.inference.nuts import Nuts
from polar_bayes.inference.request import Method
from polar_bayes.ladder.tempered import Tempered
from polar_bayes.pixels.tempering import PixelTempering


@functools.singledispatch
def with_draws(method: Method, factor: float) -> Method | None:
    """The same settings with so many times the draws."""
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
    wanted = factor * settings.answer_draws
    if wanted < settings.crowd:
        raise FitError(
            f"{wanted:g} draws are fewer than the crowd of {settings.crowd}",
            where="Tempered",
            mend="give a smaller crowd, or more draws",
        )
    more = with_answer_draws(settings, wanted)
    worth = settings.effective_draws * more.answer_draws / settings.answer_draws
    return Tempered(dataclasses.replace(more, effective_draws=worth))


def with_answer_draws(settings: PixelTempering, count: float) -> PixelTempering:
    """The same settings with at least so many draws in an answer."""
    half = math.ceil(0.5 * max(count, settings.crowd))
    worth = min(settings.effective_draws, float(half))
    return dataclasses.replace(settings, draws=half, effective_draws=worth)


@functools.singledispatch
def draws_of(method: Method) -> int | None:
    """How many draws a method makes, at least."""
    draws = getattr(method, "draws", None)
    return draws if isinstance(draws, int) else None


@draws_of.register
def _(method: Tempered) -> int | None:
    return method.settings.answer_draws
