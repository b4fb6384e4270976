"""Commands that make captures."""

import dataclasses
import itertools
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import polar_bayes as pb
from polar_bayes.cli.options import (
    CAPTURE_FILE,
    COLUMN_OR_INPUT,
    INPUT,
    MATERIAL,
    SCENE,
    Command,
    Name,
    all_of,
    command,
    link_option,
    option,
    out_option,
    read_scene_options,
    seed_option,
)
from polar_bayes.cli.printing import print_cautions, say
from polar_bayes.errors import CaptureError

if TYPE_CHECKING:
    from polar_bayes.results import Capture

out_capture = out_option(CAPTURE_FILE, "Capture to write.")
name_option = option("--name", help="Name of the capture.")
wavelength_option = option("--wavelength", type=float, help="Nanometers.")


def _save(capture: "Capture", out: Path) -> None:
    """Write a capture, and print how many entries it has."""
    pb.save_capture(capture, out)
    counts = pb.capture.count(capture)
    flagged = (f"{counts[what]} {what}" for what in ("masked", "saturated"))
    click.echo(f"{out}: {', '.join([_layout(capture), *flagged])}")


def _layout(capture: "Capture") -> str:
    """Format the lengths of the axes of a capture: `12 views x 4 wavelengths`."""
    plural = {"view": "s", "wavelength": "s", "material": "s", "patch": "es"}
    sizes = {dim: capture.sizes[dim] for dim in plural if dim in capture.sizes}
    found = [f"{size} {dim}{'' if size == 1 else plural[dim]}" for dim, size in sizes.items()]
    if "y" in capture.sizes:
        found.append(f"{capture.sizes['y']} x {capture.sizes['x']} pixels")
    return " x ".join(found)


def _save_import(capture: "Capture", out: Path) -> None:
    """Write a capture; print its counts, what was inferred and what is unlikely."""
    _save(capture, out)
    for sentence in pb.capture.inferred(capture) + pb.capture.stated(capture):
        say(sentence)
    indices = pb.capture.indices_by_eye(capture)
    print_cautions(pb.capture.cautions(capture) + pb.capture.index_sentences(indices))


@command()
@out_capture
@option("--preset", type=MATERIAL, default="leaf", help="Material to simulate.")
@option(
    "--scene", type=SCENE, default="paper", metavar="NAME|FILE", help="Named set-up or scene file."
)
@link_option
@name_option
@option("--views", type=int, default=40)
@option(
    "--largest-view-zenith", type=click.FloatRange(0.0, 90.0, min_open=True, max_open=True),
    default=85.0, help="Degrees.",
)  # fmt: skip
@option("--mirror", is_flag=True, help="Views in the mirror direction, from 20 degrees on.")
@option(
    "--wavelength", "wavelengths", type=float, multiple=True, default=(450.0, 550.0, 650.0),
    help="Nanometers; give it once per wavelength.",
)  # fmt: skip
@seed_option
def simulate(out: Path, *, mirror: bool, **settings: Any) -> None:
    """Draw a capture of a known material, by the paper's protocol or in mirror directions."""
    names = "views", "largest_view_zenith", "wavelengths"  # a scene file says what is used
    protocol = {name: settings.pop(name) for name in names}
    settings = read_scene_options(settings)
    views = pb.simulation.MirrorScan if mirror else pb.simulation.Protocol
    _save(pb.simulate(protocol=views(**protocol), **settings), out)


@command()
@click.argument("captures", type=INPUT, nargs=-1, required=True)
@option("--dim", default="material", help="material or patch.")
@option("--drop", multiple=True, help="Variable to leave out; give it once per variable.")
@out_capture
def combine(captures: tuple[Path, ...], dim: str, drop: tuple[str, ...], out: Path) -> None:
    """Combine captures that are to be fitted together; each is labeled by its name.

    Captures of one name are numbered in the order in which they are given.
    """
    loaded = [pb.load_capture(path) for path in captures]
    labels = _numbered([str(capture.attrs["name"]) for capture in loaded])
    named = dict(zip(labels, loaded, strict=True))
    _save(pb.capture.combine(named, dim=dim, drop=drop), out)
    for label, path in zip(labels, captures, strict=True):
        click.echo(f"{label}: {path}")


