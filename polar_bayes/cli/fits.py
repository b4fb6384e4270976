"""Commands that fit, and show what was found."""

import json
from pathlib import Path
from typing import Any

import click

import polar_bayes as pb
from polar_bayes.cli.places import check_writable, in_setup, make_folder
from polar_bayes.cli.printing import NOT_CONVERGED, print_table, status
from polar_bayes.progress import stages


@click.command()
@click.option(
    "--out", type=click.Path(path_type=Path), default=Path("polar-bayes-demo"),
    show_default=True, help="Folder to write.",
)  # fmt: skip
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=0, show_default=True)
def demo(out: Path, seed: int) -> int:
    """Capture, fit, diagnostics and report of an embedded example."""
    make_folder(out)
    capture = pb.simulate("plastic", seed=seed)
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


@click.command()
@click.argument("capture", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Result to write.")
@click.option("--model", default="per_material", show_default=True)
@click.option(
    "--method", default="nuts", show_default=True,
    help="point, laplace, importance, tempered, nuts, or auto: the cheapest that is good enough.",
)  # fmt: skip
@click.option("--seconds", type=float, help="Of --method auto; 60 by default.")
@click.option("--scene", help="Named scene; by default the one that the capture names.")
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
    check_writable(out)
    with stages() as progress:
        if choose:
            data = in_setup(data, scene)
            options = {key: settings[key] for key in ("model", "largest_view_zenith", "seed")}
            options |= {} if tolerance is None else {"tolerance": tolerance}
            scene = pb.choose_effects(data, progress=progress, **options)
            click.echo(pb.ledger_sentence(scene.ledger), err=True)
        wish: dict[str, Any] = {"tolerance": tolerance} if is_auto else {}
        result = pb.fit(data, scene=scene, progress=progress, **wish, **settings)
    pb.save_result(result, out)
    for sentence in pb.auto_sentences(result):
        click.echo(sentence, err=True)
    if as_json:
        click.echo(json.dumps(pb.json_summary(result), indent=2, allow_nan=False))
    else:
        print_table(result)
    return status(result)


@click.command(name="map")
@click.argument("capture", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Zarr store to write.")
@click.option("--model", default="per_material", show_default=True)
@click.option("--scene", help="Named scene; by default the one that the capture names.")
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
    asked = {} if draws is None else {"draws": draws}
    chosen = pb.PixelLaplace(**asked) if method == "laplace" else pb.PixelTempering()
    maps = pb.map_file(capture, out, method=chosen, **settings)
    counts = ", ".join(f"{count} {what}" for what, count in pb.count_pixels(maps).items() if count)
    click.echo(f"{out}: {counts}")


@click.command()
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
    data = in_setup(pb.load_capture(capture), scene)
    if out is not None:
        check_writable(out)
    with stages() as progress:
        ledger = pb.choose_effects(data, progress=progress, **settings).ledger
    if out is not None:
        pb.save_result(ledger, out)
    if as_json:
        click.echo(json.dumps(pb.ledger_summary(ledger), indent=2, allow_nan=False))
    else:
        click.echo(f"{pb.ledger_table(ledger)}\n\n{pb.ledger_sentence(ledger)}")


@click.command()
@click.argument("fit", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder to write.")
@click.option("--truth", type=click.Path(path_type=Path), help="Of a map: its simulated capture.")
@click.option(
    "--uncorrected", type=click.Path(path_type=Path),
    help="With --truth: the same map without weights, to stand beside.",
)  # fmt: skip
@click.option(
    "--beside", type=click.Path(path_type=Path), multiple=True,
    help="Of a calibration: another of the same layout; give it once for each.",
)  # fmt: skip
def report(
    fit: Path, out: Path, truth: Path | None, uncorrected: Path | None, beside: tuple[Path, ...]
) -> None:
    """Write the standardized report of a fit, calibration, accuracy study, or map (.zarr)."""
    others = {
        "truth": None if truth is None else pb.open_capture(truth),
        "uncorrected": None if uncorrected is None else pb.open_map(uncorrected),
        "beside": _by_name(beside) or None,
    }
    page = pb.report(_opened(fit), out, **others)
    click.echo(f"report: {page}")


@click.command()
@click.argument("fits", type=click.Path(path_type=Path), nargs=-1, required=True)
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder to write.")
def compare(fits: tuple[Path, ...], out: Path) -> int:
    """Put fits of one capture side by side: predictions, parameters, and what the priors did."""
    if len({path.stem for path in fits}) < len(fits):
        raise click.UsageError("two of the files have the same name")
    results = {path.stem: pb.load_result(path) for path in fits}
    comparison = pb.compare_fits(results)
    page = pb.report(results, out)
    if not comparison.loo.empty:
        shown = comparison.loo.rename(columns={"elpd_diff": "difference", "dse": "error"})
        click.echo(shown.to_string(float_format=lambda x: f"{x:.4g}") + "\n")
    for sentence in pb.comparison_of_fits_sentences(comparison):
        click.echo(sentence)
    click.echo(f"report: {page}")
    good = all(verdict.converged for verdict in comparison.verdicts.values())
    return 0 if good else NOT_CONVERGED


def _by_name(paths: tuple[Path, ...]) -> dict[str, Any]:
    """Calibrations by the names of their files."""
    if len({path.stem for path in paths}) < len(paths):
        raise click.UsageError("two files of --beside have the same name")
    return {path.stem: pb.load_calibration(path) for path in paths}


def _opened(path: Path) -> Any:
    """A map, an accuracy study, a calibration or a fit."""
    if path.suffix == ".zarr":
        return pb.open_map(path)
    if pb.holds_accuracy(path):
        return pb.load_accuracy(path)
    return pb.load_calibration(path) if pb.holds_calibration(path) else pb.load_result(path)


COMMANDS = (demo, fit, map_, effects, report, compare)
