"""Tables of the kinds that people keep, by the commands that a user types.

The tables of `tests/cases` are made by formula: a light of 1000, 1% noise, each of one index.
"""

import io
import json
from pathlib import Path

import numpy as np
import openpyxl
import pytest
import xarray as xr
from cases import each
from synthetic_results import SMALL, make_result

import polar_bayes as pb
from polar_bayes.capture.plausibility import fresnel
from polar_bayes.cli import main
from polar_bayes.priors import support_bounds

CASES = Path(__file__).parents[1] / "cases"
pytestmark = pytest.mark.usefixtures("without_comparisons")

BARE = """
setup = "goniometer"
method = "laplace"

[scene]
surface = "SmoothSurface()"
"""
"""A plate and nothing else, which is quick to fit."""

BEYOND = {
    "high_index": (
        "Brewster's angle means an index near 3.83 (3.15 to 4.86)",
        "--prior 'refractive_index=TruncatedNormal(3.8, 0.9, low=1)'",
        3.87,
    ),
    "index_2_03": (
        "Brewster's angle means an index near 2.03 (1.78 to 2.33)",
        "--prior 'refractive_index=TruncatedNormal(2.0, 0.3, low=1)'",
        2.03,
    ),
}
"""Message for each, the option that allows its index, and that index."""

LEVELS = {"high_index": "problem", "index_2_03": "caution"}


def imported(name: str, folder: Path) -> Path:
    """The capture of a table."""
    out = folder / f"{name}.nc"
    words = ["--table", str(CASES / f"{name}.csv"), "--angle", "angle", "--s", "Is", "--p", "Ip"]
    assert main(["import", "goniometer", *words, "--out", str(out)]) == 0
    return out


def fitted(capture: Path, *words: str) -> int:
    """Exit status of a fit by a file with the bare plate."""
    scene, out = capture.with_suffix(".toml"), capture.with_name("fit.nc")
    scene.write_text(BARE)
    return main(["fit", str(capture), "--scene", str(scene), "--json", *words, "--out", str(out)])


@each("name", BEYOND)
def test_an_index_beyond_the_prior_is_one_sentence_at_import(name, tmp_path, capsys):
    imported(name, tmp_path)
    means, option, _ = BEYOND[name]
    (caution,) = capsys.readouterr().err.splitlines()
    assert caution == (
        f"caution: {means}, but the default prior of refractive_index ends at 2: give {option}."
    )


@each("name", BEYOND)
def test_the_option_that_the_sentence_names_allows_the_index(name, tmp_path, monkeypatch):
    _, option, index = BEYOND[name]
    asked: dict[str, dict] = {}

    def fit(capture, **settings):
        asked.update(settings)
        return make_result(**SMALL)

    monkeypatch.setattr(pb, "fit", fit)
    fitted(imported(name, tmp_path), *option.replace("'", "").split(" ", 1))
    low, high = support_bounds(asked["priors"]["refractive_index"])
    assert low < index < high


@each("name", ["clean_plate", "slide_back_0"])
def test_an_index_that_the_prior_allows_is_none(name, tmp_path, capsys):
    imported(name, tmp_path)
    told = capsys.readouterr()
    assert "Brewster's angle by eye" in told.out
    assert not told.err


@each("name", BEYOND, quick=1)
def test_a_fit_says_that_its_prior_excludes_the_index(name, tmp_path, capsys):
    """Also one that is read from its file, without the capture."""
    capture = imported(name, tmp_path)
    means, option, _ = BEYOND[name]
    status = fitted(capture)
    said = capsys.readouterr().err
    sentence = f"{means}, but the prior of refractive_index ends at 2: give {option}."
    assert f"{LEVELS[name]}: {sentence}" in said
    assert status == 2 or LEVELS[name] == "caution"
    row = pb.diagnostics.criticize(pb.load(tmp_path / "fit.nc", "fit")).loc["index"]
    assert row["level"] == LEVELS[name]
    assert "priors={'refractive_index': TruncatedNormal(" in row["sentence"]