def _numbered(names: list[str]) -> list[str]:
    """Make names unique by numbers behind those that occur more than once."""
    labels: list[str] = []
    for name in names:
        numbered = (f"{name} {number}" for number in itertools.count(1))
        free = (each for each in numbered if each not in labels and each not in names)
        labels.append(name if names.count(name) == 1 else next(free))
    return labels


SET_BY = Name("way to set angles", ("stage", "hand", "lens"), CaptureError)
angle_option = option(
    "--angle-set-by", type=SET_BY, default="hand",
    help="How the angles were set (stage, hand or lens): how far their zero may be off.",
)  # fmt: skip


SCALES = "incidence", "from-surface", "two-theta", "deviation"
angle_is_option = option(
    "--angle-is", type=Name("scale of the angle", SCALES, CaptureError),
    help="What the angles are: incidence; from-surface (90 degrees less it); two-theta (twice it); "
    "deviation (of the beam, 180 less that). Signs do not count, so that a scan may pass zero. "
    "Without it: incidence, degrees from the surface normal, 0 or more.",
)  # fmt: skip
sheet_option = option("--sheet", help="Sheet of an .xlsx workbook, where several hold something.")


# --- Commands that import raw measurements --------------------------------------------------------


@click.group(name="import")
def import_() -> None:
    """Turn raw measurements into a capture."""


@import_.command(cls=Command)
@option("--s", "s", type=COLUMN_OR_INPUT, help="Table of s, or column of --table.")
@option("--p", "p", type=COLUMN_OR_INPUT, help="Table of p, or column of --table.")
@option(
    "--unpolarized", type=COLUMN_OR_INPUT,
    help="The same of unpolarized light without an analyzer, in place of --s and --p.",
)  # fmt: skip
@option("--table", type=INPUT, help="One table, text or .xlsx, with all channels.")
@option("--angle", help="Column of --table with the angle.")
@angle_is_option
@sheet_option
@option("--s-incident", type=float, help="Reading of the incident beam, s.")
@option("--p-incident", type=float, help="Reading of the incident beam, p.")
@option("--dark-level", type=float, default=0.0, help="Reading without light.")
@option("--s-error", type=float, help="Absolute error of an s reading.")
@option("--p-error", type=float, help="Absolute error of a p reading.")
@option(
    "--relative-error", type=float,
    help="Error of a reading over the reading; by default the scatter of repeats, or 0.01.",
)  # fmt: skip
@angle_option
@wavelength_option
@name_option
@out_capture
def goniometer(out: Path, **settings: Any) -> None:
    """Import s and p readings against the angle, from one table or two, or one of them alone.

    Lines without an angle are left out, readings at one angle are averaged, and all that is done
    is told.
    """
    _save_import(pb.from_goniometer(**settings), out)


@import_.command(cls=Command)
@option("--table", type=INPUT, required=True, help="Text, .xlsx, or a .dat file of WVASE.")
@option("--angle", help="Column with the angle, or the angle of all lines in degrees.")
@angle_is_option
@option("--psi", multiple=True, help="Column of psi; give it once for each wavelength.")
@option("--delta", multiple=True, help="Column of delta, for u as well; once for each wavelength.")
@option(
    "--mueller",
    help="In place of --psi, elements m00... or m11...: column (the light was unpolarized) or row "
    "(the detector was blind to polarization).",
)  # fmt: skip
@option(
    "--wavelength", multiple=True,
    help="Column of wavelengths, or nanometers: of all lines, or once for each --psi.",
)  # fmt: skip
@option("--unit", help="Of psi and delta: degree or radian.  [default: degree]")
@option("--psi-error", help="Error of psi, or its column.  [default: 0.1 degrees]")
@option("--delta-error", help="Error of delta, or its column.  [default: 0.2 degrees]")
@sheet_option
@option("--angle-set-by", type=SET_BY, default="stage", help="stage, hand or lens.")
@name_option
@out_capture
def ellipsometer(table: Path, out: Path, wavelength: tuple[str, ...], **settings: Any) -> None:
    """Import psi and delta, or Mueller elements, against the angle.

    Without --psi and --mueller the table is a .dat file of WVASE, whose lines of other kinds than
    E are left out and counted. A plate with a polished back sends back light of its back face too.
    """
    for key in ("angle", "psi_error", "delta_error"):
        settings[key] = _number_or_column(settings[key])
    waves = [_number_or_column(each) for each in wavelength]
    settings["wavelength"] = waves if len(waves) > 1 else next(iter(waves), None)
    _save_import(pb.from_ellipsometer(table, **settings), out)


