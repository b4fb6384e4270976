"""The effects that a capture can see: everything on, weighed one by one, the rest left out."""

import dataclasses
import json
from collections.abc import Callable, Iterable, Mapping
from typing import Any, override

import jax
import xarray as xr
from numpyro import distributions as dist

from polar_bayes.budget.ledger import make_ledger
from polar_bayes.budget.rule import Wishes, decide, weigh
from polar_bayes.budget.scales import Scales
from polar_bayes.budget.variants import effects_of, simplify
from polar_bayes.errors import FitError
from polar_bayes.inference.request import resolve
from polar_bayes.observation.links import AbstractLink
from polar_bayes.physics.scene import Scene
from polar_bayes.physics.scenes import FULL_SCENES
from polar_bayes.priors import resolve_priors
from polar_bayes.progress import Progress, silent, watched


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class ChosenScene(Scene):
    """A scene that knows why it is as it is.

    It is used as any other scene. A fit keeps the ledger in its group `effects`; a scene made from
    it by `dataclasses.replace` has none, because the ledger would no longer be true of it.
    """

    ledger: xr.Dataset | None = dataclasses.field(  # type: ignore[misc]
        default=None, init=False, compare=False, repr=False
    )
    """What each effect changes and costs; `polar_bayes.budget.ledger` says how to read it."""

    @override
    def __repr__(self) -> str:
        return repr(simplify(self, ()))  # as one would write it


@watched
def choose_effects(
    capture: xr.Dataset,
    *,
    scene: str | Scene | None = None,
    tolerance: float = 0.1,
    keep: str | Iterable[str] = (),
    drop: str | Iterable[str] = (),
    parameters: Iterable[str] | None = None,
    model: str | Callable = "per_material",
    priors: Mapping[str, dist.Distribution] | None = None,
    links: AbstractLink | Mapping[str, AbstractLink] | None = None,
    largest_view_zenith: float | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> ChosenScene:
    """Keep of a scene what this capture can see.

    Each effect is left out alone. It may go if no parameter then moves by more than `tolerance`
    posterior standard deviations, and none changes its standard deviation by more than that share.
    All that may go is then left out together and judged again; while that fails, the effect that
    changes most comes back.

    Args:
        capture: A Dataset of the capture schema; validated here.
        scene: The scene with everything on, or the name of a set-up; by default the set-up that
            the capture names. `polar_bayes.physics.scenes.FULL_SCENES` has the scenes of set-ups.
        tolerance: Posterior standard deviations, > 0.
        keep: Effects that stay, by name, class of the part or path, such as "AngleZero".
        drop: Effects that go, whatever they change; the rule asks what the others change then.
        parameters: Names of the parameters that are judged; by default all but those that only
            the effect itself reads.
        model: As for `polar_bayes.fit`.
        priors: As for `polar_bayes.fit`; for parameters of the scene with everything on.
        links: As for `polar_bayes.fit`.
        largest_view_zenith: As for `polar_bayes.fit`.
        seed: Of the search for the peak.
        progress: Called with the name of a stage and the fraction of it that is done.

    Returns:
        The scene to fit, with its `ledger`.

    Raises:
        CaptureError: The capture does not hold what a fit needs.
        SceneError: No such scene or effect.
        FitError: A prior, link or setting cannot be used, or the full scene has no peak.
    """
    if not (isinstance(tolerance, int | float) and tolerance > 0.0):
        raise FitError(
            f"tolerance is {tolerance!r}",
            where="choose_effects",
            mend="give posterior standard deviations above 0, such as 0.1",
        )
    request = resolve(
        capture, model, "laplace", scene, None, links, largest_view_zenith, seed, "double"
    )
    named = not isinstance(scene, Scene)
    full = simplify(FULL_SCENES[request.scene_name] if named else request.scene, ())
    effects = effects_of(full)
    wishes = Wishes.of(effects, keep, drop)
    names = None if parameters is None else tuple(parameters)
    with jax.enable_x64(True):
        scales = Scales(request, priors, progress or silent)
        # What is refused here is refused before minutes are spent.
        resolve_priors(scales.priors(full).read, priors)
        weighed = weigh(scales, full, effects, names)
        verdict = decide(scales, full, weighed, wishes, float(tolerance))
        costs = scales.costs()
    settings: dict[str, str | float | int] = {
        "tolerance": float(tolerance),
        "largest_view_zenith": request.largest_view_zenith,
        "seed": request.seed,
        "links": json.dumps({name: repr(link) for name, link in request.links.items()}),
    }
    choice = ChosenScene(**_fields(verdict.scene))
    ledger = make_ledger(full, weighed, verdict, wishes, costs, settings)
    object.__setattr__(choice, "ledger", ledger)
    return choice


def _fields(scene: Scene) -> dict[str, Any]:
    return {field.name: getattr(scene, field.name) for field in dataclasses.fields(Scene)}