@pytest.mark.thorough
def test_the_option_that_the_sentence_names_mends_the_fit(tmp_path, capsys):
    capture = imported("high_index", tmp_path)
    _, option, index = BEYOND["high_index"]
    capsys.readouterr()
    assert fitted(capture, *option.replace("'", "").split(" ", 1)) == 0
    told = capsys.readouterr()
    found = json.loads(told.out)["parameters"]["refractive_index"]
    assert found["q2.5"] < index < found["q97.5"]
    assert "Brewster's angle means" not in told.err


@pytest.mark.thorough
@pytest.mark.parametrize("name", BEYOND)
def test_with_all_that_a_goniometer_leaves_unknown(name, tmp_path, capsys):
    """The set-up of the import, with its instrument; chains where the index is allowed."""
    capture, out = imported(name, tmp_path), str(tmp_path / "fit.nc")
    means, option, index = BEYOND[name]
    words = ["fit", str(capture), "--json", "--out", out]
    capsys.readouterr()
    status = main([*words, "--method", "importance"])
    assert f"{LEVELS[name]}: {means}" in capsys.readouterr().err
    assert status == 2 or LEVELS[name] == "caution"
    assert main([*words, *option.replace("'", "").split(" ", 1)]) == 0
    found = json.loads(capsys.readouterr().out)["parameters"]["refractive_index"]
    assert found["q2.5"] < index < found["q97.5"]


@pytest.mark.thorough
def test_no_scene_wins_by_bending_the_index_until_the_prior_allows_it(tmp_path, capsys):
    """Also where nobody stated a beam, so that a sky is a candidate."""
    capture = imported("high_index", tmp_path)
    loose = pb.load_capture(capture)
    for name in ("setup", "incident_levels"):
        del loose.attrs[name]
    pb.save_capture(loose, capture)
    capsys.readouterr()
    main(["scenes", str(capture), "--json"])
    said = json.loads(capsys.readouterr().out)
    assert "Scenes were compared with refractive_index by TruncatedNormal" in said["sentences"][1]
    remaining = [scene for scene in said["scenes"].values() if scene["weight"] > 0.0]
    assert all(3.8 < float(scene["refractive_index"].split()[0]) < 3.95 for scene in remaining)


# --- Every kind of table --------------------------------------------------------------------------

COLUMNS = ("--angle", "angle", "--s", "Is", "--p", "Ip")
GONIOMETER, TABLE, ELLIPSOMETER = "goniometer --table", "table", "ellipsometer --table"
KINDS: dict[str, tuple[str, tuple[str, ...], str]] = {
    "clean_plate.csv": (GONIOMETER, COLUMNS, ""),
    "slide_back_0.csv": (GONIOMETER, COLUMNS, ""),
    "dolp_zero_one.csv": (TABLE, ("--angle", "theta"), ""),
    "three_scans.csv": (
        GONIOMETER,
        COLUMNS,
        "72 readings of s, repeated at 24 angles, averaged; the error of one is their scatter, 1%",
    ),
    "blank_cell.csv": (GONIOMETER, COLUMNS, "1 blank cell of Ip taken as no reading"),
    "half_blank.csv": (GONIOMETER, COLUMNS, "12 blank cells of Ip taken as no reading"),
    "bom_semicolon_trailing.csv": (
        GONIOMETER,
        ("--angle", "alpha", "--s", "I_s", "--p", "I_p"),
        "2 lines without alpha left out (number 26, 27)",
    ),
    "two_theta.csv": (
        GONIOMETER,
        ("--angle", "two_theta", *COLUMNS[2:], "--angle-is", "two-theta"),
        "24 angles of s read as two-theta",
    ),
    "deviation.csv": (
        GONIOMETER,
        ("--angle", "deviation", *COLUMNS[2:], "--angle-is", "deviation"),
        "24 angles of s read as deviation",
    ),
    "negative_angles.csv": (
        GONIOMETER, (*COLUMNS, "--angle-is", "incidence"), "24 angles of p read as incidence",
    ),
    "from_surface.csv": (
        GONIOMETER, (*COLUMNS, "--angle-is", "from-surface"), "24 angles of s read as from-surface",
    ),
    "thousands.csv": (GONIOMETER, COLUMNS, "15 numbers freed of marks for thousands"),
    "numeric_header.csv": (GONIOMETER, ("--angle", "angle", "--s", "90", "--p", "0"), ""),
    "d_exponent.dat": (GONIOMETER, COLUMNS, "48 numbers with a Fortran exponent (D)"),
    "psi_delta.csv": (
        ELLIPSOMETER,
        ("--angle", "AOI", "--psi", "Psi", "--delta", "Delta"),
        "an error of 0.1 degrees of psi was assumed",
    ),
    "mueller.csv": (
        ELLIPSOMETER,
        ("--angle", "AOI", "--mueller", "column"),
        "an error of 0.005 of q was assumed",
    ),
    "aolp.csv": (
        TABLE,
        ("--angle", "AOI", "--column", "dop", "DoLP", "--column", "aolp", "AoLP_deg"),
        "q and u follow from dop and aolp, which counts from s",
    ),
}  # fmt: skip
"""The command that reads each table, and what it says that it did."""


