"""Commands that fit, and show what was found."""

import json
from pathlib import Path
from typing import Any

import click

import polar_bayes as pb
from polar_bayes.cli.options import (
    FIT_METHOD,
    FOLDER,
    INPUT,
    MODEL,
    NOT_CONVERGED,
    RESULT_FILE,
    SCENE,
    STORE,
    command,
    print_table,
    status,
)
from polar_bayes.paths import written
from polar_bayes.progress import stages

DEMO = "polar-bayes demo"
"""Attribute of the capture of a demo, by which the next one knows its folder."""


@command()
@click.option(
    "--out", type=FOLDER, default=Path("polar-bayes-demo"),
    show_default=True, help="Folder to write.",
)  # fmt: skip
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=0, show_default=True)
def demo(out: Path, seed: int) -> int:
    """Capture, fit, diagnostics and report of an embedded example."""
    _make_folder(out)
    capture = pb.simulate("plastic", seed=seed).assign_attrs(made_by=DEMO)
    pb.save_capture(capture, out / "capture.nc")
    with stages() as progress:
        result = pb.fit(capture, seed=seed, progress=progress)
        pb.save_result(result, out / "fit.nc")
        progress("writing the report", 0.0)
        page = pb.report(result, out / "report")
        progress("writing the report", 1.0)
    print_table(result)
    click.echo(f"report: {page}")
    return status(result)


@command()
@click.argument("capture", type=INPUT)
@click.option("--out", type=RESULT_FILE, required=True, help="Result to write.")
@click.option("--model", type=MODEL, default="per_material", show_default=True)
@click.option(
    "--method", type=FIT_METHOD, default="nuts", show_default=True,
    help="point, laplace, importance, tempered, nuts, or auto: the cheapest that is good enough.",
)  # fmt: skip
@click.option("--seconds", type=float, help="Of --method auto; 60 by default.")
@click.option("--scene", type=SCENE, help="Named scene; by default the one that the capture names.")
@click.option("--largest-view-zenith", type=float, help="Set aside views beyond it [degrees].")
@click.option("--choose-effects", "choose", is_flag=True, help="Fit what `effects` would keep.")
@click.option("--tolerance", type=float, help="Of --choose-effects and --method auto; 0.1 sd.")
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
    is_auto = settings["method"] == "auto"
    if tolerance is not None and not (choose or is_auto):
        raise click.UsageError("--tolerance needs --choose-effects or --method auto")
    if settings["seconds"] is not None and not is_auto:
        raise click.UsageError("--seconds needs --method auto")
    data = pb.load_capture(capture)
    with stages() as progress:
        if choose:
            data = _in_setup(data, scene)
            options = {key: settings[key] for key in ("model", "largest_view_zenith", "seed")}
            options |= {} if tolerance is None else {"tolerance": tolerance}
            scene = pb.choose_effects(data, progress=progress, **options)
            click.echo(pb.effects.ledger_sentence(scene.ledger), err=True)
        wish: dict[str, Any] = {"tolerance": tolerance} if is_auto else {}
        result = pb.fit(data, scene=scene, progress=progress, **wish, **settings)
    pb.save_result(result, out)
    for sentence in pb.inference.auto_sentences(result):
        click.echo(sentence, err=True)
    if as_json:
        click.echo(json.dumps(pb.diagnostics.json_summary(result), indent=2, allow_nan=False))
    else:
        print_table(result)
    return status(result)


@command(name="map")
@click.argument("capture", type=INPUT)
@click.option("--out", type=STORE, required=True, help="Zarr store to write.")
@click.option("--model", type=MODEL, default="per_material", show_default=True)
@click.option("--scene", type=SCENE, help="Named scene; by default the one that the capture names.")
@click.option("--largest-view-zenith", type=float, help="Set aside views beyond it [degrees].")
@click.option(
    "--method",
    type=click.Choice(("laplace", "tempered")),
    default="laplace",
    show_default=True,
    help="One mode of each pixel, corrected; or all modes, many times slower.",
)
@click.option("--draws", type=int, help="Of laplace, weighted, in each pixel.  [default: 256]")
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=0, show_default=True)
@click.option("--precision", default="double", show_default=True, help="double or single.")
@click.option("--scheduler", help="Address of a dask.distributed scheduler; default: threads.")
@click.option("--resume", is_flag=True, help="Go on with a map that was broken off.")
def map_(capture: Path, out: Path, method: str, draws: int | None, **settings: Any) -> None:
    """Fit every pixel of an image."""
    if draws is not None and method != "laplace":
        raise click.UsageError("--draws needs --method laplace")
    asked: dict[str, Any] = {} if draws is None else {"draws": draws}
    chosen = (
        pb.methods.PixelLaplace(**asked) if method == "laplace" else pb.methods.PixelTempering()
    )
    maps = pb.maps.map_file(capture, out, method=chosen, **settings)
    counts = ", ".join(
        f"{count} {what}" for what, count in pb.maps.count_pixels(maps).items() if count
    )
    click.echo(f"{out}: {counts}")


