"""Commands that say how far a fit can be trusted."""

import json
from pathlib import Path
from typing import Any

import click

import polar_bayes as pb
from polar_bayes.cli.places import check_writable
from polar_bayes.cli.printing import NOT_CONVERGED, counting_bar, progress_bars


@click.command()
@click.argument("capture", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), required=True, help="File to write.")
@click.option("--model", default="per_material", show_default=True)
@click.option(
    "--method", default="importance", show_default=True, help="laplace, importance or nuts."
)
@click.option("--simulations", type=int, default=1000, show_default=True)
@click.option("--scene", help="Named scene; by default the one that the capture names.")
@click.option("--largest-view-zenith", type=float, help="Set aside views beyond it [degrees].")
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=0, show_default=True)
@click.option("--json", "as_json", is_flag=True, help="Print the table as JSON.")
def calibrate(capture: Path, out: Path, as_json: bool, **settings: Any) -> int:
    """Simulate captures of this layout, fit each, and see whether the intervals hold."""
    data = pb.load_capture(capture)
    check_writable(out)
    with counting_bar("fits") as progress:
        calibration = pb.calibrate(data, progress=progress, **settings)
    pb.save_result(calibration, out)
    table, said = pb.calibration_table(calibration), pb.calibration_verdict(calibration)
    if as_json:
        rows = json.loads(table.to_json(orient="index"))
        click.echo(json.dumps({"parameters": rows, "verdict": said}, indent=2, allow_nan=False))
    else:
        shown = table[["answered", "failed", "p_value", "held_50", "held_80", "held_95", "crps"]]
        click.echo(shown.to_string(float_format=lambda x: f"{x:.3g}"))
        click.echo("\n".join(["", *said]))
    return 0 if pb.is_calibrated(table) else NOT_CONVERGED


@click.command()
@click.argument("capture", type=click.Path(path_type=Path))
@click.option("--model", default="per_material", show_default=True)
@click.option("--scene", help="Named scene; by default the one that the capture names.")
@click.option("--largest-view-zenith", type=float, help="Set aside views beyond it [degrees].")
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=0, show_default=True)
@click.option("--json", "as_json", is_flag=True, help="Print the table as JSON.")
def identify(capture: Path, as_json: bool, **settings: Any) -> None:
    """Which parameters a capture determines, and which trade off."""
    data = pb.load_capture(capture)
    with progress_bars() as progress:
        found = pb.identify(data, progress=progress, **settings)
    table, said = pb.identifiability_table(found), pb.identifiability_sentences(found)
    if as_json:
        rows = json.loads(table.to_json(orient="index"))
        click.echo(json.dumps({"parameters": rows, "said": said}, indent=2, allow_nan=False))
    else:
        click.echo(table.to_string(float_format=lambda x: f"{x:.3g}", index_names=False))
        click.echo("\n".join(["", *said]))


COMMANDS = (calibrate, identify)