def _number_or_column(text: str | None) -> float | str | None:
    """Parse a number, or else return the text as the name of a column."""
    try:
        return None if text is None else float(text)
    except ValueError:
        return text


@import_.command(cls=Command)
@click.argument("table", type=INPUT)
@option(
    "--column", "columns", type=(str, str), multiple=True, metavar="VARIABLE COLUMN",
    help="Column of a variable, where it has another name; give it once for each. With dop and "
    "aolp, the angle of polarization in degrees, q and u follow.",
)  # fmt: skip
@option(
    "--constant", "constants", type=(str, float), multiple=True, metavar="VARIABLE NUMBER",
    help="A variable that is the same everywhere, such as light_zenith 45.",
)  # fmt: skip
@option("--ignore", "ignored", multiple=True, metavar="COLUMN", help="Leave it out.")
@option("--angle", help="Column with the angle of a mirror: of view and light, on opposite sides.")
@angle_is_option
@option(
    "--aolp-from", default="s",
    help="Axis from which a column aolp counts: s, or p in the plane of normal and viewer.",
)  # fmt: skip
@sheet_option
@option("--setup", help="Set-up that a fit takes by default.")
@angle_option
@option("--saturation-level", type=float, help="Intensity of a full pixel.")
@name_option
@out_capture
def table(
    table: Path,
    out: Path,
    columns: tuple[tuple[str, str], ...],
    constants: tuple[tuple[str, float], ...],
    **settings: Any,
) -> None:
    """Import a table with a line for each reading and its directions."""
    settings["columns"] = _mapping(columns, "--column")
    settings["constants"] = _mapping(constants, "--constant")
    _save_import(pb.from_table(table, **settings), out)


def _mapping[T](pairs: tuple[tuple[str, T], ...], flag: str) -> dict[str, T]:
    """Return a mapping from an option that is given once for each variable."""
    names = [name for name, _ in pairs]
    if repeated := [name for name in names if names.count(name) > 1]:
        raise click.UsageError(f"{flag} names {repeated[0]} twice")
    return dict(pairs)


image_options = all_of(
    option(
        "--sphere", "spheres", type=float, nargs=3, multiple=True, metavar="ROW COLUMN RADIUS",
        help="A sphere in the frame [pixels]; give it once for each.",
    ),
    option(
        "--rim", "rims", type=INPUT, multiple=True,
        help="Table of points (row, column) on a sphere's outline; give it once for each.",
    ),
    option("--normals", type=INPUT, help="Unit normals in a .npy file."),
    option("--light", type=float, nargs=3, metavar="X Y Z", help="Towards distant light."),
    option(
        "--light-position", type=float, nargs=3, metavar="X Y Z",
        help="Position of near light [pixels from the center of the frame].",
    ),
    option(
        "--highlight", type=float, nargs=2, metavar="ROW COLUMN",
        help="Where the surface mirrors the light [pixels].",
    ),
    option("--surroundings", is_flag=True, help="Light from everywhere."),
    option(
        "--view-position", type=float, nargs=3, metavar="X Y Z",
        help="Position of a near camera [pixels]: 0 0 and its focal length.",
    ),
    option("--dark", type=INPUT, help="Frame without light."),
    option("--dark-level", type=float, help="Count without light, in place of --dark."),
    option("--flat", type=INPUT, help="Frame of even light."),
    option("--saturation-level", type=float, help="Count of a full pixel."),
    option(
        "--transfer", metavar="srgb|linear|GAMMA",
        help="Tone curve of all frames, to be undone; linear: none, whatever a file states.",
    ),
    option("--gain", type=float, help="Counts per electron."),
    option("--read-noise", type=float, default=1.0, help="In counts."),
    option("--relative-error", type=float, default=0.01),
    option("--window", type=int, default=2, help="Readings a side."),
    wavelength_option,
    name_option,
    out_capture,
)  # fmt: skip
"""Options of every import of camera frames."""