@command()
@click.argument("capture", type=INPUT)
@click.option(
    "--scene", type=SCENE, help="Named set-up; by default the one that the capture names."
)
@click.option("--tolerance", type=float, default=0.1, show_default=True, help="Posterior sd.")
@click.option("--keep", multiple=True, help="Effect that stays; give it once per effect.")
@click.option("--drop", multiple=True, help="Effect that goes; give it once per effect.")
@click.option("--largest-view-zenith", type=float, help="Set aside views beyond it [degrees].")
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=0, show_default=True)
@click.option("--json", "as_json", is_flag=True, help="Print the ledger as JSON.")
@click.option("--out", type=RESULT_FILE, help="Ledger to write.")
def effects(
    capture: Path, scene: str | None, as_json: bool, out: Path | None, **settings: Any
) -> None:
    """What each effect changes and costs; which of them this capture can see."""
    data = _in_setup(pb.load_capture(capture), scene)
    with stages() as progress:
        ledger: Any = pb.choose_effects(data, progress=progress, **settings).ledger
    if out is not None:
        pb.save_result(ledger, out)
    if as_json:
        click.echo(json.dumps(pb.effects.ledger_summary(ledger), indent=2, allow_nan=False))
    else:
        click.echo(f"{pb.effects.ledger_table(ledger)}\n\n{pb.effects.ledger_sentence(ledger)}")


@command()
@click.argument("fit", type=INPUT)
@click.option("--out", type=FOLDER, required=True, help="Folder to write.")
@click.option("--truth", type=INPUT, help="Of a map: its simulated capture.")
@click.option(
    "--uncorrected", type=INPUT,
    help="With --truth: the same map without weights, to stand beside.",
)  # fmt: skip
@click.option(
    "--beside", type=INPUT, multiple=True,
    help="Of a calibration: another of the same layout; give it once for each.",
)  # fmt: skip
def report(
    fit: Path, out: Path, truth: Path | None, uncorrected: Path | None, beside: tuple[Path, ...]
) -> None:
    """Write the standardized report of a fit, calibration, accuracy study, or map (.zarr)."""
    others: dict[str, Any] = {
        "truth": None if truth is None else pb.maps.open_capture(truth),
        "uncorrected": None if uncorrected is None else pb.maps.open_map(uncorrected),
        "beside": _by_name(beside) or None,
    }
    page = pb.report(_opened(fit), out, **others)
    click.echo(f"report: {page}")


@command()
@click.argument("fits", type=INPUT, nargs=-1, required=True)
@click.option("--out", type=FOLDER, required=True, help="Folder to write.")
def compare(fits: tuple[Path, ...], out: Path) -> int:
    """Put fits of one capture side by side: predictions, parameters, and what the priors did."""
    if len({path.stem for path in fits}) < len(fits):
        raise click.UsageError("two of the files have the same name")
    results = {path.stem: pb.load_result(path) for path in fits}
    comparison = pb.diagnostics.compare_fits(results)
    page = pb.report(results, out)
    if not comparison.loo.empty:
        shown = comparison.loo.rename(columns={"elpd_diff": "difference", "dse": "error"})
        click.echo(shown.to_string(float_format=lambda x: f"{x:.4g}") + "\n")
    for sentence in pb.reporting.comparison_of_fits_sentences(comparison):
        click.echo(sentence)
    click.echo(f"report: {page}")
    good = all(verdict.converged for verdict in comparison.verdicts.values())
    return 0 if good else NOT_CONVERGED


def _in_setup(capture: Any, setup: str | None) -> Any:
    """The capture as if it named that set-up, so that scene, links and limits fit together."""
    return capture if setup is None else capture.assign_attrs(setup=setup)


def _make_folder(folder: Path) -> None:
    """The folder of a demo: new, empty, or that of an earlier demo."""
    with written(folder):
        folder.mkdir(parents=True, exist_ok=True)
        held = {path.name for path in folder.iterdir()}
    if not held:
        return
    made_by = ""
    if held <= {"capture.nc", "fit.nc", "report"} and "capture.nc" in held:
        made_by = pb.load_capture(folder / "capture.nc").attrs.get("made_by", "")
    if made_by != DEMO:
        raise pb.OutputError(
            "it holds files that no demo made", where=str(folder), hint="give another --out"
        )


def _by_name(paths: tuple[Path, ...]) -> dict[str, Any]:
    """Calibrations by the names of their files."""
    if len({path.stem for path in paths}) < len(paths):
        raise click.UsageError("two files of --beside have the same name")
    return {path.stem: pb.calibration.load_calibration(path) for path in paths}


def _opened(path: Path) -> Any:
    """A map, an accuracy study, a calibration or a fit."""
    if path.suffix == ".zarr":
        return pb.maps.open_map(path)
    if pb.benchmark.holds_accuracy(path):
        return pb.benchmark.load_accuracy(path)
    return (
        pb.calibration.load_calibration(path)
        if pb.calibration.holds_calibration(path)
        else pb.load_result(path)
    )


COMMANDS = (demo, fit, map_, effects, report, compare)
