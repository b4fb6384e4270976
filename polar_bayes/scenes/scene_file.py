"""Scene files: a scene, its links, priors and method as one small TOML file.

    setup = "goniometer"                       # links, limit and priors that are not stated
    quantities = "listed"                      # without it, those of the set-up are added
    method = "Nuts(max_tree_depth=10)"

    [scene]                                    # every part; one that is not listed is absent
    surface = "SmoothSurface()"
    subsurface = "Unpolarized()"
    mixing = "StokesMixing()"

    [links]
    q = "StokesLink(degrees_of_freedom=4.0, stated_errors=True)"

    [priors]
    angle_zero = "Normal(0, 3)"

Every key may be left out. A result holds the same texts in its provenance, so a file can be written
from any result.
"""

import dataclasses
import difflib
import functools
import json
import os
import tomllib
from collections.abc import Iterable, Mapping
from typing import Any

import xarray as xr

import polar_bayes.physics
from polar_bayes import methods
from polar_bayes.errors import FitError, SceneError
from polar_bayes.expressions import Known, parse_value, short_text
from polar_bayes.inference.request import MODELS, OWN_QUANTITIES
from polar_bayes.inference.result import provenance_of
from polar_bayes.methods.method import AbstractBatchMethod
from polar_bayes.observation import links
from polar_bayes.observation.links import AbstractLink
from polar_bayes.paths import SCENE_KEYS, atomic_write, existing_file, is_scene_file
from polar_bayes.physics import input_quantities, instrument
from polar_bayes.physics.scene import Scene
from polar_bayes.priors import parse_prior
from polar_bayes.setups import SETUPS, Setup, find_setup

LISTED = "listed"
"""Of input quantities: those of the scene alone, without those of its set-up."""


@functools.cache
def _known(*packages: Any) -> Known:
    """Return the classes of packages that a text may name."""
    named = {name: getattr(each, name) for each in packages for name in each.__all__}
    return {n: x for n, x in named.items() if isinstance(x, type) and not n.startswith("Abstract")}


# --- Texts to values ------------------------------------------------------------------------------


def parse_link(text: object, where: str) -> AbstractLink:
    """Return the link that a text such as `StokesLink(degrees_of_freedom=4)` describes."""
    found = parse_value(text, _known(links), where)
    if not isinstance(found, AbstractLink):
        raise FitError(f"{text!r} is no link", where=where, hint="give one such as BetaLink()")
    return found


def parse_method(text: str, where: str) -> str | AbstractBatchMethod:
    """Return the method that a text such as `Nuts(draws=2000)` describes; names are unchanged."""
    return parse_value(text, _known(methods), where) if "(" in text else text


def parse_scene(text: object, where: str) -> Scene:
    """Return the scene that a text such as `Scene(surface=SmoothSurface())` describes."""
    found = parse_value(
        text, _known(polar_bayes.physics, instrument, input_quantities), where, SceneError
    )
    if not isinstance(found, Scene):
        hint = "give one such as Scene(surface=SmoothSurface())"
        raise SceneError(f"{text!r} is no scene", where=where, hint=hint)
    return found


# --- Files to arguments ---------------------------------------------------------------------------


def load_scene(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a scene file as arguments of `polar_bayes.fit`.

    Other functions take those that they have: `polar_bayes.identify` has no `method`.

    Args:
        path: A TOML file with some of the keys setup, quantities, model, method,
            largest_view_zenith, scene, links and priors. Parts, links, priors and settings are
            written as calls, as in a program; they are parsed, never evaluated.

    Returns:
        Some of scene, model, method, largest_view_zenith, links and priors.

    Raises:
        CaptureError: The file is not there.
        SceneError: It is no TOML, has a key that is not known, or describes no scene.
        FitError: A link, prior, model or method cannot be used.
    """
    file = existing_file(path, "scene")
    where = str(file)
    try:
        stated = tomllib.loads(file.read_text("utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        what, hint = f"it is no TOML ({error})", "write it as `polar-bayes scene` does"
        raise SceneError(what, where=where, hint=hint) from error
    return _arguments(stated, where)


def arguments_of(result: xr.DataTree | xr.Dataset) -> dict[str, Any]:
    """Return the arguments of the fit of a result, as `load_scene` returns them.

    Raises:
        SceneError: The result states no scene.
        FitError: It has a part, link, prior or model of a user's own.
    """
    return _arguments(tomllib.loads(scene_text(result)), "result")


def _arguments(stated: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Parse the entries of a scene file as arguments."""
    _check_keys(stated, SCENE_KEYS, where)
    found: dict[str, Any] = {}
    if scene := _scene_of(stated, where):
        found["scene"] = scene
    if "model" in stated:
        if stated["model"] not in MODELS:
            hint = f"give one of {', '.join(MODELS)}; a model of your own goes with pb.fit only"
            raise FitError("no such model", where=f"{where}: model={stated['model']!r}", hint=hint)
        found["model"] = stated["model"]
    if "method" in stated:
        found["method"] = parse_method(str(stated["method"]), f"{where}: method")
    if "largest_view_zenith" in stated:
        found["largest_view_zenith"] = _number(stated["largest_view_zenith"], where)
    for key, parse in (("links", parse_link), ("priors", parse_prior)):
        texts = _table(stated, key, where)
        values = {name: parse(text, f"{where}: {key}.{name}") for name, text in texts.items()}
        found |= {key: values} if values else {}
    return found


def _scene_of(stated: Mapping[str, Any], where: str) -> str | Scene | Setup | None:
    """Return the scene with its set-up, by name if the set-up has that scene."""
    base, quantities = stated.get("setup"), stated.get("quantities", LISTED)
    if quantities != LISTED:
        what, hint = f"quantities is {quantities!r}", f"give {LISTED!r}, or leave it out"
        raise SceneError(what, where=where, hint=hint)
    setup = None if base is None else find_setup(base)
    texts = _table(stated, "scene", where)
    if not texts:
        return base
    fields = [field.name for field in dataclasses.fields(Scene)]
    _check_keys(texts, fields, f"{where}: scene")
    if "surface" not in texts:
        hint = "list every part of the scene, such as surface = 'SmoothSurface()'"
        raise SceneError("it has no surface", where=f"{where}: scene", hint=hint)
    known = _known(polar_bayes.physics, instrument, input_quantities)
    parts = {
        name: parse_value(text, known, f"{where}: scene.{name}", SceneError)
        for name, text in texts.items()
    }
    try:
        scene = Scene(**parts)
    except SceneError as error:
        raise error.within(f"{where}: scene") from None
    if setup is None:
        return scene
    if "quantities" in stated:
        return dataclasses.replace(setup, scene=scene, known=())
    scene = scene.perfectly_known if scene.perfectly_known == setup.scene else scene
    return base if scene == setup.scene else dataclasses.replace(setup, scene=scene)


def _table(stated: Mapping[str, Any], key: str, where: str) -> Mapping[str, Any]:
    found = stated.get(key, {})
    if not isinstance(found, Mapping):
        hint = f"write a table: [{key}] on a line of its own, and a line for each entry"
        raise SceneError(f"{key} is {found!r}", where=where, hint=hint)
    return found


def _number(value: object, where: str) -> float:
    if isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    raise SceneError(f"largest_view_zenith is {value!r}", where=where, hint="give a number")


def _check_keys(given: Iterable[str], known: Iterable[str], where: str) -> None:
    for name in given:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(known)}"
            raise SceneError(f"there is no entry {name!r}", where=where, hint=hint)


