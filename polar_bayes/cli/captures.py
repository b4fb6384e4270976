"""Commands that make captures."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

import polar_bayes as pb
from polar_bayes.cli.options import (
    CAPTURE_FILE,
    COLUMN_OR_INPUT,
    INPUT,
    MATERIAL,
    SCENE,
    Command,
    command,
    print_counts,
    print_masked,
)


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
    protocol = pb.simulation.Protocol(
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
                hint="import or simulate one of the two again under another --name or file name",
            )
        named[label] = capture
    capture = pb.capture.combine(named, dim=dim, drop=drop)
    pb.save_capture(capture, out)
    print_counts(capture, out)


COMMANDS = (simulate, combine)


# --- Commands that turn raw measurements into a capture -------------------------------------------


@click.group(name="import")
def import_() -> None:
    """Turn raw measurements into a capture."""


@import_.command(cls=Command)
@click.option(
    "--s",
    "s",
    type=COLUMN_OR_INPUT,
    required=True,
    help="Table of s readings, or column name in --table.",
)
@click.option(
    "--p",
    "p",
    type=COLUMN_OR_INPUT,
    required=True,
    help="Table of p readings, or column name in --table.",
)
@click.option("--table", type=INPUT, help="One table with both channels.")
@click.option("--angle", help="Column of --table with the angle of incidence in degrees.")
@click.option("--s-incident", type=float, help="Reading of the incident beam, s.")
@click.option("--p-incident", type=float, help="Reading of the incident beam, p.")
@click.option("--dark-level", type=float, default=0.0, show_default=True, help="Without light.")
@click.option("--s-error", type=float, help="Absolute error of an s reading.")
@click.option("--p-error", type=float, help="Absolute error of a p reading.")
@click.option("--relative-error", type=float, default=0.01, show_default=True)
@click.option("--wavelength", type=float, help="Nanometers.")
@click.option("--name", help="Name of the sample.")
@click.option("--out", type=CAPTURE_FILE, required=True, help="Capture to write.")
def goniometer(s: str, p: str, table: Path | None, out: Path, **settings: Any) -> None:
    """Tables of s and p readings against the angle of incidence, together or apart."""
    capture = pb.from_goniometer(s, p, table=table, **settings)
    pb.save_capture(capture, out)
    print_counts(capture, out)


@import_.command(cls=Command)
@click.argument("table", type=INPUT)
@click.option(
    "--column", "columns", type=(str, str), multiple=True, metavar="VARIABLE COLUMN",
    help="Column of a variable, where it has another name; give it once for each.",
)  # fmt: skip
@click.option(
    "--constant", "constants", type=(str, float), multiple=True, metavar="VARIABLE NUMBER",
    help="A variable that is the same everywhere, such as light_zenith 45.",
)  # fmt: skip
@click.option("--ignore", "ignored", multiple=True, metavar="COLUMN", help="Leave it out.")
@click.option("--setup", help="Set-up that a fit takes by default.")
@click.option("--saturation-level", type=float, help="Intensity of a full pixel.")
@click.option("--name", help="Name of the capture.")
@click.option("--out", type=CAPTURE_FILE, required=True, help="Capture to write.")
def table(
    table: Path,
    columns: tuple[tuple[str, str], ...],
    constants: tuple[tuple[str, float], ...],
    out: Path,
    **settings: Any,
) -> None:
    """Any readings, listed a line each with their directions."""
    given: dict[str, Any] = {
        "columns": _once(columns, "--column"),
        "constants": _once(constants, "--constant"),
    }
    _write(pb.from_table(table, **given, **settings), out)


def of_a_picture(command: Callable) -> Callable:
    """The options that every import of pictures has."""
    options = (
        click.option(
            "--sphere", "spheres", type=float, nargs=3, multiple=True, metavar="ROW COLUMN RADIUS",
            help="A sphere in the frame [pixels]; give it once for each.",
        ),
        click.option(
            "--rim", "rims", type=INPUT, multiple=True,
            help="Table of points (row, column) on a sphere's outline; give it once for each.",
        ),
        click.option(
            "--normals", type=INPUT, help="Unit normals in a .npy file."
        ),
        click.option("--light", type=float, nargs=3, metavar="X Y Z", help="Towards far light."),
        click.option(
            "--light-position", type=float, nargs=3, metavar="X Y Z",
            help="Place of near light [pixels from the center of the frame].",
        ),
        click.option(
            "--highlight", type=float, nargs=2, metavar="ROW COLUMN",
            help="Where the surface mirrors the light [pixels].",
        ),
        click.option("--surroundings", is_flag=True, help="Light from everywhere."),
        click.option(
            "--view-position", type=float, nargs=3, metavar="X Y Z",
            help="Place of a near camera [pixels]: 0 0 and its focal length.",
        ),
        click.option("--dark", type=INPUT, help="Frame without light."),
        click.option("--dark-level", type=float, help="Count without light, in place of --dark."),
        click.option("--flat", type=INPUT, help="Frame of even light."),
        click.option("--saturation-level", type=float, help="Count of a full pixel."),
        click.option("--gain", type=float, help="Counts per electron."),
        click.option(
            "--read-noise", type=float, default=1.0, show_default=True, help="In counts."
        ),
        click.option("--relative-error", type=float, default=0.01, show_default=True),
        click.option("--window", type=int, default=2, show_default=True, help="Readings a side."),
        click.option("--wavelength", type=float, help="Nanometers."),
        click.option("--name", help="Name of the capture."),
        click.option(
            "--out", type=CAPTURE_FILE, required=True, help="Capture to write."
        ),
    )  # fmt: skip
    for option in reversed(options):
        command = option(command)
    return command


@import_.command(cls=Command)
@click.option(
    "--frame", "frames", type=(float, INPUT), multiple=True, required=True,
    metavar="ANGLE FILE", help="Angle of the polarizer [degrees], frame; give it once for each.",
)  # fmt: skip
@of_a_picture
@click.option("--bin", type=int, default=1, show_default=True, help="Pixels averaged, a side.")
def polarizer(frames: tuple[tuple[float, Path], ...], out: Path, **options: Any) -> None:
    """Frames behind a polarizer at three or more angles."""
    angles, files = [angle for angle, _ in frames], [file for _, file in frames]
    _write(pb.from_polarizer(files, angles, **_setting(options)), out)


@import_.command(cls=Command)
@click.argument("frame", type=INPUT)
@of_a_picture
@click.option(
    "--layout", type=float, nargs=4, default=(90.0, 45.0, 135.0, 0.0), show_default=True,
    help="Angles of the four pixels, row by row [degrees].",
)  # fmt: skip
@click.option("--bin", type=int, default=2, show_default=True, help="Pixels averaged, a side.")
def mosaic(frame: Path, layout: tuple[float, ...], out: Path, **options: Any) -> None:
    """One raw frame of a polarization camera."""
    _write(pb.from_mosaic(frame, layout=(layout[:2], layout[2:]), **_setting(options)), out)


def _once(pairs: tuple[tuple[str, Any], ...], option: str) -> dict[str, Any]:
    """A mapping from an option that is given once for each variable."""
    names = [name for name, _ in pairs]
    if twice := [name for name in names if names.count(name) > 1]:
        raise click.UsageError(f"{option} names {twice[0]} twice")
    return dict(pairs)


def _write(capture: Any, out: Path) -> None:
    pb.save_capture(capture, out)
    print_counts(capture, out)
    print_masked(capture)


def _setting(options: dict[str, Any]) -> dict[str, Any]:
    """Arguments of an import from the options of a command."""
    take = options.pop
    spheres = tuple(pb.importers.Sphere(*each) for each in take("spheres"))
    spheres += tuple(pb.importers.fit_sphere(rim) for rim in take("rims"))
    normals = take("normals")
    shape = _one({"--sphere or --rim": spheres or None, "--normals": normals})
    light = _one(
        {
            "--light": _made(pb.importers.Direction, take("light")),
            "--light-position": _made(pb.importers.Position, take("light_position")),
            "--highlight": _made(pb.importers.Highlight, take("highlight")),
            "--surroundings": pb.importers.Surroundings() if take("surroundings") else None,
        }
    )
    view = _made(pb.importers.Position, take("view_position"))
    dark, dark_level = take("dark"), take("dark_level")
    if dark is not None and dark_level is not None:
        raise click.UsageError("--dark and --dark-level exclude each other")
    dark = dark_level if dark is None else dark
    detector = pb.importers.Detector(
        dark=0.0 if dark is None else dark,
        **{
            name: take(name)
            for name in ("flat", "saturation_level", "gain", "read_noise", "relative_error")
        },
    )
    found = {"shape": shape, "light": light, "detector": detector, **options}
    return found if view is None else found | {"view": view}


def _one(given: dict[str, Any]) -> Any:
    """The one that was given of several options."""
    there = {name: value for name, value in given.items() if value is not None}
    if len(there) != 1:
        raise click.UsageError(f"give one of {', '.join(given)}")
    return next(iter(there.values()))


def _made(kind: Callable, numbers: tuple[float, ...] | None) -> Any:
    return None if numbers is None else kind(*numbers)


IMPORT_COMMANDS = (import_,)
