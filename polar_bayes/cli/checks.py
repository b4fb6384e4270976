"""Commands that measure how far a fit can be trusted."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import polar_bayes as pb
from polar_bayes.cli.options import (
    INPUT,
    MANY_METHOD,
    RESULT_FILE,
    STUDY_METHOD,
    capture_argument,
    command,
    json_option,
    known_option,
    model_option,
    option,
    out_option,
    read_scene_options,
    scene_options,
    scheduler_option,
    seed_option,
)
from polar_bayes.cli.printing import NOT_CONVERGED, json_rows, print_frame, print_json, say
from polar_bayes.methods.registry import FIT_DEFAULT, METHODS
from polar_bayes.progress import stages

if TYPE_CHECKING:
    from polar_bayes.results import Result


@command()
@capture_argument
@out_option(RESULT_FILE, "File to write.")
@model_option
@option(
    "--method", type=MANY_METHOD, default=FIT_DEFAULT,
    help=f"{', '.join(MANY_METHOD.names)}; all but nuts fit many captures side by side.",
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
    from polar_bayes.inference.result import provenance_of

    data, settings = pb.load_capture(capture), read_scene_options(settings)
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
        told = (
            "answered, failed: fits with an answer, and without one",
            "p_value: of uniform ranks; small where the method is wrong",
            "held_50, held_80, held_95: share of intervals that hold the truth; a failed fit is a "
            "miss",
            "crps: mean distance of the posterior from the truth, in the unit of the parameter",
        )
        print_frame(table[columns], told)
        if "readings" in tables:
            click.echo()
            print_frame(tables["readings"].drop(columns=["reading", "test"]))
        method = METHODS.get(provenance_of(calibration)["method"])
        verb = "map" if method is not None and not method.fits_one else "fit"
        next_step = (
            f"Next: polar-bayes report {out} --out report shows where the ranks fail; try another "
            "--method first (nuts is the slowest and the surest), then the model."
        )
        if verdict.passed:
            next_step = (
                f"Next: polar-bayes {verb} {capture} with the same --method, --scene, --model and "
                "--prior; its 95% intervals may be quoted as such. polar-bayes report "
                f"{out} --out report draws the ranks."
            )
        say("\n".join(["", *verdict.sentences, "", next_step]))
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
@option(
    "--from-light", type=click.FloatRange(0.0, 180.0), default=0.0, metavar="DEGREES",
    help="Smallest angle between light and viewer that the set-up can take in a next view.",
)  # fmt: skip
@seed_option
@json_option
def identify(
    capture: Path,
    profiled: tuple[str, ...],
    count: int | None,
    criterion: str,
    from_light: float,
    as_json: bool,
    **settings: Any,
) -> None:
    """Show which parameters a capture determines, which trade off, and where to look next."""
    if from_light and count is None:
        raise click.UsageError("--from-light needs --next-views")
    data, settings = pb.load_capture(capture), read_scene_options(settings)
    with stages() as progress:
        settings["progress"] = progress
        results = {"parameters": pb.identify(data, **settings)}
        for name in profiled:
            results[f"profile of {name}"] = pb.profile(data, name, **settings)
        if count is not None:
            goals = {"D": pb.design.DOptimal(), "A": pb.design.AOptimal()}
            goal = goals.get(criterion) or pb.design.SingleParameter(criterion)
            limits = pb.design.Constraints(from_light=from_light)
            results["next views"] = pb.next_views(
                data, count=count, criterion=goal, constraints=limits, **settings
            )
    found = {name: (pb.summary(each), pb.verdict(each).sentences) for name, each in results.items()}
    if as_json:
        rows: dict[str, object] = {name: json_rows(table) for name, (table, _) in found.items()}
        for name, (_, sentences) in found.items():
            rows["sentences" if name == "parameters" else f"{name}: sentences"] = sentences
        print_json(rows)
        return
    for name, (table, sentences) in found.items():
        if name != "parameters":
            click.echo(f"\n{name}")
        print_frame(table, sentences)


@command()
@click.argument("fit", type=INPUT)
@known_option
@json_option
def budget(fit: Path, known: dict[str, float], as_json: bool) -> None:
    """Show how much of each uncertainty comes from noise, from the prior and from the set-up."""
    table = pb.budget(pb.load(fit, "fit"), known=known)
    if as_json:
        print_json({"known": table.attrs["known"], "parameters": json_rows(table)})
        return
    known_to = ", ".join(f"{name} {value:.2g}" for name, value in table.attrs["known"].items())
    print_frame(table.T, [f"Standard uncertainties: {known_to}."])


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
    """Compare the errors and run times of all methods for this capture."""
    data, settings = pb.load_capture(capture), read_scene_options(settings)
    names = methods or tuple(pb.methods.STUDY_METHODS)
    shown = ["error", "worst", "pareto_k", "r_hat", "seconds_first", "seconds_again"]
    settings["methods"] = chosen = {name: pb.methods.STUDY_METHODS[name] for name in names}
    quick = {name: chosen[name] for name in ("point", "laplace", "importance") if name in chosen}
    if quick and not as_json:
        click.echo("First answer, by a rough reference:\n")
        rough = pb.benchmark.Reference(error=0.06, longer=0)
        first = {"methods": quick, "overrides": (), "reference": rough, "fresh": False}
        study = pb.accuracy(data, **settings | first)
        pb.save(study, out)
        print_frame(pb.summary(study)[shown], pb.benchmark.accuracy_sentences(study, tolerance))
        click.echo(f"\nIt is refined now, which takes minutes; {out} holds what is known so far.")
    if no_overrides:
        settings["overrides"] = ()

    def keep(study: "Result") -> None:
        """Write the study so far, and print its last row."""
        pb.save(study, out)
        name, row = list(pb.summary(study).iterrows())[-1]
        told = f"off by {row['error']:.2g} sd ({row['worst']}), {row['seconds_first']:.0f} s"
        say(f"{name}: {row['problems'] if row['error'] != row['error'] else told}", err=True)

    study = pb.accuracy(data, partial=keep, **settings)
    pb.save(study, out)
    table = pb.summary(study)
    advice = " ".join(pb.benchmark.accuracy_sentences(study, tolerance))
    if as_json:
        print_json({"rows": json_rows(table), "advice": advice})
        return
    click.echo()
    next_step = f"Next: polar-bayes fit {capture} --method NAME --out fit.nc, by the method named."
    told = (
        "error: largest error of a posterior mean or sd, in posterior sds of the reference",
        "worst: the parameter that has it",
        "pareto_k, r_hat: what the method says of itself; at most 0.7 and 1.01 are good",
        "seconds_first, seconds_again: of the first fit, compilation included, and of the next",
    )
    print_frame(table[shown], [*told, "", advice, "", next_step])


COMMANDS = (budget, calibrate, identify, accuracy)