def read(table: Path, command: str, words: tuple[str, ...], out: Path) -> int:
    """Exit status of the import of a table."""
    return main(["import", *command.split(), str(table), *words, "--out", str(out)])


def test_every_table_is_one_of_these():
    assert {path.name for path in CASES.iterdir()} == {*KINDS, *(f"{x}.csv" for x in BEYOND)}


@each("name", KINDS)
def test_every_kind_of_table_has_a_command_that_says_what_it_did(name, tmp_path, capsys):
    command, words, done = KINDS[name]
    out = tmp_path / "capture.nc"
    assert read(CASES / name, command, words, out) == 0
    told, capture = capsys.readouterr(), pb.load_capture(out)
    assert not told.err
    assert done in told.out
    assert done in str(capture.attrs.get("import_notes", ""))
    assert int(capture.get("valid", capture["view_zenith"] >= 0.0).sum()) >= 23
    (peak,) = pb.capture.indices_by_eye(capture).values()
    assert peak.low < 1.5 < peak.high
    if "q" in capture:
        s, p = fresnel(capture["view_zenith"].values, 1.5)
        # Eight standard deviations of 1% noise in each channel, more between readings.
        tolerance = 0.08 if name != "slide_back_0.csv" else 0.2
        assert float(np.nanmax(np.abs(capture["q"].values - (s - p) / (s + p)))) < tolerance


def test_the_scatter_of_repeats_is_the_error(tmp_path):
    scans = CASES / "three_scans.csv"
    averaged = pb.from_goniometer("Is", "Ip", table=scans, angle="angle")
    once = pb.from_goniometer("Is", "Ip", table=CASES / "d_exponent.dat", angle="angle")
    assert averaged.attrs["relative_error"] == "scatter of the repeats"
    # Three scans of 1% noise, whose scatter of 48 degrees of freedom a channel is known to 10%.
    ratio = (averaged["intensity_error"] / once["intensity_error"]).values * np.sqrt(3.0)
    assert 0.7 < float(np.median(ratio)) < 1.5
    stated = pb.from_goniometer("Is", "Ip", table=scans, angle="angle", relative_error=0.02)
    assert stated.attrs["relative_error"] == 0.02
    assert (stated["q_error"] > averaged["q_error"]).all()


# Further kinds: the readings of the clean plate, as other programs write them.

ROWS = [line.split(",") for line in (CASES / "clean_plate.csv").read_text().splitlines()[1:]]


def _joined(separator: str, rows: list[list[str]], *before: str) -> str:
    return "\r\n".join([*before, *(separator.join(row) for row in rows)]) + "\r\n"


def _workbook() -> bytes:
    """A workbook with an empty first sheet, numbers as numbers and a line of units."""
    book = openpyxl.Workbook()
    sheet = book.create_sheet("scan")
    for row in (["angle", "Is", "Ip"], ["deg", "mV", "mV"], *(map(float, row) for row in ROWS)):
        sheet.append(list(row))
    file = io.BytesIO()
    book.save(file)
    return file.getvalue()


