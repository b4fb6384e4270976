"""Types of options, and what they refuse before anything is computed and before JAX is loaded."""

import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any, override

import click

import polar_bayes as pb
from polar_bayes.errors import CaptureError, FitError, OutputError, PolarBayesError, SceneError
from polar_bayes.paths import as_path, check_output, refuse_inputs


class Name(click.ParamType):
    """One of the names of a table of the package, which is not loaded to know them."""

    name = "text"

    def __init__(self, kind: str, names: tuple[str, ...], error: type[PolarBayesError]) -> None:
        self.kind, self.names, self.error = kind, names, error

    @override
    def convert(self, value: Any, param: Any, ctx: Any) -> str:
        if value not in self.names:
            option = param.name.rstrip("s")
            raise self.error(
                f"no such {self.kind}",
                where=f"{option}={value!r}",
                hint=f"give one of {', '.join(self.names)}",
            )
        return str(value)


MODEL = Name("model", ("per_material", "hierarchical", "gp_spectral"), FitError)
SCENE = Name("scene", ("paper", "camera", "picture", "goniometer"), SceneError)
MATERIAL = Name("material", ("leaf", "fruit", "plastic", "coating", "glass", "water"), CaptureError)
FIT_METHOD = Name(
    "method", ("nuts", "laplace", "point", "importance", "tempered", "auto"), FitError
)
CALIBRATION_METHOD = Name("method", ("laplace", "importance", "tempered", "nuts"), FitError)
RUNG = Name(
    "rung",
    (
        *("point", "laplace", "importance", "tempered", "normal guide", "flow guide"),
        *("nuts short", "nuts", "nuts long"),
    ),
    FitError,
)


class Input(click.ParamType):
    """The path of a file or folder that is read; `check` says that it must be there."""

    name = "path"

    def __init__(self, *, is_path: bool = True) -> None:
        self.is_path = is_path

    @override
    def convert(self, value: Any, param: Any, ctx: Any) -> Path | str:
        return as_path(value, param.opts[0]) if self.is_path else str(value)

    def check(self, path: Path) -> None:
        """Refuse what is not there, unless it may be the name of a column."""
        if self.is_path and not path.exists():
            what = "store" if path.suffix == ".zarr" else "file"
            raise CaptureError(f"there is no such {what}", where=str(path), hint="check the path")


class Output(click.ParamType):
    """The path of an output; it is checked when all inputs are known."""

    # A folder or store, of no `kind`, is checked further by what writes it.

    name = "path"

    def __init__(self, kind: str | None = None) -> None:
        self.kind = kind

    @override
    def convert(self, value: Any, param: Any, ctx: Any) -> Path:
        return as_path(value, param.opts[0], OutputError)

    def check(self, path: Path, inputs: list[Path]) -> None:
        """Refuse what must not be written."""
        if self.kind is None:
            refuse_inputs(path, inputs)
            return
        from polar_bayes.capture.files import is_capture, is_result

        kinds = {"capture": is_capture, "result": is_result}
        check_output(path, kinds[self.kind], inputs)


INPUT, COLUMN_OR_INPUT = Input(), Input(is_path=False)
CAPTURE_FILE, RESULT_FILE, FOLDER, STORE = Output("capture"), Output("result"), Output(), Output()


class Command(click.Command):
    """A command whose inputs and outputs are checked before it begins."""

    @override
    def invoke(self, ctx: click.Context) -> Any:
        inputs = []
        for param in self.params:
            for kind in _inputs(param.type):
                for path in _paths(ctx.params[str(param.name)]):
                    kind.check(path)
                    inputs.append(path)
        for param in self.params:
            path = ctx.params[str(param.name)]
            if isinstance(param.type, Output) and path is not None:
                param.type.check(path, inputs)
        return super().invoke(ctx)


command = functools.partial(click.command, cls=Command)


def _inputs(kind: click.ParamType) -> list[Input]:
    """The types of an option that are paths to read."""
    parts = kind.types if isinstance(kind, click.Tuple) else [kind]
    return [part for part in parts if isinstance(part, Input)]


def _paths(value: Any) -> Iterator[Path]:
    """Every path in the value of an option that may be given several times."""
    if isinstance(value, str | Path):
        yield Path(value)
    elif isinstance(value, tuple):
        for each in value:
            yield from _paths(each)


# --- What commands print: tables and counts -------------------------------------------------------


NOT_CONVERGED = 2
"""Exit status of a fit whose diagnostics fail."""


def status(result: Any) -> int:
    """Exit status of a fit; its problems and cautions go to the error stream."""
    verdict = pb.verdict(result)
    for problem in verdict.problems:
        click.echo(f"problem: {problem}", err=True)
    for caution in verdict.cautions:
        click.echo(f"caution: {caution}", err=True)
    return 0 if verdict.converged else NOT_CONVERGED


def print_table(result: Any) -> None:
    """A row per parameter."""
    rows = pb.diagnostics.json_summary(result)["parameters"]
    columns = ("mean", "sd", "q2.5", "q97.5", "r_hat", "ess_bulk")
    titles = ("mean", "sd", "2.5%", "97.5%", "R-hat", "ESS")
    width = max(map(len, rows))
    click.echo(" " * width + "".join(f"{title:>10}" for title in titles))
    for name, row in rows.items():
        cells = [row[column] for column in columns]
        texts = ["-" if cell is None else f"{cell:.4g}" for cell in cells[:4]]
        texts += ["-" if cells[4] is None else f"{cells[4]:.3f}"]
        texts += ["-" if cells[5] is None else f"{cells[5]:.0f}"]
        click.echo(f"{name:<{width}}" + "".join(f"{text:>10}" for text in texts))


def print_counts(capture: Any, out: Path) -> None:
    """What a capture holds, in one line."""
    counts = ", ".join(f"{number} {what}" for what, number in pb.capture.count(capture).items())
    click.echo(f"{out}: {counts}")


def print_masked(capture: Any) -> None:
    """Why readings of a picture are masked, in one line; nothing where none is."""
    reasons = {
        str(name).removeprefix("masked_").replace("_", " "): int(number)
        for name, number in capture.attrs.items()
        if str(name).startswith("masked_") and number
    }
    if reasons:
        told = ", ".join(f"{number} {reason}" for reason, number in reasons.items())
        click.echo(f"masked: {told}")
