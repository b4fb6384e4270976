"""Option types and options that several commands share, and what commands print.

Option types refuse wrong values before anything is computed and before JAX is loaded.
"""

import functools
import json
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, override

import click

import polar_bayes as pb
from polar_bayes.errors import CaptureError, FitError, OutputError, PolarBayesError, SceneError
from polar_bayes.paths import as_path, check_output, refuse_inputs
from polar_bayes.repr_html import Row, Table

NOT_CONVERGED = 2
"""Exit status of a fit whose diagnostics fail."""


class Name(click.ParamType):
    """A key of a registry of the package, which is not imported for this check."""

    name = "text"

    def __init__(self, kind: str, names: tuple[str, ...], error: type[PolarBayesError]) -> None:
        self.kind, self.names, self.error = kind, names, error

    @override
    def convert(self, value: Any, param: Any, ctx: Any) -> str:
        if value not in self.names:
            raise self.error(
                f"no such {self.kind}",
                where=f"{param.name.rstrip('s')}={value!r}",
                hint=f"give one of {', '.join(self.names)}",
            )
        return str(value)


MODEL = Name("model", ("per_material", "hierarchical", "gp_spectral"), FitError)
SCENE = Name("scene", ("paper", "camera", "picture", "goniometer"), SceneError)
FIT_SCENE = Name("scene", (*SCENE.names, "auto"), SceneError)
MATERIAL = Name("material", ("leaf", "fruit", "plastic", "coating", "glass", "water"), CaptureError)
FIT_METHOD = Name(
    "method", ("nuts", "laplace", "point", "importance", "tempered", "auto"), FitError
)
CALIBRATION_METHOD = Name("method", ("laplace", "importance", "tempered", "nuts"), FitError)
STUDY_METHOD = Name(
    "method",
    (
        *("point", "laplace", "importance", "tempered", "normal guide", "flow guide"),
        *("nuts short", "nuts", "nuts long"),
    ),
    FitError,
)


class Input(click.ParamType):
    """Path of a file or folder that is read; `check` refuses one that does not exist."""

    name = "path"

    def __init__(self, *, is_path: bool = True) -> None:
        self.is_path = is_path

    @override
    def convert(self, value: Any, param: Any, ctx: Any) -> Path | str:
        return as_path(value, param.opts[0]) if self.is_path else str(value)

    def check(self, path: Path) -> None:
        """Refuse a path that does not exist, unless it may be the name of a column."""
        if self.is_path and not path.exists():
            what = "store" if path.suffix == ".zarr" else "file"
            raise CaptureError(f"there is no such {what}", where=str(path), hint="check the path")


class Output(click.ParamType):
    """Path of an output; it is checked when all inputs are known."""

    # A folder or store has no `kind`; the function that writes it checks the rest.

    name = "path"

    def __init__(self, kind: str | None = None) -> None:
        self.kind = kind

    @override
    def convert(self, value: Any, param: Any, ctx: Any) -> Path:
        return as_path(value, param.opts[0], OutputError)

    def check(self, path: Path, inputs: list[Path]) -> None:
        """Refuse a path that must not be written."""
        if self.kind is None:
            refuse_inputs(path, inputs)
            return
        from polar_bayes.capture.files import is_capture, is_result

        check_output(path, is_capture if self.kind == "capture" else is_result, inputs)


INPUT, COLUMN_OR_INPUT = Input(), Input(is_path=False)
CAPTURE_FILE, RESULT_FILE, FOLDER, STORE = Output("capture"), Output("result"), Output(), Output()


class Command(click.Command):
    """A command whose inputs and outputs are checked before it begins."""

    @override
    def invoke(self, ctx: click.Context) -> Any:
        inputs = []
        for param in self.params:
            kinds = param.type.types if isinstance(param.type, click.Tuple) else [param.type]
            for kind in (kind for kind in kinds if isinstance(kind, Input)):
                for path in _paths(ctx.params[str(param.name)]):
                    kind.check(path)
                    inputs.append(path)
        for param in self.params:
            path = ctx.params[str(param.name)]
            if isinstance(param.type, Output) and path is not None:
                param.type.check(path, inputs)
        return super().invoke(ctx)


def _paths(value: Any) -> Iterator[Path]:
    """Every path in the value of an option that may be given several times."""
    if isinstance(value, str | Path):
        yield Path(value)
    elif isinstance(value, tuple):
        for item in value:
            yield from _paths(item)


command = functools.partial(click.command, cls=Command)
option = functools.partial(click.option, show_default=True)
"""An option that states its default, where it has one."""

capture_argument = click.argument("capture", type=INPUT)
model_option = option("--model", type=MODEL, default="per_material")
scene_option = option(
    "--scene", type=SCENE, help="Named set-up; by default the one that the capture names."
)
view_limit_option = option(
    "--largest-view-zenith", type=float, help="Set aside views beyond it [degrees]."
)
seed_option = option("--seed", type=click.IntRange(0, 2**32 - 1), default=0)
scheduler_option = option(
    "--scheduler", help="Address of a dask.distributed scheduler; default: threads."
)
json_option = option("--json", "as_json", is_flag=True, help="Print the tables as JSON.")


def out_option(kind: Output, help_text: str, **settings: Any) -> Any:
    """The option --out, required unless it has a default."""
    return option("--out", type=kind, help=help_text, **{"required": True, **settings})


# --- Printing -------------------------------------------------------------------------------------


def print_json(value: object) -> None:
    """Print a value as strict JSON."""
    click.echo(json.dumps(value, indent=2, allow_nan=False))


def json_rows(table: Any) -> dict[str, Any]:
    """A row of a data frame by its label, as JSON has it."""
    return json.loads(table.to_json(orient="index"))


def print_frame(frame: Any, sentences: Iterable[str] = ()) -> None:
    """Print a data frame, numbers with four digits and missing ones as -, and sentences below."""
    rows = (Row(str(label), tuple(map(_text, cells))) for label, *cells in frame.itertuples())
    click.echo(Table(("", *frame.columns), tuple(rows)).to_text(sys.stdout))
    if sentences:
        click.echo("\n".join(["", *sentences]))


def _text(cell: Any) -> str:
    if cell is None or cell != cell:  # NaN
        return "-"
    if not isinstance(cell, float):
        return str(cell)
    return f"{cell:.0f}" if 1e4 <= abs(cell) < 1e7 else f"{cell:.4g}"


def print_fit(result: Any) -> int:
    """Print a row per parameter, and the problems on the error stream; returns the exit status."""
    columns = ("mean", "sd", "q2.5", "q97.5", "r_hat", "ess_bulk")
    titles = ["mean", "sd", "2.5%", "97.5%", "R-hat", "ESS"]
    print_frame(pb.summary(result)[[*columns]].set_axis(titles, axis="columns"))
    return print_verdict(result)


def print_verdict(result: Any) -> int:
    """Print problems and cautions of a fit on the error stream; returns the exit status."""
    verdict = pb.verdict(result)
    for problem in verdict.problems:
        click.echo(f"problem: {problem}", err=True)
    for caution in verdict.cautions:
        click.echo(f"caution: {caution}", err=True)
    return 0 if verdict.passed else NOT_CONVERGED
