"""The command line: it parses, calls the Python interface and prints.

Exit status: 0 done; 1 the input or the options are wrong (one line: where, what, the mend); 2 the
fit ran but its diagnostics fail, with the result still written.
"""

import json
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click
import platformdirs
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskProgressColumn,
    TimeRemainingColumn,
)

import polar_bayes as pb

NOT_CONVERGED = 2


def main(arguments: list[str] | None = None) -> int:
    """Run one command.

    Args:
        arguments: Words after the program's name; those of the process by default.

    Returns:
        The exit status.
    """
    _remember_compiled_programs()
    try:
        status = commands.main(arguments, prog_name="polar-bayes", standalone_mode=False)
    except click.exceptions.Abort:
        click.echo("polar-bayes: stopped", err=True)
        return 130
    except click.ClickException as error:
        context = getattr(error, "ctx", None)
        where = context.command_path if context else "polar-bayes"
        line = " ".join(error.format_message().split())
        click.echo(f"{where}: {line} (see `{where} --help`)", err=True)
        return 1
    except pb.PolarBayesError as error:
        click.echo(str(error), err=True)
        return 1
    return int(status or 0)


def _remember_compiled_programs() -> None:
    """Keep compiled programs between runs; a second run of the same fit compiles nothing."""
    cache = platformdirs.user_cache_path("polar_bayes") / "compiled"
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="polar_bayes")
def commands() -> None:
    """From polarization captures to calibrated posteriors of layered dielectrics."""


@commands.command()
@click.option(
    "--out", type=click.Path(path_type=Path), default=Path("polar-bayes-demo"),
    show_default=True, help="Folder to write.",
)  # fmt: skip
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=0, show_default=True)
def demo(out: Path, seed: int) -> int:
    """Capture, fit, diagnostics and report of an embedded example."""
    _make_folder(out)
    capture = pb.simulate("plastic", seed=seed)
    pb.save_capture(capture, out / "capture.nc")
    with _progress() as progress:
        result = pb.fit(capture, seed=seed, progress=progress)
        pb.save_result(result, out / "fit.nc")
        progress("writing the report", 0.0)
        page = pb.report(result, out / "report")
        progress("writing the report", 1.0)
    _print_table(result)
    click.echo(f"report: {page}")
    return _status(result)


@commands.command()
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Capture to write.")
@click.option("--preset", default="leaf", show_default=True, help="Material to simulate.")
@click.option("--scene", default="paper", show_default=True, help="Named scene to simulate.")
@click.option("--views", type=int, default=40, show_default=True)
@click.option("--largest-view-zenith", type=float, default=85.0, show_default=True, help="Degrees.")
@click.option(
    "--wavelength", "wavelengths", type=float, multiple=True, default=(450.0, 550.0, 650.0),
    show_default=True, help="Nanometers; give it once per wavelength.",
)  # fmt: skip
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=0, show_default=True)
def simulate(
    out: Path,
    preset: str,
    scene: str,
    views: int,
    largest_view_zenith: float,
    wavelengths: tuple[float, ...],
    seed: int,
) -> None:
    """Draw a capture of a known material, by the paper's protocol."""
    protocol = pb.Protocol(
        views=views, largest_view_zenith=largest_view_zenith, wavelengths=wavelengths
    )
    capture = pb.simulate(preset, scene=scene, protocol=protocol, seed=seed)
    pb.save_capture(capture, out)
    _print_counts(capture, out)


@commands.group(name="import")
def import_() -> None:
    """Turn raw measurements into a capture."""


@import_.command()
@click.option("--s", "s", required=True, help="Table of s readings, or column name in --table.")
@click.option("--p", "p", required=True, help="Table of p readings, or column name in --table.")
@click.option("--table", type=click.Path(path_type=Path), help="One table with both channels.")
@click.option("--angle", help="Column of --table with the angle of incidence in degrees.")
@click.option("--s-incident", type=float, help="Reading of the incident beam, s.")
@click.option("--p-incident", type=float, help="Reading of the incident beam, p.")
@click.option("--dark-level", type=float, default=0.0, show_default=True, help="Without light.")
@click.option("--s-error", type=float, help="Absolute error of an s reading.")
@click.option("--p-error", type=float, help="Absolute error of a p reading.")
@click.option("--relative-error", type=float, default=0.01, show_default=True)
@click.option("--wavelength", type=float, help="Nanometers.")
@click.option("--name", help="Name of the sample.")
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Capture to write.")
def goniometer(s: str, p: str, table: Path | None, out: Path, **settings: Any) -> None:
    """Tables of s and p readings against the angle of incidence, together or apart."""
    capture = pb.from_goniometer(s, p, table=table, **settings)
    pb.save_capture(capture, out)
    _print_counts(capture, out)


