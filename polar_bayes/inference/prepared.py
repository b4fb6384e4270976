"""A model on captures of one layout, with all that is compiled of it; kept from fit to fit."""

import dataclasses
import functools
from collections.abc import Callable

from jaxtyping import Array

from polar_bayes.inference import point
from polar_bayes.inference.ground import AbstractGrounds, make_grounds
from polar_bayes.inference.kept import Kept, key_of_story, layout_of
from polar_bayes.inference.program import Model, Program, compile_program
from polar_bayes.inference.request import Request
from polar_bayes.inference.tracing import TRACING, TracedByShape
from polar_bayes.observation.data import Observations
from polar_bayes.physics.scene import Scene

MOST_KEPT = 8


@dataclasses.dataclass(frozen=True, eq=False)
class Prepared:
    """What fits of one model to captures of one layout have in common."""

    model: Model
    program: Program
    layout: Observations

    @functools.cached_property
    def grounds(self) -> AbstractGrounds:
        """What searches for peaks."""
        with TRACING:
            return make_grounds(self.model, self.program, self.layout)

    @functools.cached_property
    def least_squares(self) -> Callable[[Array, Observations], point.Estimate]:
        """The least squares from some starts, compiled."""
        return TracedByShape(lambda starts, data: point.estimate(self.program, data, starts))


_KEPT: Kept[Prepared] = Kept(MOST_KEPT)


def prepare(request: Request, scene: Scene, data: Observations) -> Prepared:
    """What fits the capture, and any other of its layout, kept from the last fit where it can be."""
    key = key_of_story(
        request.model, scene, request.priors, request.links, request.precision, layout_of(data)
    )

    def make() -> Prepared:
        model = request.bind(scene)
        return Prepared(model, compile_program(model, data), data)

    with TRACING:
        return _KEPT.of(key, make)
