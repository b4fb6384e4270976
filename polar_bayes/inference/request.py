"""Requests: the arguments of a fit, checked and with every default filled in."""

import dataclasses
import functools
import math
from collections.abc import Callable, Collection, Container, Mapping
from numbers import Integral

import jax
import numpy as np
import xarray as xr
from numpyro import distributions as dist
from numpyro.primitives import Messenger

from polar_bayes.capture.schema import validate
from polar_bayes.errors import CaptureError, FitError
from polar_bayes.inference.model_parts import ModelParts, layout_of
from polar_bayes.inference.program import ModelInfo, inspect_model
from polar_bayes.inference.result import Provenance
from polar_bayes.models.gp_spectral import gp_spectral
from polar_bayes.models.hierarchical import Hierarchical
from polar_bayes.models.per_material import per_material
from polar_bayes.numerics.compile import TRACING_LOCK, LRUCache
from polar_bayes.observation.data import observe
from polar_bayes.observation.links import AbstractLink
from polar_bayes.physics.input_quantities import quantity_of
from polar_bayes.physics.instrument import Discrepancy
from polar_bayes.physics.part import parameters_of
from polar_bayes.physics.scene import Scene
from polar_bayes.physics.surface import SmoothSurface
from polar_bayes.priors import (
    PRIORS,
    PriorTable,
    prior_text,
    resolve_priors,
)
from polar_bayes.setups import (
    SETUPS,
    UNSTATED,
    Setup,
    as_read,
    check_known,
    default_priors,
    find_setup,
    setup_name,
)

MODELS: dict[str, Callable] = {
    "per_material": per_material,
    "hierarchical": Hierarchical(),
    "gp_spectral": gp_spectral,
}

MIN_VIEWS = 2
"""Fewest valid views with which a capture, or a pixel, is fitted."""

OWN_QUANTITIES = "input quantities of the set-up"
"""What a user replaced by a `Setup` that is known otherwise."""

_MODEL_INFO: LRUCache[ModelInfo] = LRUCache(32)


@dataclasses.dataclass(frozen=True)
class Request(ModelParts):
    """A capture, a model and all that fixes its posterior, with every default filled in."""

    capture: xr.Dataset
    model_name: str
    scene_name: str
    scene_chosen_by: str
    declared: dict[str, str]
    fixed: dict[str, object]
    swapped: tuple[str, ...]
    largest_view_zenith: float
    seed: int
    precision: str
    shared: tuple[str, ...]
    """Parameters of the set-up that the pixels of an image share by default, carried or not."""
    carried: Mapping[str, dist.Distribution]
    """Priors of input quantities that a pixel does not sample: they move all pixels alike."""
    scene_with_setup: Scene
    """The scene with those quantities."""

    def standard_uncertainties(self, sampled: Container[str]) -> dict[str, float]:
        """Return standard deviations of the priors of scalar parameters of the instrument."""
        terms = (each for each in self.scene.terms if not isinstance(each, Discrepancy))
        priors = {name: self.priors[name] for name in parameters_of(*terms) if name in sampled}
        variances = {name: _variance(prior) for name, prior in priors.items()}
        return {name: math.sqrt(x) for name, x in variances.items() if 0.0 < x < math.inf}

    def describe(self) -> Provenance:
        """Describe the request in types of JSON, for the provenance of a result."""
        return {
            "model": self.model_name,
            "scene": self.scene_name,
            "scene_chosen_by": self.scene_chosen_by,
            "scene_parts": repr(self.scene),
            "priors": {name: prior_text(prior) for name, prior in self.priors.items()},
            "links": {name: repr(link) for name, link in self.links.items()},
            "seed": self.seed,
        }


def _variance(prior: dist.Distribution) -> float:
    """Return the variance of a scalar prior, by draws where NumPyro does not state it."""
    try:
        return float(np.sum(prior.variance))
    except NotImplementedError:  # of a transformed distribution, say
        return float(np.sum(np.var(prior.sample(jax.random.key(0), (10_000,)), axis=0)))


