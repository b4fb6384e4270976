"""Commands that say how far a fit can be trusted."""

import json
from pathlib import Path
from typing import Any

import click

import polar_bayes as pb
from polar_bayes.cli.options import (
    CALIBRATION_METHOD,
    INPUT,
    MODEL,
    NOT_CONVERGED,
    RESULT_FILE,
    RUNG,
    SCENE,
    command,
)
from polar_bayes.progress import stages


@command()
@click.argument("capture", type=INPUT)
@click.option("--out", type=RESULT_FILE, required=True, help="File to write.")
@click.option("--model", type=MODEL, default="per_material", show_default=True)
@click.option(
    "--method",
    type=CALIBRATION_METHOD,
    help="laplace, importance, tempered or nuts; by default what suits the capture.",
)
@click.option("--simulations", type=int, default=1000, show_default=True)
@click.option("--scene", type=SCENE, help="Named scene; by default the one that the capture names.")
@click.option("--largest-view-zenith", type=float, help="Set aside views beyond it [degrees].")
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=0, show_default=True)
@click.option("--no-readings", is_flag=True, help="Rank parameters only.")
@click.option("--scheduler", help="Address of a dask.distributed scheduler; default: threads.")
@click.option(
    "--resume", is_flag=True,
    help="Go on with a calibration that was broken off, or with more simulations.",
)  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print the tables as JSON.")
def calibrate(
    capture: Path, out: Path, no_readings: bool, resume: bool, as_json: bool, **settings: Any
) -> int:
    """Simulate captures of this layout, fit each, and see whether the intervals hold."""
    data = pb.load_capture(capture)
    store = out.with_name(f"{out.name}.fits")
    if resume and out.exists() and not store.exists():
        raise pb.FitError("nothing is left to resume", where=str(out), hint="give another --out")
    settings |= {"readings": not no_readings, "store": store, "resume": resume}
    calibration = pb.calibrate(data, **settings)
    pb.save_result(calibration, out)
    table, said = (
        pb.calibration.calibration_table(calibration),
        pb.calibration.calibration_verdict(calibration),
    )
    is_ranked = "predictive_pit" in calibration.children
    readings = pb.calibration.calibration_readings(calibration) if is_ranked else None
    if as_json:
        tables = {"parameters": table} | ({} if readings is None else {"readings": readings})
        rows = {name: json.loads(each.to_json(orient="index")) for name, each in tables.items()}
        click.echo(json.dumps({**rows, "verdict": said}, indent=2, allow_nan=False))
    else:
        shown = table[["answered", "failed", "p_value", "held_50", "held_80", "held_95", "crps"]]
        click.echo(shown.to_string(float_format=lambda x: f"{x:.3g}"))
        if readings is not None:
            shown = readings.drop(columns=["reading", "test"])
            click.echo(f"\n{shown.to_string(float_format=lambda x: f'{x:.3g}', na_rep='')}")
        click.echo("\n".join(["", *said]))
    return 0 if pb.calibration.is_calibrated(table) else NOT_CONVERGED