BOTH_SIDES = [[sign + angle, s, p] for sign in ("", "-") for angle, s, p in ROWS]
FURTHER: dict[str, tuple[str | bytes, tuple[str, ...], str]] = {
    "a logger": (
        _joined("\t", [*ROWS[:9], ["angle", "Is", "Ip"], *ROWS[9:]], "Logger 7, 3.5.2021",
                "Operator\tN. N.", "angle\tIs\tIp", "(°)\t(mV)\t(mV)"),
        (),
        "2 lines above the names left out (number 1, 2); 1 line of units left out (number 4); "
        "1 line that repeats the names left out (number 14)",
    ),
    "Unicode text of a spreadsheet": (
        _joined("\t", ROWS, "angle\tIs\tIp").encode("utf-16"), (), "the text was read as UTF-16",
    ),
    "numpy.savetxt": (_joined(" ", ROWS, "# plate 3", "# angle Is Ip"), (), ""),
    "statistics below": (
        _joined(";", [*ROWS, ["Mean:", "1", "2"], ["SD", "3", "4"]], "angle;Is;Ip"),
        (),
        "2 lines of statistics in place of angle left out (number 27, 28)",
    ),
    "both sides of the normal": (
        _joined(",", BOTH_SIDES, "angle,Is,Ip").replace("-", "\N{MINUS SIGN}"),
        ("--angle-is", "incidence"),
        "50 readings of s, repeated at 25 angles, averaged",
    ),
    "marks of other countries": (
        _joined(";", [[a, f"{float(s):,.2f}".translate(str.maketrans(",.", "'.")), p]
                      for a, s, p in ROWS], "angle;Is;Ip"),
        (),
        "numbers freed of marks for thousands",
    ),
    "a workbook": (_workbook(), (), "sheet 'scan' was read; 1 line of units left out (number 2)"),
}  # fmt: skip


@each("kind", FURTHER)
def test_further_kinds_hold_the_same_readings(kind, tmp_path, capsys):
    content, words, done = FURTHER[kind]
    table = tmp_path / ("t.xlsx" if kind == "a workbook" else "t.csv")
    table.write_bytes(content if isinstance(content, bytes) else content.encode())
    assert read(table, GONIOMETER, (*COLUMNS, *words), tmp_path / "x.nc") == 0
    told = capsys.readouterr()
    assert done in told.out
    assert not told.err
    plain = pb.from_goniometer("Is", "Ip", table=CASES / "clean_plate.csv", angle="angle")
    found = pb.load_capture(tmp_path / "x.nc")
    xr.testing.assert_allclose(found[["q", "intensity"]], plain[["q", "intensity"]])


FITTED = {
    "dolp_zero_one.csv": 1.5,
    "three_scans.csv": 1.5,
    "half_blank.csv": 1.5,
    "psi_delta.csv": 1.5,
    "mueller.csv": 1.5,
    "clean_plate.csv": 1.5,
}
"""Tables that differ in what their fits read, and their index."""


@pytest.mark.thorough
@pytest.mark.parametrize("name", FITTED)
def test_a_fit_holds_the_index_and_is_content(name, tmp_path, capsys):
    command, words, _ = KINDS[name]
    assert read(CASES / name, command, words, tmp_path / "x.nc") == 0
    capsys.readouterr()
    status = main(["fit", str(tmp_path / "x.nc"), "--json", "--out", str(tmp_path / "fit.nc")])
    told = capsys.readouterr()
    found = json.loads(told.out)["parameters"]["refractive_index"]
    assert found["q2.5"] < FITTED[name] < found["q97.5"]
    assert status == 0, told.err


@pytest.mark.thorough
@pytest.mark.parametrize("channel", ["s", "p", "unpolarized"])
def test_one_channel_of_a_mirror_determines_its_index(channel, tmp_path, capsys):
    """Brightness alone, with an exposure that nobody knows."""
    table = tmp_path / "one.csv"
    light = {"s": 1, "p": 2}
    rows = (
        f"{row[0]},{row[light[channel]] if channel in light else float(row[1]) + float(row[2])}"
        for row in ROWS
    )
    table.write_text("\n".join(["angle,I", *rows]))
    out = tmp_path / "x.nc"
    words = ("--angle", "angle", f"--{channel}", "I", "--relative-error", ".002")
    assert read(table, GONIOMETER, words, out) == 0
    capsys.readouterr()
    assert fitted(out) == 0
    found = json.loads(capsys.readouterr().out)["parameters"]["refractive_index"]
    assert abs(found["mean"] - 1.5) < 3.3 * found["sd"]  # missed once in a thousand plates
    assert found["sd"] < 0.02