def resolve(
    capture: xr.Dataset,
    model: str | Callable,
    scene: str | Scene | Setup | None,
    priors: Mapping[str, dist.Distribution] | None,
    links: AbstractLink | Mapping[str, AbstractLink] | None,
    largest_view_zenith: float | None,
    seed: int,
    precision: str,
    *,
    known: Mapping[str, float] | None = None,
    shared: Collection[str] | None = None,
) -> Request:
    """Check the arguments of the caller, and fill in every default.

    A pixel, with names that an image shares, carries input quantities that it does not sample.
    """
    capture = validate(capture)
    _refuse_images(capture)
    setup, scene_name, chosen_by = _find_scene(scene, capture)
    others_known = setup.known != SETUPS.get(scene_name, setup).known
    setup = as_read(setup, capture)
    setup, whole = _known_to(setup, capture, shared)
    chosen = _choose_links(capture, setup, links)
    limit = setup.largest_view_zenith if largest_view_zenith is None else largest_view_zenith
    _check_settings(limit, precision, seed)
    _check_views(capture, limit)
    function = model if callable(model) else _find_model(model)
    PriorTable(priors)  # refuses what names no priors
    known = check_known(known)  # and counts more: a scene file of a result lists every prior
    given = {n: x for n, x in (priors or {}).items() if quantity_of(n) not in known}
    usual = ({} if shared is None else _pixel_priors()) | default_priors(whole, capture, known)
    carried = set(whole.scene.parameters) - set(setup.scene.parameters)
    same = {n: x for n, x in {**PRIORS, **usual}.items() if _are_same(given.get(n), x)}
    own = {name: prior for name, prior in given.items() if name not in same}
    asked = given.keys() | {name for name in usual if quantity_of(name) in known}
    every = usual | own | same
    stated = {name: prior for name, prior in every.items() if name not in carried}
    parts = ModelParts(function, setup.scene, stated, chosen)
    with jax.enable_x64(precision == "double"):
        data = observe(capture, largest_view_zenith=limit, padded=parts.is_padded, described=chosen)
        with TRACING_LOCK:
            key = parts.key(layout_of(data))
            found = _MODEL_INFO.of(key, lambda: inspect_model(parts, data))
    by_capture = [n for n in map(quantity_of, usual) if f"{n}_uncertainty" in capture.attrs]
    swapped = {
        "scene": scene_name == "custom",
        OWN_QUANTITIES: others_known,
        "model": callable(model),
        "links": links is not None and chosen != _usual_links(capture, setup),
        **{f"prior of {name}": True for name in own},
        **{f"uncertainty of {name} ({u:g})": True for name, u in known.items()},
        **{f"uncertainty of {n} (by the capture)": n not in known for n in by_capture},
        **{f"{name} held fixed": True for name in found.fixed},
    }
    return Request(
        capture=capture,
        model=function,
        model_name=_name_of(model) if callable(model) else model,
        scene=setup.scene,
        scene_name=scene_name,
        scene_chosen_by=chosen_by,
        priors=resolve_priors(
            found.priors,
            {n: prior for n, prior in stated.items() if n in found.priors or n in asked},
        ),
        carried={n: {**PRIORS, **every}[n] for n in whole.scene.parameters if n in carried},
        scene_with_setup=whole.scene,
        declared=found.declared,
        fixed=found.fixed,
        links=chosen,
        swapped=tuple(name for name, was_swapped in swapped.items() if was_swapped),
        largest_view_zenith=limit,
        seed=int(seed),
        precision=precision,
        shared=tuple(n for n in setup.shared if n in found.priors or n in carried),
    )


def _known_to(
    setup: Setup, capture: xr.Dataset, shared: Collection[str] | None
) -> tuple[Setup, Setup]:
    """The set-up with input quantities that a fit, or a pixel, samples, and with all of them."""
    acting = [each for each in setup.known if all(name in capture for name in each.needs)]
    sampled = acting
    if shared is not None:
        own = {*setup.sampled, *shared}
        sampled = [each for each in acting if own & {each.name, *each.parameters}]
    some, every = (setup.scene.known_to(each) for each in (sampled, acting))
    return dataclasses.replace(setup, scene=some), dataclasses.replace(setup, scene=every)


def _pixel_priors() -> dict[str, dist.Distribution]:
    """Return priors that differ in a map: an image is not exposed for the light of one pixel."""
    exposure = PRIORS["exposure"]
    return {"exposure": dist.LogNormal(exposure.loc, exposure.scale)}


def _refuse_images(capture: xr.Dataset) -> None:
    if {"y", "x"} & set(map(str, capture.dims)):
        raise CaptureError(
            "an image has too many materials for one joint fit",
            where=f"{capture.attrs.get('name', 'capture')}: dims y, x",
            hint="average a region into one capture first, for example capture.mean(('y', 'x'))",
        )


def _check_settings(limit: float, precision: str, seed: int) -> None:
    what, hint = "", ""
    if not 0.0 < limit <= 90.0:
        what, hint = f"largest_view_zenith is {limit}", "give degrees above 0, up to 90"
    elif precision not in ("double", "single"):
        what, hint = f"precision is {precision!r}", "give 'double' or 'single'"
    elif not isinstance(seed, Integral) or isinstance(seed, bool) or not 0 <= seed < 2**32:
        what, hint = f"seed is {seed!r}", "give an integer from 0 to 2**32 - 1"
    if what:
        raise FitError(what, where="fit", hint=hint)


def _find_scene(scene: object, capture: xr.Dataset) -> tuple[Setup, str, str]:
    """Return the set-up, given by name or value, its name, and who chose it."""
    if scene is None:
        name = str(capture.attrs.get("setup", UNSTATED))
        return find_setup(name), name, "capture" if "setup" in capture.attrs else "default"
    if isinstance(scene, str):
        return find_setup(scene), scene, "caller"
    if isinstance(scene, Setup):
        return scene, setup_name(scene), "caller"
    return _setup_around(scene, capture), "custom", "caller"


