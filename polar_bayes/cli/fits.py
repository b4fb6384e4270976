"""Commands that fit a capture, compare scenes, and show results."""

import contextlib
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import polar_bayes as pb
from polar_bayes.cli.options import (
    FIT_METHOD,
    FIT_SCENE,
    FOLDER,
    INPUT,
    MANY_METHOD,
    RESULT_FILE,
    SCENE_FILE,
    SCENE_HELP,
    SCENE_SOURCE,
    STORE,
    capture_argument,
    command,
    is_given,
    json_option,
    known_option,
    link_option,
    model_option,
    nuts_options,
    option,
    out_option,
    prior_option,
    read_scene_options,
    scene_options,
    scheduler_option,
    seed_option,
    view_limit_option,
    with_nuts_options,
)
from polar_bayes.cli.printing import (
    NOT_CONVERGED,
    json_rows,
    print_cautions,
    print_fit,
    print_frame,
    print_json,
    print_verdict,
    say,
)
from polar_bayes.interrupts import on_interrupt
from polar_bayes.methods.registry import FIT_DEFAULT, MAP_DEFAULT
from polar_bayes.paths import write_errors
from polar_bayes.progress import Progress, notice, stages

if TYPE_CHECKING:
    from polar_bayes.results import Result

DEMO = "polar-bayes demo"
"""Attribute that marks the capture of a demo, so that the next demo recognizes its folder."""


@command()
@out_option(FOLDER, "Folder to write.", required=False, default=Path("polar-bayes-demo"))
@seed_option
def demo(out: Path, seed: int) -> int:
    """Run an embedded example: capture, fit, diagnostics and report."""
    _make_folder(out)
    capture = pb.simulate("plastic", seed=seed).assign_attrs(made_by=DEMO)
    pb.save_capture(capture, out / "capture.nc")
    with stages() as progress:
        result = pb.fit(capture, seed=seed, progress=progress)
        pb.save(result, out / "fit.nc")
        if _is_new_fit(result):
            _add_next_views(result, progress)
        progress("drawing the report", 0.0)
        page = pb.report(result, out / "report")
    status = print_fit(result)
    click.echo(f"report: {page}")
    return status


def _make_folder(folder: Path) -> None:
    """Create the folder of a demo; refuse one that holds anything but an earlier demo."""
    with write_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        names = {path.name for path in folder.iterdir()}
    if not names:
        return
    made_by = ""
    if "capture.nc" in names <= {"capture.nc", "fit.nc", "report"}:
        made_by = pb.load_capture(folder / "capture.nc").attrs.get("made_by", "")
    if made_by != DEMO:
        raise pb.OutputError(
            "it holds files that no demo made", where=str(folder), hint="give another --out"
        )


