"""What may be turned beside the method: facets, effects, precision, number of draws."""

import abc
import dataclasses
import functools
from typing import override

from polar_bayes.budget.effects import choose_effects
from polar_bayes.budget.variants import Effect, parts_of, simplify
from polar_bayes.errors import FitError, PolarBayesError
from polar_bayes.inference.kept import Kept
from polar_bayes.inference.request import Method, Request
from polar_bayes.ladder.scaling import draws_of, with_draws
from polar_bayes.physics.facets import FacetQuadrature
from polar_bayes.physics.scene import Scene

Turned = tuple[Request, Method]

NEARLY = 0.1
"""Relative difference between the draws that a dial is called by and those that there are."""


@dataclasses.dataclass(frozen=True)
class AbstractDial(abc.ABC):
    """One setting that is not the method, turned one way."""

    @property
    @abc.abstractmethod
    def name(self) -> str:
        """What it is called beside the method: `facets / 2`."""

    @abc.abstractmethod
    def turn(self, request: Request, method: Method) -> Turned | None:
        """What is fitted then.

        Args:
            request: As it was asked.
            method: The rung.

        Returns:
            Both, turned; None where this dial changes nothing.

        Raises:
            FitError: It cannot be turned for this capture; other errors of the package likewise.
        """


@dataclasses.dataclass(frozen=True)
class DrawsDial(AbstractDial):
    """So many times the draws; left out where a method cannot have about as many.

    Args:
        factor: Above 0.

    Raises:
        FitError: The factor is not above 0.
    """

    factor: float

    def __post_init__(self) -> None:
        if not self.factor > 0.0:
            raise FitError(
                f"factor is {self.factor}", where="DrawsDial", mend="give a number above 0"
            )

    @property
    @override
    def name(self) -> str:
        return _times("draws", self.factor)

    @override
    def turn(self, request: Request, method: Method) -> Turned | None:
        try:
            turned = with_draws(method, self.factor)
        except FitError:  # as few as the method allows
            return None
        before, after = draws_of(method), None if turned is None else draws_of(turned)
        if turned is None or not before or not after:
            return None
        # Numbers are rounded, or have a least: what is called so must be so.
        is_so = abs(after / before / self.factor - 1.0) < NEARLY
        return (request, turned) if is_so and turned != method else None


@dataclasses.dataclass(frozen=True)
class PrecisionDial(AbstractDial):
    """Single precision in place of double."""

    @property
    @override
    def name(self) -> str:
        return "single precision"

    @override
    def turn(self, request: Request, method: Method) -> Turned | None:
        if request.precision == "single":
            return None
        return dataclasses.replace(request, precision="single"), method


@dataclasses.dataclass(frozen=True)
class FacetsDial(AbstractDial):
    """So many times the facets in each direction.

    Args:
        factor: Above 0.

    Raises:
        FitError: The factor is not above 0.
    """

    factor: float

    def __post_init__(self) -> None:
        if not self.factor > 0.0:
            raise FitError(
                f"factor is {self.factor}", where="FacetsDial", mend="give a number above 0"
            )

    @property
    @override
    def name(self) -> str:
        return _times("facets", self.factor)

    @override
    def turn(self, request: Request, method: Method) -> Turned | None:
        turned = [
            Effect("", place, part, self._of(part))
            for place, part in parts_of(request.scene)
            if isinstance(part, FacetQuadrature)
        ]
        scene = simplify(request.scene, turned)
        return None if scene == request.scene else (_with_scene(request, scene), method)

    def _of(self, rule: FacetQuadrature) -> FacetQuadrature:
        along, across = (
            min(64, max(1, round(self.factor * nodes))) for nodes in (rule.along, rule.across)
        )
        return FacetQuadrature(along=along, across=across)


@dataclasses.dataclass(frozen=True)
class EffectsDial(AbstractDial):
    """Only the effects that `polar_bayes.choose_effects` keeps.

    Args:
        tolerance: Of the choice, posterior standard deviations, > 0.
    """

    tolerance: float = 0.1

    @property
    @override
    def name(self) -> str:
        return "chosen effects"

    @override
    def turn(self, request: Request, method: Method) -> Turned | None:
        choose = functools.partial(_chosen, request, self.tolerance)
        _, scene = _CHOSEN.of((id(request), self.tolerance), choose)
        if isinstance(scene, PolarBayesError):
            raise scene
        return None if scene == request.scene else (_with_scene(request, scene), method)


DIALS: tuple[AbstractDial, ...] = (
    DrawsDial(0.25),
    DrawsDial(4.0),
    FacetsDial(0.5),
    FacetsDial(2.0),
    EffectsDial(),
    PrecisionDial(),
)
"""What every rung is crossed with, one turn at a time."""

PRIOR = "prior of "
"""How a request says that a prior is the user's own."""

_CHOSEN: Kept[tuple[Request, Scene | PolarBayesError]] = Kept(2)
"""Choices take minutes, and every rung asks; each stands beside the request that it is of. One that
failed would fail again."""


def _chosen(request: Request, tolerance: float) -> tuple[Request, Scene | PolarBayesError]:
    plain = simplify(request.scene, ())
    own = [name.removeprefix(PRIOR) for name in request.swapped if name.startswith(PRIOR)]
    try:
        scene = choose_effects(
            request.capture,
            scene=plain,
            tolerance=tolerance,
            model=request.model,
            priors={name: request.priors[name] for name in own},
            links=request.links,
            largest_view_zenith=request.largest_view_zenith,
            seed=request.seed,
        )
    except PolarBayesError as error:
        return request, error
    return request, simplify(scene, ())


def _with_scene(request: Request, scene: Scene) -> Request:
    return dataclasses.replace(request, scene=scene)


def _times(what: str, factor: float) -> str:
    return f"{what} x {factor:g}" if factor >= 1.0 else f"{what} / {1.0 / factor:g}"
