"""How often `method="auto"` meets its tolerance, and whether it reports when it does not.

    python benchmarks/auto_method.py 200 --keep FOLDER      half plates, half rough bodies

Parameters are drawn from the prior, captures from the model; each is fitted by the automatic
choice and judged by a reference of its own. Fits are kept in the folder, and gone on with.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
import scipy.stats
from accuracy_scenes import CASES, Case
from jaxtyping import Array

import polar_bayes as pb
from polar_bayes.benchmark.reference import distances, run_reference
from polar_bayes.benchmark.run import labeled
from polar_bayes.calibration.runner import draw_captures
from polar_bayes.inference.problem import CompiledModel, Problem, make_problem
from polar_bayes.inference.request import resolve
from polar_bayes.observation.data import Observations
from polar_bayes.progress import no_progress

LAYOUTS = ("smooth glass, 6 views", "leaf, 40 views")
REFERENCE = pb.benchmark.Reference(error=0.02)
CHUNK = 10
RUNGS = ("importance", "nuts")


def fit_some(case: Case, numbers: np.ndarray, auto: pb.methods.Auto) -> list[dict[str, Any]]:
    """The automatic choice and the reference of some simulated captures."""
    layout = case.capture(seed=0)
    request = resolve(layout, "per_material", case.scene, None, case.links, None, 0, "double")
    key = jax.random.key(7)
    base = make_problem(request, key)
    drawn = draw_captures(base.program, base.data, np.resize(numbers, CHUNK), key)
    found = []
    for at, number in enumerate(numbers):
        data = drawn.captures.pixel(at)
        own = jax.random.fold_in(key, int(number))
        found.append({"number": int(number), **_judged(base.compiled_model, data, own, auto)})
        print(found[-1], flush=True)
    return found


def _judged(
    model: CompiledModel, data: Observations, key: Array, auto: pb.methods.Auto
) -> dict[str, Any]:
    key_search, key_draws = jax.random.split(key)
    problem = Problem(model, data, key_search)
    begin = time.perf_counter()
    draws_of_auto = auto.run(problem, key_draws, no_progress)
    seconds = time.perf_counter() - begin
    key_search, key_draws = jax.random.split(jax.random.fold_in(key, 9))
    reference_run = run_reference(REFERENCE, Problem(model, data, key_search), key_draws)
    _, draws = labeled(problem, draws_of_auto.z)
    flat, reference = (x.reshape(len(x), -1) for x in (draws, reference_run.draws))
    apart = distances(flat, reference)
    error = float(np.max(np.abs([apart["mean_error"], apart["sd_error"]])))
    return {
        "error": error,
        "seconds": seconds,
        "chosen": draws_of_auto.metadata["auto"]["chosen"],
        "said_met": draws_of_auto.metadata["auto"]["met"],
        "expected": draws_of_auto.metadata["auto"]["expected_error"],
        "reference_error": reference_run.error,
        "reference_doubts": list(reference_run.doubts),
    }


def kept(folder: Path, name: str, count: int, auto: pb.methods.Auto) -> list[dict[str, Any]]:
    """All fits of a layout: those of the folder, and those that are still missing."""
    file = folder / f"{name.split(',')[0].replace(' ', '_')}.jsonl"
    there = [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []
    missing = np.setdiff1d(np.arange(count), [fit["number"] for fit in there])
    for begin in range(0, len(missing), CHUNK):
        some = fit_some(CASES[name], missing[begin : begin + CHUNK], auto)
        with file.open("a") as lines:
            lines.writelines(f"{json.dumps(fit)}\n" for fit in some)
        there += some
    return [fit for fit in there if fit["number"] < count]


def say(name: str, fits: list[dict[str, Any]], tolerance: float) -> None:
    """Print one row of the table."""
    sound = [fit for fit in fits if not fit["reference_doubts"]]
    within = [fit["error"] <= tolerance for fit in sound]
    flagged = [not fit["said_met"] for fit in sound]
    no_progress = sum(not a and not b for a, b in zip(within, flagged, strict=True))
    low, high = scipy.stats.binomtest(sum(within), len(sound)).proportion_ci(method="wilson")
    chosen = {rung: sum(fit["chosen"] == rung for fit in fits) for rung in RUNGS}
    taken = ", ".join(f"{count} {rung}" for rung, count in chosen.items() if count)
    median = float(np.median([fit["seconds"] for fit in fits]))
    print(
        f"| {name} | {len(sound)} of {len(fits)} | {np.mean(within):.1%} [{low:.1%}, {high:.1%}] "
        f"| {sum(flagged)} | {no_progress} | {taken} | {median:.1f} |"
    )


def main(count: int, keep: Path, tolerance: float, seconds: float) -> None:
    """Fit what is missing, and print the table."""
    jax.config.update("jax_enable_x64", True)
    keep.mkdir(parents=True, exist_ok=True)
    auto = pb.methods.Auto(tolerance=tolerance, seconds=seconds)
    each = -(-count // len(LAYOUTS))
    every = {name: kept(keep, name, each, auto) for name in LAYOUTS}
    print("\n| layout | sound reference | within | flagged | missed unflagged | taken | median s |")
    print("|---|---|---|---|---|---|---|")
    for name, fits in every.items():
        say(name, fits, tolerance)
    say("all", [fit for fits in every.values() for fit in fits], tolerance)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("count", type=int)
    parser.add_argument("--keep", type=Path, required=True)
    parser.add_argument("--tolerance", type=float, default=0.1)
    parser.add_argument("--seconds", type=float, default=60.0)
    arguments = parser.parse_args()
    main(arguments.count, arguments.keep, arguments.tolerance, arguments.seconds)