@command()
@capture_argument
@out_option(RESULT_FILE, "Result to write.")
@model_option
@option(
    "--method", type=FIT_METHOD, default=FIT_DEFAULT,
    help=f"{', '.join(FIT_METHOD.names)}; by default auto, the cheapest that is good enough.",
)  # fmt: skip
@nuts_options
@option("--seconds", type=float, help="Time limit of --method auto; of --scene auto.")
@option(
    "--scene", type=FIT_SCENE, metavar="NAME|FILE",
    help=f"{SCENE_HELP} auto: what `scenes` finds.",
)  # fmt: skip
@prior_option
@link_option
@known_option
@view_limit_option
@option("--choose-effects", "choose", is_flag=True, help="Fit what `effects` would keep.")
@option("--tolerance", type=float, help="Of --choose-effects, 0.1 sd; of --method auto.")
@seed_option
@json_option
def fit(
    capture: Path,
    out: Path,
    as_json: bool,
    choose: bool,
    tolerance: float | None,
    **settings: Any,
) -> int:
    """Fit a capture; prints a row per parameter and writes everything to --out."""
    data = pb.load_capture(capture)  # a wrong file is told before JAX is loaded
    settings = with_nuts_options(read_scene_options(settings))
    is_auto = settings["method"] == "auto"
    if tolerance is not None and not (choose or is_auto):
        raise click.UsageError("--tolerance needs --choose-effects or --method auto")
    if settings["seconds"] is not None and not (is_auto or settings["scene"] == "auto"):
        raise click.UsageError("--seconds needs --method auto or --scene auto")
    with contextlib.ExitStack() as until_compared:

        def keep(fit: Any) -> None:
            until_compared.enter_context(on_interrupt(lambda: _kept(fit, out)))
            notice("the fit is done, and is compared with other scenes now; Ctrl-C keeps the fit")

        progress = until_compared.enter_context(stages())
        if choose:
            matter = ("scene", "model", "priors", "links", "largest_view_zenith", "seed")
            options = {key: settings[key] for key in matter}
            options |= {} if tolerance is None else {"tolerance": tolerance}
            chosen: Any = pb.choose_effects(data, progress=progress, **options)
            say("\n".join(pb.verdict(chosen.ledger).sentences), err=True)
            settings["scene"] = _in_setup(chosen, settings["scene"])
        if is_auto and (is_given("method") or not choose):
            settings["tolerance"] = tolerance
        result = pb.fit(data, progress=progress, keep=keep, **settings)
    pb.save(result, out)
    told = (
        *pb.capture.inferred(data),
        *pb.inference.choice_sentences(result),
        *pb.inference.auto_sentences(result),
        *pb.scenes.scene_sentences(result),
    )
    for sentence in told:
        say(sentence, err=True)
    return print_fit(result, as_json=as_json)


def _kept(fit: Any, out: Path) -> str:
    """Write a fit whose comparisons were not finished, and return a sentence that says so."""
    pb.save(fit, out)
    return f"{out}: the fit is whole, and was not compared with other scenes to the end"


def _in_setup(chosen: Any, scene: Any) -> Any:
    """Return the chosen scene with links and limits of the set-up from which it was chosen."""
    if scene is None or isinstance(scene, pb.Scene):
        return chosen
    return dataclasses.replace(pb.setups.find_setup(scene), scene=chosen)


@command(name="map")
@capture_argument
@out_option(STORE, "Zarr store to write.")
@model_option
@scene_options
@option(
    "--method", type=MANY_METHOD, default=MAP_DEFAULT,
    help=f"{', '.join(MANY_METHOD.names)}; all others are many times slower.",
)  # fmt: skip
@option("--draws", type=int, help=f"Of {MAP_DEFAULT}, in each pixel.  [default: 256]")
@option(
    "--share", "shared", multiple=True,
    help="Noise or instrument parameter of the whole image; repeatable; none for none.  "
    "[default: those of the set-up]",
)  # fmt: skip
@known_option
@seed_option
@option("--precision", default="double", help="double or single.")
@scheduler_option
@option("--resume", is_flag=True, help="Continue an interrupted map.")
def map_(
    capture: Path,
    out: Path,
    method: str,
    draws: int | None,
    shared: tuple[str, ...],
    **settings: Any,
) -> None:
    """Fit every pixel of an image."""
    from polar_bayes.scenes.scene_file import parse_method

    if draws is not None and method != MAP_DEFAULT:
        raise click.UsageError(f"--draws needs --method {MAP_DEFAULT}")
    if "none" in shared and len(shared) > 1:
        raise click.UsageError("--share none excludes every other --share")
    settings = read_scene_options(settings)
    settings["shared"] = () if shared == ("none",) else shared or None
    chosen: Any = parse_method(method, "--method")
    if draws is not None:
        chosen = pb.methods.CorrectedLaplace(draws=draws)
    maps = pb.maps.map_file(capture, out, method=chosen, **settings)
    counts = ", ".join(
        f"{count} {what}" for what, count in pb.maps.count_pixels(maps).items() if count
    )
    click.echo(f"{out}: {counts}")
    for name, row in pb.maps.shared_parameters(maps).iterrows():
        interval = f"{row['q50']:.5g} [{row['q2.5']:.5g}, {row['q97.5']:.5g}]"
        click.echo(f"{name}: {interval} in all pixels, from {row['pixels']:.0f} of them")
    sentences = [*pb.maps.criticism_sentences(maps), *pb.maps.start_sentences(maps)]
    for sentence in (*sentences, *pb.maps.setup_sentences(maps)):
        say(sentence)
    print_cautions(pb.maps.shared_cautions(maps))


