"""Error against time of every method, for six captures from easy to hard.

    python benchmarks/accuracy_front.py --keep FOLDER            all six; takes hours
    python benchmarks/accuracy_front.py --keep FOLDER --quick    methods alone, no overrides
    python benchmarks/accuracy_front.py --keep FOLDER --only 1   the first alone

Every trial runs in a process of its own, so nothing else should run beside. A finished scene is
kept in the folder and not measured again. Draws docs/figures/accuracy_front.png and writes the
table of docs/accuracy.md, between the lines that say so. The advice is then tried on another
capture of each scene, which it has not seen.
"""

import argparse
import os
import platform
from pathlib import Path

import jax
import numpy as np
import xarray as xr
from accuracy_scenes import CASES, Case
from matplotlib.figure import Figure

import polar_bayes as pb
from polar_bayes.benchmark.accuracy import AS_GIVEN
from polar_bayes.benchmark.advice import accuracy_table, accuracy_view, time_column
from polar_bayes.reporting.accuracy import front_panel
from polar_bayes.reporting.style import styled

ROOT = Path(__file__).parents[1]
PICTURE = ROOT / "docs" / "figures" / "accuracy_front.png"
PAGE = ROOT / "docs" / "accuracy.md"
BEGIN, END = "<!-- gallery: begin -->\n", "<!-- gallery: end -->\n"
TOLERANCE = 0.1


def study(name: str, case: Case, number: int, keep: Path, quick: bool) -> xr.DataTree:
    """Return the study of one scene, measured now or loaded."""
    file = keep / f"{number}{'-quick' if quick else ''}.nc"
    if not file.exists():
        asked = {"overrides": ()} if quick else {}
        found = pb.accuracy(
            case.capture(seed=1),
            scene=case.scene,
            links=case.links,
            progress=lambda stage, done: print(f"{name}: {stage} {done:.0%}", flush=True),
            **asked,
        )
        pb.save(found, file)
    return pb.load(file)


def tried(case: Case, found: xr.DataTree, number: int, keep: Path) -> tuple[str, float]:
    """The fastest good method on a capture that the advice has not seen, and its error there."""
    table = accuracy_table(found)
    seconds = table[time_column(table)]
    good = (table["override"] == AS_GIVEN) & (table["error"] <= TOLERANCE) & seconds.notna()
    if not good.any():
        return "none", np.nan
    method = str(seconds[good].idxmin())
    file = keep / f"{number}-tried-{method.replace(' ', '-')}.nc"
    if not file.exists():
        again = pb.accuracy(
            case.capture(seed=2),
            scene=case.scene,
            links=case.links,
            methods={method: pb.methods.STUDY_METHODS[method]},
            overrides=(),
            fresh=False,
            seed=1,
        )
        pb.save(again, file)
    return method, float(pb.summary(pb.load(file))["error"].iloc[0])


@styled
def draw(studies: dict[str, xr.DataTree]) -> Figure:
    """A panel for each scene."""
    columns = min(2, len(studies))
    rows = -(-len(studies) // columns)
    figure = Figure(figsize=(5.2 * columns, 3.7 * rows), layout="constrained")
    for at, (name, found) in enumerate(studies.items()):
        axes = figure.add_subplot(rows, columns, at + 1)
        front_panel(axes, accuracy_view(found), "seconds_first")
        axes.set_title(name, loc="left")
        axes.set_ylabel("largest error [posterior sd]" if at % columns == 0 else "")
    return figure


def table(studies: dict[str, xr.DataTree], trials: dict[str, tuple[str, float]]) -> str:
    """Errors and times of the methods, and the advice, in Markdown."""
    lines = [f"Measured on {platform.machine()}, {os.cpu_count()} cores.", ""]
    lines += [
        "| scene | " + " | ".join(pb.methods.STUDY_METHODS) + " | reference |",
        "|---" * (len(pb.methods.STUDY_METHODS) + 2) + "|",
    ]
    for name, found in studies.items():
        rows = pb.summary(found)
        noise = accuracy_view(found).resolved / 2.0
        cells = [_cell(rows, method) for method in pb.methods.STUDY_METHODS]
        lines.append(f"| {name} | " + " | ".join(cells) + f" | {noise:.2g} |")
    lines += [
        "",
        "| scene | advice | the advised method on another capture |",
        "|---|---|---|",
    ]
    for name, found in studies.items():
        method, error = trials[name]
        seen = "" if np.isnan(error) else f"{method}: {error:.2g} sd"
        advice = " ".join(pb.benchmark.accuracy_sentences(found, TOLERANCE))
        lines.append(f"| {name} | {advice} | {seen} |")
    return "\n".join(lines)


def _cell(rows, method: str) -> str:
    if method not in rows.index or np.isnan(rows.loc[method, "error"]):
        return "none"
    row = rows.loc[method]
    return f"{row['error']:.2g} ({row['seconds_first']:.0f}, {row['seconds_again']:.2g} s)"


def write(text: str) -> None:
    """Put the table between its lines in the page."""
    page = PAGE.read_text()
    before, rest = page.split(BEGIN)
    _, after = rest.split(END)
    PAGE.write_text(f"{before}{BEGIN}\n{text}\n\n{END}{after}")


def main(keep: Path, quick: bool, only: tuple[int, ...]) -> None:
    """Measure, draw and write what the options select."""
    jax.config.update("jax_enable_x64", True)
    keep.mkdir(parents=True, exist_ok=True)
    studies, trials = {}, {}
    for number, (name, case) in enumerate(CASES.items(), start=1):
        if only and number not in only:
            continue
        studies[name] = study(name, case, number, keep, quick)
        trials[name] = tried(case, studies[name], number, keep)
    text = table(studies, trials)
    print(text)
    if not only:
        PICTURE.parent.mkdir(exist_ok=True)
        draw(studies).savefig(PICTURE, dpi=110)
        write(text)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--keep", type=Path, required=True)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--only", type=int, nargs="*", default=())
    arguments = parser.parse_args()
    main(arguments.keep, arguments.quick, tuple(arguments.only))
