"""Results that a change of the code must not change: the numbers of one fit of each kind.

    python tests/test_golden.py            print what differs from tests/golden.json, and how far
    python tests/test_golden.py --write    take the present numbers as the golden ones

Optimized results agree to the tolerance of their optimizers. Sampled results depend on the order of
additions through every draw, so they may differ by Monte Carlo error: the stored standard errors
say how much. Numbers change only with a reason, which the commit that changes them states.
"""

import json
import sys
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
import pytest
import xarray as xr
from compilations import compile_anew

import polar_bayes as pb
from polar_bayes.inference.program import PRIOR_DRAWS
from polar_bayes.numerics.optimize import SETTLED

STORED = Path(__file__).with_suffix("").with_name("golden.json")
TIGHT, SAMPLED = 1e-5, 5.0
"""Relative difference of optimized results; standard errors of sampled ones (1 in 10^6)."""

# The `effects` are differences of Laplace approximations by central differences. The log density,
# -70 at the mode, is rounded by 3 units in the last place at most. The differences divide that by
# the step of the gradient, 1e-3, and by that of the Hessian, eps^(1/4), both in posterior sds, and
# the ratio of two sds has half the relative error of either Hessian. Changes below that are 0.
EPS = float(np.finfo(float).eps)
NO_CHANGE = 3.0 * EPS * 70.0 / (1e-3 * EPS**0.25)
"""About 4e-7: changes of a posterior sd, relative, of which nothing but rounding is known."""


def capture(views: int = 16, wavelengths: tuple[float, ...] = (), seed: int = 3):
    protocol = pb.simulation.Protocol(views=views, wavelengths=wavelengths)
    return pb.simulate("leaf", seed=seed, protocol=protocol)


def several(dim: str, count: int, views: int):
    """Captures of the first seeds, side by side."""
    kept = {"data_vars": "all", "coords": "minimal", "compat": "override", "join": "override"}
    return xr.concat([capture(views, seed=seed) for seed in range(count)], dim, **kept)


def materials():
    return several("material", 3, 10).assign_coords(material=["a", "b", "c"])


def image():
    index = {"y": ("pixel", [0, 0, 0, 1, 1, 1]), "x": ("pixel", [0, 1, 2, 0, 1, 2])}
    whole = several("pixel", 6, 12).assign_coords(index)
    found = whole.set_index(pixel=("y", "x")).unstack("pixel")
    return found.transpose("y", "x", ...).assign_attrs(capture(12).attrs)


def numbers_of(result) -> dict[str, tuple[float, float]]:
    """Mean and standard deviation of every parameter, each with its Monte Carlo standard error."""
    found = {}
    for name, row in pb.diagnostics.json_summary(result)["parameters"].items():
        if row["sd"] is None:  # the readings do not determine it
            continue
        error = row["sd"] / max(row.get("ess_bulk") or 400.0, 1.0) ** 0.5
        found[f"{name} mean"] = (row["mean"], error)
        found[f"{name} sd"] = (row["sd"], error)
    return found


def of_fit(make: Callable = capture, **settings):
    return lambda: numbers_of(pb.fit(make(), seed=1, **settings))


def map_of(**settings):
    def run():
        maps, found = pb.fit_pixels(image(), seed=1, **settings), {}
        for name in ("roughness", "subsurface_fraction", "absorption", "refractive_index"):
            means, sds = (np.asarray(maps[each]).ravel() for each in (name, f"{name}_sd"))
            for at, (mean, sd) in enumerate(zip(means[:3], sds, strict=False)):
                error = float(sd) / 256.0**0.5  # of so many draws
                found[f"{name} mean {at}"] = (float(mean), error)
                found[f"{name} sd {at}"] = (float(sd), error)
        return found

    return run


def calibration():
    tree = pb.calibrate(capture(8), simulations=40, method="laplace", seed=1, readings=False)
    ranks = np.asarray(tree["prior_sbc"].ds.to_dataarray(), float).ravel()
    one = 1.0 / 2001.0 / SAMPLED  # by rounding a draw, of 2,000, may lie on a truth's other side
    return {f"rank {at}": (float(x), one) for at, x in enumerate(ranks[:40])}