def _usual_links(capture: xr.Dataset, setup: Setup) -> dict[str, AbstractLink]:
    """Return a set-up's links for the variables of a capture."""
    return {name: link for name, link in setup.links.items() if name in capture}


def _are_same(prior: object, usual: object) -> bool:
    """Return whether a prior equals the default, as in scene files that list every prior."""
    if not isinstance(prior, dist.Distribution) or not isinstance(usual, dist.Distribution):
        return False
    # A class of the user's own may have any name.
    is_known = type(prior).__module__.startswith(("numpyro.", "polar_bayes."))
    return is_known and prior_text(prior) == prior_text(usual)


def _find_model(name: object) -> Callable:
    if not isinstance(name, str) or name not in MODELS:
        raise FitError(
            "no such model", where=f"model={name!r}", hint=f"give one of {', '.join(MODELS)}"
        )
    return MODELS[name]


def _name_of(model: Callable) -> str:
    """Return the name of the user's model, including handlers around it."""
    if isinstance(model, functools.partial):
        return _name_of(model.func)
    inner = getattr(model, "fn", None) if isinstance(model, Messenger) else None
    if inner is not None:
        return f"{type(model).__name__}({_name_of(inner)})"
    return getattr(model, "__name__", type(model).__name__)


def _setup_around(scene: object, capture: xr.Dataset) -> Setup:
    """Return the user's scene with the links and limits of the capture's set-up."""
    if not isinstance(scene, Scene):
        raise FitError(
            f"a {type(scene).__name__} is not a scene",
            where="scene",
            hint=f"give a polar_bayes.Scene, a Setup, or one of {', '.join(SETUPS)}",
        )
    base = SETUPS.get(str(capture.attrs.get("setup")), SETUPS["paper"])
    return dataclasses.replace(base, scene=scene)


def _choose_links(
    capture: xr.Dataset, setup: Setup, links: AbstractLink | Mapping[str, AbstractLink] | None
) -> dict[str, AbstractLink]:
    """Return links for the variables of the capture."""
    if links is None:
        chosen = _usual_links(capture, setup)
        wanted = list(setup.links)
    elif isinstance(links, AbstractLink):
        kept = {n: link for n, link in setup.links.items() if n == "intensity" and n in capture}
        chosen = {name: links for name in links.observables if name in capture}
        chosen |= {n: link for n, link in kept.items() if n not in chosen}
        wanted = list(links.observables)
    elif isinstance(links, Mapping):
        chosen, wanted = dict(links), list(links)
    else:
        raise FitError(
            f"a {type(links).__name__} is not a link",
            where="links",
            hint="give a link such as BetaLink(), or a mapping {'dop': BetaLink()}",
        )
    for name, link in chosen.items():
        _check_link(name, link, capture)
    # How bright a mirror is at each angle tells its index, also where the exposure is not known.
    is_mirror = isinstance(setup.scene.surface, SmoothSurface)
    if not {"dop", "q", "u", *(("intensity",) if is_mirror else ())} & set(chosen):
        raise CaptureError(
            f"no polarization that these links describe (wanted {' or '.join(wanted)})",
            where=str(capture.attrs.get("name", "capture")),
            hint="links name every variable that is fitted: add BetaLink for dop, StokesLink for "
            "q and u, or choose another scene, as scene='auto' does; of a mirror the intensity "
            "alone will do, by scene='goniometer'",
        )
    return chosen


def _check_link(name: str, link: object, capture: xr.Dataset) -> None:
    where = f"links[{name!r}]"
    if not isinstance(link, AbstractLink):
        raise FitError(
            f"a {type(link).__name__} is not a link",
            where=where,
            hint="give a link such as BetaLink()",
        )
    if name not in link.observables:
        raise FitError(
            f"{type(link).__name__} does not describe {name}",
            where=where,
            hint=f"it describes {', '.join(link.observables)}",
        )
    if name not in capture:
        raise FitError(
            f"the capture has no variable {name}",
            where=where,
            hint="leave that link out or measure the variable",
        )


def _check_views(capture: xr.Dataset, limit: float) -> None:
    """Refuse captures with a single view, which cannot separate four parameters."""
    data_valid = capture.get("valid", xr.DataArray(True)) & (capture["view_zenith"] <= limit)
    per_fit = data_valid.broadcast_like(capture["view_zenith"])
    used = int(per_fit.any([d for d in per_fit.dims if d != "view"]).sum())
    if used < MIN_VIEWS:
        raise CaptureError(
            f"only {used} valid view{'s' if used != 1 else ''} up to {limit:g} degrees",
            where=f"{capture.attrs.get('name', 'capture')}: view",
            hint="measure at two or more angles; the more they differ, the better",
        )
