"""Option types and options that several commands share.

Option types refuse wrong values before anything is computed and before JAX is loaded.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, override

import click
from click.core import ParameterSource

import polar_bayes as pb
from polar_bayes.errors import CaptureError, FitError, OutputError, PolarBayesError, SceneError
from polar_bayes.methods.registry import FIT_DEFAULT, method_names
from polar_bayes.paths import as_path, check_output, is_scene_file, refuse_inputs

type Param = click.Parameter | None
type Context = click.Context | None


def _flag(param: Param) -> str:
    """Format an option or argument as errors name it."""
    return param.opts[0] if param is not None else "value"


@dataclasses.dataclass(frozen=True)
class Name(click.ParamType):
    """A key of a registry of the package, which is not imported for this check.

    One that `takes_calls` also takes settings such as `Nuts(draws=2000)`, which are parsed when
    they are needed.
    """

    kind: str
    names: tuple[str, ...]
    error: type[PolarBayesError] = FitError
    takes_calls: bool = False
    name = "text"

    @override
    def convert(self, value: str | Path, param: Param, ctx: Context) -> str:
        if value not in self.names and not (self.takes_calls and "(" in str(value)):
            where, hint = f"{_flag(param)} {value}", f"give one of {', '.join(self.names)}"
            raise self.error(f"no such {self.kind}", where=where, hint=hint)
        return str(value)


@dataclasses.dataclass(frozen=True)
class Assignment(click.ParamType):
    """Option type: NAME=CALL, such as `angle_zero=Normal(0,3)`; some options make NAME optional."""

    is_named: bool
    is_number: bool = False
    name = "text"

    @override
    def convert(self, value: str | Path, param: Param, ctx: Context) -> tuple[str, str | float]:
        where, hint = f"{_flag(param)} {value}", "write it as --known light_zenith=0.2"
        if not self.is_number:
            hint = "write NAME=DISTRIBUTION, such as 'angle_zero=Normal(0,3)'"
        name, equals, text = str(value).partition("=")
        if not (equals and name.strip().isidentifier()):
            if self.is_named:
                raise FitError("it does not say of what", where=where, hint=hint)
            return "", str(value)
        try:
            return name.strip(), float(text) if self.is_number else text
        except ValueError as error:
            raise FitError("it is no number", where=where, hint=hint) from error


MODEL = Name("model", ("per_material", "hierarchical", "gp_spectral"))
MATERIAL = Name("material", ("leaf", "fruit", "plastic", "coating", "glass", "water"), CaptureError)
FIT_METHOD = Name("method", method_names(one=True), takes_calls=True)
MANY_METHOD = Name("method", method_names(many=True), takes_calls=True)
STUDY_METHOD = Name("method", ("point", "laplace", "importance", "nuts short", "nuts", "nuts long"))


@dataclasses.dataclass(frozen=True)
class Input(click.ParamType):
    """Path of a file or folder that is read; `check` refuses one that does not exist.

    Where a scene is asked for, the `names` that the package knows may stand in its place, and a
    path has the suffix of what is described `otherwise`.
    """

    is_path: bool = True
    names: tuple[str, ...] = ()
    suffix: str = ""
    otherwise: str = ""
    name = "path"

    @override
    def convert(self, value: str | Path, param: Param, ctx: Context) -> Path | str:
        if value in self.names or not self.is_path:
            return str(value)
        path = as_path(value, _flag(param))
        if not self.names or path.suffix == self.suffix or path.exists():
            return path
        hint = f"give one of {', '.join(self.names)}, or {self.otherwise}"
        raise SceneError("no such scene", where=f"{_flag(param)} {value}", hint=hint)

    def check(self, path: Path) -> None:
        """Refuse a path that does not exist, unless it can be the name of a column."""
        if self.is_path and not path.exists():
            what = "store" if path.suffix == ".zarr" else "file"
            raise CaptureError(f"there is no such {what}", where=str(path), hint="check the path")


@dataclasses.dataclass(frozen=True)
class Output(click.ParamType):
    """Option type: path of an output, which is checked when all inputs are known."""

    # A folder or store has no `kind`; the function that writes it checks the rest.

    kind: str | None = None
    name = "path"

    @override
    def convert(self, value: str | Path, param: Param, ctx: Context) -> Path:
        return as_path(value, _flag(param), OutputError)

    def check(self, path: Path, inputs: list[Path]) -> None:
        """Refuse a path that must not be written."""
        if self.kind is None:
            refuse_inputs(path, inputs)
            return
        from polar_bayes.capture.files import is_capture, is_result

        kinds = {"capture": is_capture, "result": is_result, "scene": is_scene_file}
        check_output(path, kinds[self.kind], inputs)


INPUT, COLUMN_OR_INPUT = Input(), Input(is_path=False)
CAPTURE_FILE, RESULT_FILE, SCENE_FILE = map(Output, ("capture", "result", "scene"))
FOLDER = STORE = Output()
SETUP_NAMES = ("paper", "polarimeter", "camera", "picture", "goniometer")
SCENE = Input(names=SETUP_NAMES, suffix=".toml", otherwise="a scene file (.toml)")
FIT_SCENE = dataclasses.replace(SCENE, names=(*SETUP_NAMES, "auto"))
SCENE_SOURCE = Input(names=SETUP_NAMES, suffix=".nc", otherwise="a result")


class Command(click.Command):
    """A command whose inputs and outputs are checked before it begins."""

    @override
    def invoke(self, ctx: click.Context) -> object:
        inputs = []
        for param in self.params:
            kinds = param.type.types if isinstance(param.type, click.Tuple) else [param.type]
            for kind in (kind for kind in kinds if isinstance(kind, Input)):
                for path in _paths(ctx.params[str(param.name)], kind):
                    kind.check(path)
                    inputs.append(path)
        for param in self.params:
            path = ctx.params[str(param.name)]
            if isinstance(param.type, Output) and path is not None:
                param.type.check(path, inputs)
        return super().invoke(ctx)


def _paths(value: object, kind: Input) -> Iterator[Path]:
    """Every path in the value of an option that may be given several times."""
    if isinstance(value, Path) or (isinstance(value, str) and not kind.names):
        yield Path(value)
    elif isinstance(value, tuple):
        for item in value:
            yield from _paths(item, kind)


command = functools.partial(click.command, cls=Command)
option = functools.partial(click.option, show_default=True)
"""Declare an option whose help states its default, if it has one."""

capture_argument = click.argument("capture", type=INPUT)
model_option = option("--model", type=MODEL, default="per_material")
SCENE_HELP = "Named set-up or scene file; by default the set-up that the capture names."
scene_option = option("--scene", type=SCENE, metavar="NAME|FILE", help=SCENE_HELP)
prior_option = option(
    "--prior", "priors", type=Assignment(is_named=True), multiple=True,
    metavar="NAME=DISTRIBUTION", help="Such as 'angle_zero=Normal(0,3)'; once per parameter.",
)  # fmt: skip
link_option = option(
    "--link", "links", type=Assignment(is_named=False), multiple=True, metavar="[VARIABLE=]LINK",
    help="Such as 'q=StokesLink(degrees_of_freedom=4)'; once per variable.",
)  # fmt: skip


known_option = option(
    "--known", type=Assignment(is_named=True, is_number=True), multiple=True,
    metavar="NAME=UNCERTAINTY", callback=lambda ctx, param, value: dict(value),
    help="What an input quantity is known to, such as --known light_zenith=0.2; once for each.",
)  # fmt: skip
view_limit_option = option(
    "--largest-view-zenith", type=click.FloatRange(0.0, 90.0, min_open=True),
    help="Set aside views beyond it [degrees].",
)  # fmt: skip


def all_of(*options: Callable) -> Callable:
    """Combine several options into one decorator."""
    return lambda function: functools.reduce(
        lambda inner, each: each(inner), options[::-1], function
    )


scene_options = all_of(scene_option, prior_option, link_option, view_limit_option)
"""Options of every command that fits a scene."""


NUTS_OPTIONS = {
    name: option(f"--{name.replace('_', '-')}", type=kind, help=f"{words} Of --method nuts.")
    for name, kind, words in (
        ("warmup", int, "Draws that adapt the sampler, per chain."),
        ("most_draws", int, "Draws kept at most, per chain."),
        ("target_acceptance", float, "Higher means smaller steps."),
        ("max_tree_depth", int, "A trajectory has at most 2 to this power steps."),
    )
}
nuts_options = all_of(*NUTS_OPTIONS.values())
"""What messages recommend where chains have not converged."""


def with_nuts_options(settings: dict[str, Any]) -> dict[str, Any]:
    """Return the settings of a fit with those of its sampler inside the method."""
    given = {name: settings.pop(name) for name in NUTS_OPTIONS}
    given = {name: value for name, value in given.items() if value is not None}
    if given:
        method = settings["method"]
        if method == "nuts" or (method == FIT_DEFAULT and not is_given("method")):
            method = pb.methods.Nuts()
        if not isinstance(method, pb.methods.Nuts):
            flags = ", ".join(f"--{name.replace('_', '-')}" for name in given)
            raise click.UsageError(f"{flags}: of --method nuts only")
        settings["method"] = dataclasses.replace(method, **given)
    return settings


def is_given(name: str) -> bool:
    """Return whether the user gave an option, or its default is used."""
    source = click.get_current_context().get_parameter_source(name)
    return source is not ParameterSource.DEFAULT


seed_option = option("--seed", type=click.IntRange(0, 2**32 - 1), default=0)
scheduler_option = option(
    "--scheduler", help="Address of a dask.distributed scheduler; default: threads."
)
json_option = option("--json", "as_json", is_flag=True, help="Print the tables as JSON.")


def out_option(kind: Output, help_text: str, **settings: Any) -> Any:
    """Declare the option --out, required unless it has a default."""
    return option("--out", type=kind, help=help_text, **{"required": True, **settings})


# --- Scenes, priors, links and methods as values --------------------------------------------------


def read_scene_options(settings: dict[str, Any]) -> dict[str, Any]:
    """Return the options of a command, with texts and scene files replaced by values.

    What is given on the command line counts more than what the file says.
    """
    from polar_bayes.priors import parse_prior
    from polar_bayes.scenes.scene_file import load_scene, parse_link, parse_method

    found, stated = dict(settings), {}
    if isinstance(found.get("scene"), Path):
        stated = load_scene(found["scene"])
        found["scene"] = stated.pop("scene", None)
    for name in ("model", "method", "largest_view_zenith"):
        if name in stated and name in found and not is_given(name):
            found[name] = stated[name]
    if isinstance(found.get("method"), str):
        found["method"] = parse_method(found["method"], "--method")
    if "priors" in found:
        given = {n: parse_prior(text, f"--prior {n}={text}") for n, text in found["priors"]}
        found["priors"] = {**stated.get("priors", {}), **given} or None
    texts = found.pop("links", ())
    links = {name: parse_link(text, f"--link {text}") for name, text in texts}
    if "" in links and len(links) > 1:
        raise click.UsageError("--link without a variable stands for all: give it once")
    found["links"] = links.get("") or links or stated.get("links")
    return found
