"""From a checked request to the programs that fit many captures of one layout."""

import dataclasses
import functools
import threading
from collections.abc import Callable
from typing import Any

import jax

from polar_bayes.inference.kept import key_of_story
from polar_bayes.inference.program import Program, compile_program
from polar_bayes.inference.request import Request
from polar_bayes.inference.search import from_prior
from polar_bayes.inference.tracing import TRACING
from polar_bayes.observation.data import Observations
from polar_bayes.pixels.engine import Engine

MAKING = threading.RLock()
"""Held by whoever calls `make_engine`, so that no two threads make the same; always taken before
`TRACING`, because an engine compiles and runs the program that draws its candidates."""


@dataclasses.dataclass(frozen=True, eq=False)
class Recipe:
    """What programs are made from. Recipes of one key make the same, and share them."""

    request: Request
    observe: Callable[[], Observations]
    candidates: int
    key: str

    def __eq__(self, other: object) -> bool:
        """The same programs."""
        return isinstance(other, Recipe) and self.key == other.key

    def __hash__(self) -> int:
        """Of the key."""
        return hash(self.key)


def key_of(request: Request, *further: Any) -> str:
    """A text that is the same for requests whose programs are the same."""
    layout = [
        (name, v.dims, v.shape, str(v.dtype)) for name, v in request.capture.variables.items()
    ]
    return key_of_story(
        request.model,
        request.scene,
        request.priors,
        request.links,
        (request.seed, request.precision),
        layout,
        *further,
    )


@functools.lru_cache(maxsize=4)
def make_engine(recipe: Recipe) -> Engine:
    """The programs of a recipe; they are traced at their first use."""
    request, data = recipe.request, recipe.observe()
    given = {"double": data, "single": data.in_single_precision()}

    def program(precision: str) -> Program:
        with jax.enable_x64(precision == "double"), TRACING:
            model = dataclasses.replace(request, precision=precision).bind(request.scene)
            return compile_program(model, given[precision])

    exact, rough = program(request.precision), program("single")
    with jax.enable_x64(request.precision == "double"):
        key = jax.random.key(request.seed)
        starts = from_prior(exact, key, recipe.candidates, given[request.precision])
    return Engine(exact, rough, starts, request.precision).ready()