@commands.command()
@click.argument("captures", type=click.Path(path_type=Path), nargs=-1, required=True)
@click.option("--dim", default="material", show_default=True, help="material or patch.")
@click.option("--drop", multiple=True, help="Variable to leave out; give it once per variable.")
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Capture to write.")
def combine(captures: tuple[Path, ...], dim: str, drop: tuple[str, ...], out: Path) -> None:
    """Put captures side by side, to be fitted together; each is labeled by its name."""
    named: dict[str, Any] = {}
    for path in captures:
        capture = pb.load_capture(path)
        label = str(capture.attrs["name"])
        if label in named:
            raise pb.CaptureError(
                f"a capture named {label} is there already",
                where=str(path),
                mend="import or simulate one of the two again under another --name or file name",
            )
        named[label] = capture
    capture = pb.combine(named, dim=dim, drop=drop)
    pb.save_capture(capture, out)
    _print_counts(capture, out)


@commands.command()
@click.argument("capture", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Result to write.")
@click.option("--model", default="per_material", show_default=True)
@click.option("--method", default="nuts", show_default=True, help="nuts, laplace or point.")
@click.option("--scene", help="Named scene; by default the one that the capture names.")
@click.option("--largest-view-zenith", type=float, help="Set aside views beyond it [degrees].")
@click.option("--choose-effects", "choose", is_flag=True, help="Fit what `effects` would keep.")
@click.option("--tolerance", type=float, help="Of --choose-effects; 0.1 posterior sd by default.")
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=0, show_default=True)
@click.option("--json", "as_json", is_flag=True, help="Print the table as JSON.")
def fit(
    capture: Path,
    out: Path,
    as_json: bool,
    choose: bool,
    tolerance: float | None,
    scene: Any,
    **settings: Any,
) -> int:
    """Fit a capture; prints a row per parameter and writes everything to --out."""
    if tolerance is not None and not choose:
        raise click.UsageError("--tolerance needs --choose-effects")
    data = pb.load_capture(capture)
    _check_writable(out)
    with _progress() as progress:
        if choose:
            data = _in_setup(data, scene)
            options = {key: settings[key] for key in ("model", "largest_view_zenith", "seed")}
            options |= {} if tolerance is None else {"tolerance": tolerance}
            scene = pb.choose_effects(data, progress=progress, **options)
            click.echo(pb.ledger_sentence(scene.ledger), err=True)
        result = pb.fit(data, scene=scene, progress=progress, **settings)
    pb.save_result(result, out)
    if as_json:
        click.echo(json.dumps(pb.json_summary(result), indent=2, allow_nan=False))
    else:
        _print_table(result)
    return _status(result)


@commands.command(name="map")
@click.argument("capture", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Zarr store to write.")
@click.option("--model", default="per_material", show_default=True)
@click.option("--scene", help="Named scene; by default the one that the capture names.")
@click.option("--largest-view-zenith", type=float, help="Set aside views beyond it [degrees].")
@click.option("--draws", type=int, default=256, show_default=True, help="Weighted, in each pixel.")
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=0, show_default=True)
@click.option("--precision", default="double", show_default=True, help="double or single.")
@click.option("--scheduler", help="Address of a dask.distributed scheduler; default: threads.")
@click.option("--resume", is_flag=True, help="Go on with a map that was broken off.")
def map_(capture: Path, out: Path, draws: int, **settings: Any) -> None:
    """Fit every pixel of an image."""
    with _pixels_bar() as progress:
        method = pb.PixelLaplace(draws=draws)
        maps = pb.map_file(capture, out, method=method, progress=progress, **settings)
    counts = ", ".join(f"{count} {what}" for what, count in pb.count_pixels(maps).items() if count)
    click.echo(f"{out}: {counts}")


