"""Commands that measure how far a fit can be trusted."""

from pathlib import Path
from typing import Any

import click

import polar_bayes as pb
from polar_bayes.cli.options import (
    CALIBRATION_METHOD,
    NOT_CONVERGED,
    RESULT_FILE,
    STUDY_METHOD,
    capture_argument,
    command,
    json_option,
    json_rows,
    model_option,
    option,
    out_option,
    print_frame,
    print_json,
    read_scene_options,
    scene_options,
    scheduler_option,
    seed_option,
)
from polar_bayes.progress import stages


@command()
@capture_argument
@out_option(RESULT_FILE, "File to write.")
@model_option
@option(
    "--method", type=CALIBRATION_METHOD,
    help="laplace, importance, tempered or nuts; by default what suits the capture.",
)  # fmt: skip
@option("--simulations", type=int, default=1000)
@scene_options
@seed_option
@option("--no-readings", is_flag=True, help="Rank parameters only.")
@scheduler_option
@option(
    "--resume", is_flag=True,
    help="Continue an interrupted calibration, or add simulations to a finished one.",
)  # fmt: skip
@json_option
def calibrate(
    capture: Path, out: Path, no_readings: bool, resume: bool, as_json: bool, **settings: Any
) -> int:
    """Simulate captures of this layout, fit each, and test the coverage of the intervals."""
    settings = read_scene_options(settings)
    data = pb.load_capture(capture)
    store = out.with_name(f"{out.name}.fits")
    if resume and out.exists() and not store.exists():
        raise pb.FitError("nothing is left to resume", where=str(out), hint="give another --out")
    calibration = pb.calibrate(
        data, readings=not no_readings, store=store, resume=resume, **settings
    )
    pb.save(calibration, out)
    table, verdict = pb.summary(calibration), pb.verdict(calibration)
    tables = {"parameters": table}
    if "predictive_pit" in calibration.children:
        tables["readings"] = pb.calibration.calibration_readings(calibration)
    if as_json:
        rows = {name: json_rows(each) for name, each in tables.items()}
        print_json({**rows, "verdict": verdict.sentences})
    else:
        columns = ["answered", "failed", "p_value", "held_50", "held_80", "held_95", "crps"]
        print_frame(table[columns])
        if "readings" in tables:
            click.echo()
            print_frame(tables["readings"].drop(columns=["reading", "test"]))
        click.echo("\n".join(["", *verdict.sentences]))
    return 0 if verdict.passed else NOT_CONVERGED


@command()
@capture_argument
@scene_options
@option(
    "--profile", "profiled", multiple=True, metavar="PARAMETER",
    help="Profile likelihood of this parameter; give it once per parameter.",
)  # fmt: skip
@option(
    "--next-views", "count", type=click.IntRange(min=1), metavar="N",
    help="Name the N views that would add most.",
)  # fmt: skip
@option(
    "--criterion", default="D",
    help="What they should narrow: D (all parameters together), A (each), or one parameter.",
)  # fmt: skip
@seed_option
@json_option
def identify(
    capture: Path,
    profiled: tuple[str, ...],
    count: int | None,
    criterion: str,
    as_json: bool,
    **settings: Any,
) -> None:
    """Which parameters a capture determines, which trade off, and where to look next."""
    settings = read_scene_options(settings)
    data = pb.load_capture(capture)
    with stages() as progress:
        settings["progress"] = progress
        results = {"parameters": pb.identify(data, **settings)}
        for name in profiled:
            results[f"profile of {name}"] = pb.profile(data, name, **settings)
        if count is not None:
            goals = {"D": pb.design.DOptimal(), "A": pb.design.AOptimal()}
            goal = goals.get(criterion) or pb.design.SingleParameter(criterion)
            results["next views"] = pb.next_views(data, count=count, criterion=goal, **settings)
    found = {name: (pb.summary(each), pb.verdict(each).sentences) for name, each in results.items()}
    if as_json:
        rows: dict[str, Any] = {name: json_rows(table) for name, (table, _) in found.items()}
        for name, (_, sentences) in found.items():
            rows["said" if name == "parameters" else f"{name}: said"] = sentences
        print_json(rows)
        return
    for name, (table, sentences) in found.items():
        if name != "parameters":
            click.echo(f"\n{name}")
        print_frame(table, sentences)


@command()
@capture_argument
@out_option(RESULT_FILE, "Study to write.")
@model_option
@scene_options
@option(
    "--method", "methods", type=STUDY_METHOD, multiple=True,
    help="Method to try, once for each; by default all of them.",
)  # fmt: skip
@option("--no-overrides", is_flag=True, help="Compare methods only, with their default settings.")
@option("--tolerance", type=float, default=0.1, help="Of the advice.")
@seed_option
@json_option
def accuracy(
    capture: Path,
    out: Path,
    methods: tuple[str, ...],
    no_overrides: bool,
    tolerance: float,
    as_json: bool,
    **settings: Any,
) -> None:
    """What each method gets wrong for this capture, and what it costs in time."""
    settings = read_scene_options(settings)
    settings["methods"] = {
        name: pb.methods.STUDY_METHODS[name] for name in methods or pb.methods.STUDY_METHODS
    }
    if no_overrides:
        settings["overrides"] = ()
    study = pb.accuracy(pb.load_capture(capture), **settings)
    pb.save(study, out)
    table = pb.summary(study)
    advice = " ".join(pb.benchmark.accuracy_sentences(study, tolerance))
    if as_json:
        print_json({"rows": json_rows(table), "advice": advice})
        return
    columns = ["error", "worst", "k_hat", "r_hat", "seconds_first", "seconds_again"]
    print_frame(table[columns], [advice])


COMMANDS = (calibrate, identify, accuracy)