# --- Results to files -----------------------------------------------------------------------------


def scene_text(source: xr.DataTree | xr.Dataset | str) -> str:
    """Return the scene file of a result or of a named set-up as text.

    Args:
        source: A result of any kind, or a name in `polar_bayes.setups.SETUPS`.

    Returns:
        The text of a file that `load_scene` reads: a fit of the same capture with it has the same
        posterior.

    Raises:
        SceneError: No such set-up, or the result states no scene.
        FitError: The result has a part, link, prior or model of a user's own, which a file cannot
            describe.
    """
    if isinstance(source, str):
        return _write({"setup": source}, find_setup(source).scene, {}, {})
    provenance = provenance_of(source)
    parts, model = provenance.get("scene_parts"), provenance.get("model", "per_material")
    if not isinstance(parts, str) or " x Scene(" in parts:
        what = "it stacks several scenes" if parts else "it states no scene"
        raise SceneError(what, where="scene", hint="fit one scene, and give that result")
    if model not in MODELS or "model" in provenance.get("swapped", ()):
        hint = "fit with load_scene and model= in Python"
        raise FitError(f"a file cannot describe its model {model}", where="model", hint=hint)
    scene = parse_scene(parts, "scene")
    name = str(provenance.get("scene"))
    head = {"setup": name} if name in SETUPS else {}
    head |= {"quantities": LISTED} if OWN_QUANTITIES in provenance.get("swapped", ()) else {}
    if "quantities" in head and provenance.get("carried"):
        what, hint = "its map carries input quantities of your own", "give its Setup in Python"
        raise FitError(f"a file cannot describe it: {what}", where="scene", hint=hint)
    head |= {"model": model}
    if "method_parts" in provenance:
        method = parse_method(str(provenance["method_parts"]), "method")
        head["method"] = short_text(method)
    if "largest_view_zenith" in provenance:
        head["largest_view_zenith"] = provenance["largest_view_zenith"]
    priors, links = provenance.get("priors", {}), provenance.get("links", {})
    for prior, text in priors.items():
        parse_prior(text, f"priors.{prior}")
    return _write(head, scene, links, priors)


def save_scene(source: xr.DataTree | xr.Dataset | str, path: str | os.PathLike[str]) -> None:
    """Write the scene file of a result or of a named set-up, as `scene_text` has it.

    Raises:
        OutputError: The file cannot be written, or is no scene file.
    """
    text = scene_text(source)
    with atomic_write(path, is_scene_file) as unfinished:
        unfinished.write_text(text, "utf-8")


def _write(
    head: Mapping[str, Any], scene: Scene, link_texts: Mapping[str, str], priors: Mapping[str, str]
) -> str:
    fields = {field.name: getattr(scene, field.name) for field in dataclasses.fields(Scene)}
    shortened = {n: short_text(parse_link(text, f"links.{n}")) for n, text in link_texts.items()}
    tables = {
        "scene": {name: short_text(part) for name, part in fields.items() if part is not None},
        "links": shortened,
        "priors": priors,
    }
    lines = _lines(head)
    for title, table in tables.items():
        if table:
            lines += ["", f"[{title}]", *_lines(table)]
    return "\n".join([*lines, ""])


def _lines(table: Mapping[str, Any]) -> list[str]:
    """Format entries as TOML; its texts and numbers are those of JSON."""
    return [f"{name} = {json.dumps(value, ensure_ascii=False)}" for name, value in table.items()]