@commands.command()
@click.argument("capture", type=click.Path(path_type=Path))
@click.option("--scene", help="Named set-up; by default the one that the capture names.")
@click.option("--tolerance", type=float, default=0.1, show_default=True, help="Posterior sd.")
@click.option("--keep", multiple=True, help="Effect that stays; give it once per effect.")
@click.option("--drop", multiple=True, help="Effect that goes; give it once per effect.")
@click.option("--largest-view-zenith", type=float, help="Set aside views beyond it [degrees].")
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=0, show_default=True)
@click.option("--json", "as_json", is_flag=True, help="Print the ledger as JSON.")
@click.option("--out", type=click.Path(path_type=Path), help="Ledger to write.")
def effects(
    capture: Path, scene: str | None, as_json: bool, out: Path | None, **settings: Any
) -> None:
    """What each effect changes and costs; which of them this capture can see."""
    data = _in_setup(pb.load_capture(capture), scene)
    if out is not None:
        _check_writable(out)
    with _progress() as progress:
        ledger = pb.choose_effects(data, progress=progress, **settings).ledger
    if out is not None:
        pb.save_result(ledger, out)
    if as_json:
        click.echo(json.dumps(pb.ledger_summary(ledger), indent=2, allow_nan=False))
    else:
        click.echo(f"{pb.ledger_table(ledger)}\n\n{pb.ledger_sentence(ledger)}")


@commands.command()
@click.argument("fit", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder to write.")
@click.option("--truth", type=click.Path(path_type=Path), help="Of a map: its simulated capture.")
@click.option(
    "--uncorrected", type=click.Path(path_type=Path),
    help="With --truth: the same map without weights, to stand beside.",
)  # fmt: skip
def report(fit: Path, out: Path, truth: Path | None, uncorrected: Path | None) -> None:
    """Write the standardized report of a fit, or of a map (a folder that ends in .zarr)."""
    is_map = fit.suffix == ".zarr"
    beside = {
        "truth": None if truth is None else pb.open_capture(truth),
        "uncorrected": None if uncorrected is None else pb.open_map(uncorrected),
    }
    page = pb.report(pb.open_map(fit) if is_map else pb.load_result(fit), out, **beside)
    click.echo(f"report: {page}")


def _in_setup(capture: Any, setup: str | None) -> Any:
    """The capture as if it named that set-up, so that scene, links and limits fit together."""
    return capture if setup is None else capture.assign_attrs(setup=setup)


def _status(result: Any) -> int:
    verdict = pb.verdict(result)
    for problem in verdict.problems:
        click.echo(f"problem: {problem}", err=True)
    for caution in verdict.cautions:
        click.echo(f"caution: {caution}", err=True)
    return 0 if verdict.converged else NOT_CONVERGED


def _print_table(result: Any) -> None:
    rows = pb.json_summary(result)["parameters"]
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


def _print_counts(capture: Any, out: Path) -> None:
    counts = ", ".join(f"{number} {what}" for what, number in pb.count(capture).items())
    click.echo(f"{out}: {counts}")


@contextmanager
def _progress() -> Iterator[Callable[[str, float], None]]:
    """One bar per stage on the error stream; silent where that is not a terminal."""
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bars:
        tasks: dict[str, Any] = {}

        def progress(stage: str, fraction: float) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=1.0)
            bars.update(tasks[stage], completed=fraction)

        yield progress


@contextmanager
def _pixels_bar() -> Iterator[Callable[[int, int], None]]:
    """Pixels done, pixels a second and the time that is left, where there is a terminal."""
    console = Console(stderr=True)
    columns = (
        BarColumn(),
        MofNCompleteColumn(),
        TaskProgressColumn("pixels", show_speed=True),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, disable=not console.is_terminal) as bars:
        task = bars.add_task("pixels", total=None)
        yield lambda done, every: bars.update(task, completed=done, total=every)


def _check_writable(path: Path) -> None:
    """Refuse a place that cannot be written before minutes are spent, not after."""
    try:
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise pb.FitError(
            f"cannot write there ({error.strerror})",
            where=str(path),
            mend="give --out in a folder that exists and is writable",
        ) from error


def _make_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise pb.FitError(
            f"cannot make the folder ({error.strerror})", where=str(path), mend="give another --out"
        ) from error
    _check_writable(path / "capture.nc")


if __name__ == "__main__":
    sys.exit(main())
