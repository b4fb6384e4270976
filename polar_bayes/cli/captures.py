"""Commands that make captures."""

from pathlib import Path
from typing import Any

import click

import polar_bayes as pb
from polar_bayes.cli.options import CAPTURE_FILE, INPUT, MATERIAL, SCENE, command
from polar_bayes.cli.printing import print_counts


@command()
@click.option("--out", type=CAPTURE_FILE, required=True, help="Capture to write.")
@click.option(
    "--preset", type=MATERIAL, default="leaf", show_default=True, help="Material to simulate."
)
@click.option(
    "--scene", type=SCENE, default="paper", show_default=True, help="Named scene to simulate."
)
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
    print_counts(capture, out)


@command()
@click.argument("captures", type=INPUT, nargs=-1, required=True)
@click.option("--dim", default="material", show_default=True, help="material or patch.")
@click.option("--drop", multiple=True, help="Variable to leave out; give it once per variable.")
@click.option("--out", type=CAPTURE_FILE, required=True, help="Capture to write.")
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
    print_counts(capture, out)


COMMANDS = (simulate, combine)