@command()
@click.argument("capture", type=INPUT)
@click.option("--model", type=MODEL, default="per_material", show_default=True)
@click.option("--scene", type=SCENE, help="Named scene; by default the one that the capture names.")
@click.option("--largest-view-zenith", type=float, help="Set aside views beyond it [degrees].")
@click.option(
    "--profile",
    "profiled",
    multiple=True,
    metavar="PARAMETER",
    help="Follow the likelihood while this parameter moves; give it once per parameter.",
)
@click.option(
    "--next-views",
    "count",
    type=click.IntRange(min=1),
    metavar="N",
    help="Name the N views that would add most.",
)
@click.option(
    "--criterion",
    default="D",
    show_default=True,
    help="What they should narrow: D (all parameters together), A (each), or one parameter.",
)
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=0, show_default=True)
@click.option("--json", "as_json", is_flag=True, help="Print the tables as JSON.")
def identify(
    capture: Path,
    profiled: tuple[str, ...],
    count: int | None,
    criterion: str,
    as_json: bool,
    **settings: Any,
) -> None:
    """Which parameters a capture determines, which trade off, and where to look next."""
    data = pb.load_capture(capture)
    tables, said = {}, {}
    with stages() as progress:
        found = pb.identify(data, progress=progress, **settings)
        tables["parameters"] = pb.design.identifiability_table(found)
        said["said"] = pb.design.identifiability_sentences(found)
        for name in profiled:
            curve = pb.profile(data, name, progress=progress, **settings)
            tables[f"profile of {name}"] = pb.design.profile_table(curve)
            said[f"profile of {name}"] = pb.design.profile_sentences(curve)
        if count is not None:
            views = pb.next_views(
                data, count=count, criterion=_criterion(criterion), progress=progress, **settings
            )
            tables["next views"] = pb.design.next_views_table(views)
            said["next views"] = pb.design.next_views_sentences(views)
    if as_json:
        told = {name: json.loads(table.to_json(orient="index")) for name, table in tables.items()}
        every = {"said": said.pop("said"), **{f"{name}: said": x for name, x in said.items()}}
        click.echo(json.dumps({**told, **every}, indent=2, allow_nan=False))
        return
    for (name, table), sentences in zip(tables.items(), said.values(), strict=True):
        if name != "parameters":
            click.echo(f"\n{name}")
        click.echo(table.to_string(float_format=lambda x: f"{x:.3g}", index_names=False))
        click.echo("\n".join(["", *sentences]))


@command()
@click.argument("capture", type=INPUT)
@click.option("--out", type=RESULT_FILE, required=True, help="Study to write.")
@click.option("--model", type=MODEL, default="per_material", show_default=True)
@click.option("--scene", type=SCENE, help="Named scene; by default the one that the capture names.")
@click.option("--largest-view-zenith", type=float, help="Set aside views beyond it [degrees].")
@click.option(
    "--rung", "rungs", type=RUNG, multiple=True,
    help="Method to try; by default the whole ladder.",
)  # fmt: skip
@click.option("--no-dials", is_flag=True, help="Methods alone, nothing turned beside them.")
@click.option("--tolerance", type=float, default=0.1, show_default=True, help="Of the advice.")
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=0, show_default=True)
@click.option("--json", "as_json", is_flag=True, help="Print the table as JSON.")
def accuracy(
    capture: Path,
    out: Path,
    rungs: tuple[str, ...],
    no_dials: bool,
    tolerance: float,
    as_json: bool,
    **settings: Any,
) -> None:
    """What each method gets wrong for this capture, and what it costs in time."""
    data = pb.load_capture(capture)
    settings["rungs"] = {name: pb.methods.LADDER[name] for name in rungs or pb.methods.LADDER}
    settings |= {"dials": ()} if no_dials else {}
    study = pb.accuracy(data, **settings)
    pb.save_result(study, out)
    table, advice = (
        pb.benchmark.accuracy_table(study),
        pb.benchmark.accuracy_advice(study, tolerance),
    )
    if as_json:
        rows = json.loads(table.to_json(orient="index"))
        click.echo(json.dumps({"rows": rows, "advice": advice}, indent=2, allow_nan=False))
        return
    columns = ["error", "worst", "k_hat", "r_hat", "seconds_first", "seconds_again"]
    shown = table[columns].rename_axis(None)
    click.echo(shown.to_string(float_format=lambda x: f"{x:.3g}", na_rep="-"))
    click.echo(f"\n{advice}")


def _criterion(name: str) -> Any:
    """The criterion of that letter, or the one of that parameter alone."""
    letters = {"D": pb.design.DOptimal, "A": pb.design.AOptimal}
    return letters[name]() if name in letters else pb.design.SingleParameter(name)


COMMANDS = (calibrate, identify, accuracy)