def finite_numbers(found, most: int | None = None, first: int | None = None):
    """The finite numbers of a dataset: of variables with `most` at most, the `first` of each."""
    return {
        f"{name} {at}": (float(x), 0.0)
        for name, values in found.data_vars.items()
        if values.dtype.kind == "f" and (most is None or values.size <= most)
        for at, x in enumerate(np.asarray(values, float).ravel()[:first])
        if np.isfinite(x)
    }


def identification():
    return finite_numbers(pb.identify(capture(10), seed=1), most=64)


def curve():
    """Heights are differences of two searches, each within half of SETTLED squared of its peak."""
    numbers = finite_numbers(pb.profile(capture(10), "refractive_index", seed=1), first=24)
    beside = 1.5 / PRIOR_DRAWS  # by rounding one draw, not two, may lie on an end's other side
    known = {"profile": SETTLED**2, "prior_beyond": beside}
    return {name: (x, known.get(name.split()[0], 0) / SAMPLED) for name, (x, _) in numbers.items()}


def views():
    return finite_numbers(pb.next_views(capture(8), seed=1), most=64)


def effects():
    ledger = pb.choose_effects(capture(10, (450.0, 650.0)), seed=1).ledger
    kept = np.asarray(ledger["kept"]).ravel()
    numbers = finite_numbers(ledger[["change", "shift"]])
    return numbers | {f"kept {at}": (float(x), 0.0) for at, x in enumerate(kept)}


QUICK_NUTS = pb.methods.Nuts(warmup=200, draws=500, most_draws=500, chains=2)
CASES: dict[str, Callable] = {
    "point": of_fit(method="point"),
    "laplace": of_fit(method="laplace"),
    "nuts": of_fit(method=QUICK_NUTS),
    "importance": of_fit(method=pb.methods.Importance()),
    "auto": of_fit(method="auto"),
    "hierarchical": of_fit(materials, model="hierarchical", method=QUICK_NUTS),
    "gp_spectral": of_fit(
        lambda: capture(10, (450.0, 550.0, 650.0)), model="gp_spectral", method=QUICK_NUTS
    ),
    "map laplace": map_of(),
    "map importance": map_of(method="importance"),
    "calibration": calibration,
    "identify": identification,
    "profile": curve,
    "next views": views,
    "effects": effects,
}
OPTIMIZED = {"point", "identify", "next views", "effects"}


def differences(case: str, found: dict, stored: dict) -> list[str]:
    """The numbers that differ by more than their tolerance."""
    assert found.keys() == stored.keys()
    wrong = []
    for name, (value, error) in found.items():
        was, error_then = stored[name]
        limit = SAMPLED * np.hypot(error, error_then) if case not in OPTIMIZED else 0.0
        limit = max(limit, TIGHT * max(abs(value), abs(was), 1e-3))
        if case == "effects" and name.startswith("change") and max(value, was) <= NO_CHANGE:
            limit = NO_CHANGE
        if not abs(value - was) <= limit:
            wrong.append(f"{case}: {name}: {was:.8g} -> {value:.8g} (allowed {limit:.2g})")
    return wrong


@pytest.fixture(autouse=True)
def own_programs(monkeypatch) -> None:
    """Let each case start with none: together they are more than a process can hold."""
    compile_anew(monkeypatch)


@pytest.mark.thorough
@pytest.mark.parametrize("case", CASES)
def test_results_are_as_before(case):
    assert not differences(case, CASES[case](), json.loads(STORED.read_text())[case])


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    write = "--write" in sys.argv
    names = [name for name in CASES if name in sys.argv] or list(CASES)
    numbers = json.loads(STORED.read_text()) if STORED.is_file() else {}
    for case in names:
        found = json.loads(json.dumps(CASES[case]()))
        if write:
            numbers[case] = found
            STORED.write_text(json.dumps(numbers, indent=0) + "\n")
            print(case, len(found), flush=True)
        else:
            far = max((abs(v - numbers[case][n][0]) for n, (v, _) in found.items()), default=0.0)
            wrong = differences(case, found, numbers[case])
            print(
                f"{case:<14}{len(found):5d} numbers, largest difference {far:.3g}",
                *wrong,
                sep="\n  ",
                flush=True,
            )