@command()
@click.argument("maps", type=INPUT)
@click.argument("labels", type=INPUT)
@option("--against", type=int, help="Region from which the others are subtracted.")
@json_option
def regions(maps: Path, labels: Path, against: int | None, as_json: bool) -> None:
    """Compute means of a map over the regions of a label image, and their differences."""
    picture = pb.maps.load_labels(labels)
    found = pb.maps.region_means(pb.maps.open_map(maps), picture, against=against)
    table, cautions = pb.maps.region_table(found), found.attrs["cautions"]
    if as_json:
        print_json({"regions": json_rows(table, "records"), "cautions": cautions})
        return
    print_frame(table.set_index("region"))
    print_cautions(cautions)


@command()
@capture_argument
@scene_options
@option("--tolerance", type=float, default=0.1, help="Posterior sd.")
@option("--keep", multiple=True, help="Effect to keep; give it once per effect.")
@option("--drop", multiple=True, help="Effect to drop; give it once per effect.")
@seed_option
@json_option
@out_option(RESULT_FILE, "Ledger to write.", required=False)
def effects(capture: Path, as_json: bool, out: Path | None, **settings: Any) -> None:
    """Show what each effect changes and costs, and which effects this capture can see."""
    data, settings = pb.load_capture(capture), read_scene_options(settings)
    with stages() as progress:
        ledger: Any = pb.choose_effects(data, progress=progress, **settings).ledger
    if out is not None:
        pb.save(ledger, out)
    if as_json:
        print_json(pb.scenes.ledger_summary(ledger))
    else:
        print_frame(pb.summary(ledger), pb.verdict(ledger).sentences)


@command()
@option(
    "--from", "source", type=SCENE_SOURCE, required=True, metavar="RESULT|NAME",
    help="A result, or the name of a set-up.",
)  # fmt: skip
@out_option(SCENE_FILE, "File to write; by default it is printed.", required=False)
def scene(source: Path | str, out: Path | None) -> None:
    """Write the scene, links, priors and method of a result as a file that --scene takes."""
    found = source if isinstance(source, str) else pb.load(source)
    try:
        if out is None:
            click.echo(pb.scenes.scene_text(found), nl=False)
        else:
            pb.save_scene(found, out)
            click.echo(f"{out}: edit it, and give it as --scene {out}")
    except (pb.SceneError, pb.FitError) as error:  # of the result, not of the file that is written
        raise error.within(str(source)) from None


@command()
@capture_argument
@out_option(RESULT_FILE, "Fit of the scenes that remain, stacked, to write.", required=False)
@model_option
@option("--method", type=FIT_METHOD, default=FIT_DEFAULT, help="Of the fit that --out writes.")
@option("--seconds", type=float, help="Of the comparison; the first scene is always fitted.")
@prior_option
@link_option
@view_limit_option
@seed_option
@json_option
def scenes(capture: Path, out: Path | None, as_json: bool, **settings: Any) -> int | None:
    """Compare scenes, from simple to complex; with --out, fit those that remain."""
    data, settings = pb.load_capture(capture), read_scene_options(settings)
    method = settings.pop("method")
    found: Any
    with stages() as progress:
        if out is None:
            found = pb.compare_scenes(data, progress=progress, **settings)
        else:
            found = pb.fit(data, scene="auto", method=method, progress=progress, **settings)
            pb.save(found, out)
    table, sentences = pb.scenes.scene_table(found), pb.scenes.scene_sentences(found)
    if as_json:
        print_json({"scenes": json_rows(table), "sentences": sentences})
        return None if out is None else print_verdict(found)
    print_frame(table, sentences)
    if out is None:
        return None
    click.echo()
    return print_fit(found)