@import_.command(cls=Command)
@option(
    "--frame", "frames", type=(float, INPUT), multiple=True, required=True,
    metavar="ANGLE FILE", help="Angle of the polarizer [degrees], frame; give it once for each.",
)  # fmt: skip
@image_options
@option("--bin", type=int, default=1, help="Pixels averaged, a side.")
def polarizer(frames: tuple[tuple[float, Path], ...], out: Path, **options: Any) -> None:
    """Import frames behind a polarizer at three or more angles."""
    angles, files = [angle for angle, _ in frames], [file for _, file in frames]
    _save_image(pb.from_polarizer(files, angles, **_image_arguments(options)), out)


@import_.command(cls=Command)
@click.argument("frame", type=INPUT)
@image_options
@option(
    "--layout", type=float, nargs=4, default=(90.0, 45.0, 135.0, 0.0),
    help="Angles of the four pixels, row by row [degrees].",
)  # fmt: skip
@option(
    "--color", type=float, nargs=3, metavar="RED GREEN BLUE",
    help="Centers of the filters [nm] of a color sensor (IMX250MYR), such as 610 530 460: the "
    "frame as it was read, before any color is filled in.",
)  # fmt: skip
@option("--bin", type=int, help="Pixels averaged, a side.  [default: 2; in color 4]")
def mosaic(frame: Path, layout: tuple[float, ...], out: Path, **options: Any) -> None:
    """Import one raw frame of a polarization camera: monochrome, or in color with --color."""
    options["layout"] = layout[:2], layout[2:]
    _save_image(pb.from_mosaic(frame, **_image_arguments(options)), out)


def _save_image(capture: "Capture", out: Path) -> None:
    """Write a capture, and print how many readings are masked for which reason."""
    _save_import(capture, out)
    masked = ", ".join(
        f"{number} {str(name).removeprefix('masked_').replace('_', ' ')}"
        for name, number in capture.attrs.items()
        if str(name).startswith("masked_") and number
    )
    if masked:
        click.echo(f"masked: {masked}")


def _image_arguments(options: dict[str, Any]) -> dict[str, Any]:
    """Return the arguments of an import from the options of a command."""
    pop = options.pop
    dark, dark_level = pop("dark"), pop("dark_level")
    if dark is not None and dark_level is not None:
        raise click.UsageError("--dark and --dark-level exclude each other")
    detector = {
        field.name: pop(field.name)
        for field in dataclasses.fields(pb.importers.Detector)
        if field.name != "dark"
    }
    spheres = [pb.importers.Sphere(*each) for each in pop("spheres")]
    outlines = (*spheres, *map(pb.importers.fit_sphere, pop("rims")))
    lights = {
        "--light": (light := pop("light")) and pb.importers.Direction(*light),
        "--light-position": (at := pop("light_position")) and pb.importers.Position(*at),
        "--highlight": (pixel := pop("highlight")) and pb.importers.Highlight(*pixel),
        "--surroundings": pb.importers.Surroundings() if pop("surroundings") else None,
    }
    if camera := pop("view_position"):
        options["view"] = pb.importers.Position(*camera)
    return {
        "shape": _only_one({"--sphere or --rim": outlines, "--normals": pop("normals")}),
        "light": _only_one(lights),
        "detector": pb.importers.Detector(dark=dark or dark_level or 0.0, **detector),
        **options,
    }


def _only_one[T](given: dict[str, T]) -> T:
    """Return the value of the one option that was given."""
    values = [value for value in given.values() if value]
    if len(values) != 1:
        raise click.UsageError(f"give one of {', '.join(given)}")
    return values[0]


COMMANDS = (simulate, combine, import_)