@command()
@click.argument("fit", type=INPUT)
@out_option(FOLDER, "Folder to write.")
@option("--next-views/--no-next-views", default=True, help="Of a fit: which views to take next.")
@option("--truth", type=INPUT, help="Of a map: its simulated capture.")
@option("--capture", type=INPUT, help="Of a map: its capture, whose readings a click shows.")
@option("--uncorrected", type=INPUT, help="With --truth: the same map without weights, to compare.")
@option(
    "--compare", "comparisons", type=INPUT, multiple=True,
    help="Of a calibration: another of the same layout; give it once for each.",
)  # fmt: skip
def report(
    fit: Path,
    out: Path,
    next_views: bool,
    truth: Path | None,
    capture: Path | None,
    uncorrected: Path | None,
    comparisons: tuple[Path, ...],
) -> None:
    """Write the standardized report of a fit, calibration, accuracy study, or map (.zarr)."""
    with stages() as progress:
        progress("reading the result", 0.0)
        result = pb.load(fit)
        if next_views and _is_new_fit(result):
            _add_next_views(result, progress)
        progress("drawing the report", 0.0)
        page = pb.report(
            result,
            out,
            truth=None if truth is None else pb.maps.open_capture(truth),
            uncorrected=None if uncorrected is None else pb.maps.open_map(uncorrected),
            comparisons=_load_all(comparisons, "calibration") or None,
            capture=None if capture is None else pb.maps.open_capture(capture),
        )
    click.echo(f"report: {page}")
    if "status" in result:
        from polar_bayes.reporting.page import EXPLORER, has_explorer
        from polar_bayes.reporting.text import no_explorer

        found = f"map to point at: {page.with_name(EXPLORER)}" if has_explorer() else no_explorer()
        click.echo(found)


def _is_new_fit(result: "Result") -> bool:
    """Return whether a result is a fit that holds no next views yet."""
    return "posterior" in result and "next_views" not in result and pb.verdict(result).passed


def _add_next_views(result: "Result", progress: Progress) -> None:
    """Add to a fit which views to take next, or why that is not known."""
    progress("looking for the next views", 0.0)
    try:
        result["next_views"] = pb.next_views(result, progress=progress)
    except pb.PolarBayesError as error:
        say(f"no next views: {error}", err=True)


@command()
@click.argument("fits", type=INPUT, nargs=-1, required=True)
@out_option(FOLDER, "Folder to write.")
def compare(fits: tuple[Path, ...], out: Path) -> int:
    """Compare fits of one capture: predictions, parameters, and the effect of the priors."""
    results = _load_all(fits, "fit")
    comparison = pb.diagnostics.compare_fits(results)
    page = pb.report(results, out)
    if not comparison.loo.empty:
        print_frame(comparison.loo.rename(columns={"elpd_diff": "difference", "dse": "error"}))
        click.echo()
    for sentence in pb.reporting.comparison_of_fits_sentences(comparison):
        say(sentence)
    click.echo(f"report: {page}")
    converged = all(verdict.passed for verdict in comparison.verdicts.values())
    return 0 if converged else NOT_CONVERGED


def _load_all(paths: tuple[Path, ...], kind: str) -> dict[str, Any]:
    """Load results of one kind by the names of their files."""
    if len({path.stem for path in paths}) < len(paths):
        raise click.UsageError("two of the files have the same name")
    return {path.stem: pb.load(path, kind) for path in paths}


COMMANDS = (demo, fit, map_, regions, effects, scene, scenes, report, compare)
