"""Do intervals hold where the set-up is off by what it is known to: without, and with its budget?

    python benchmarks/setup_budget.py camera --captures 90

Materials of one color are simulated in a set-up; each quantity of its budget is off by an amount
drawn from its standard uncertainty, so that the capture states wrong angles or readings. Every
capture is fitted. Prints for each parameter of the material how often the central 95% interval of
the posterior holds the truth, how often the mean is within 1.96 combined standard uncertainties of
it, with Wilson's intervals, and the median factor by which the set-up widens the uncertainty.
"""

import argparse
from collections import defaultdict

import numpy as np
import xarray as xr
from scipy import stats

import polar_bayes as pb
from polar_bayes.setups import SETUPS
from polar_bayes.simulation import PRESETS, Protocol


def recorded(capture: xr.Dataset, scene: str, rng: np.random.Generator) -> xr.Dataset:
    """What an instrument records that is off, with the angles that its user states."""
    for quantity in SETUPS[scene].known:
        if quantity.acts_on(capture):
            # Off by so much, it records what is shifted back from the truth, to first order.
            amount = quantity.standard_uncertainty * rng.normal()
            capture = quantity.shifted(capture, -amount)
    return capture


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", choices=[name for name, own in SETUPS.items() if own.known])
    parser.add_argument("--captures", type=int, default=90)
    parser.add_argument("--method", default="importance")
    asked = parser.parse_args()
    held: dict[str, list[tuple[bool, bool, float]]] = defaultdict(list)
    for seed in range(asked.captures):
        rng = np.random.default_rng([seed, 53])
        material = list(PRESETS)[seed % len(PRESETS)]
        protocol = Protocol(views=24, wavelengths=())
        perfect = pb.simulate(material, scene=asked.scene, protocol=protocol, seed=seed)
        fit = pb.fit(recorded(perfect, asked.scene, rng), scene=asked.scene, method=asked.method)
        table, summary = pb.budget(fit), pb.summary(fit)
        for name in table.index:
            truth, row = float(perfect[f"true_{name}"]), summary.loc[name]
            combined = table.loc[name, "combined"]
            held[name].append(
                (
                    row["q2.5"] <= truth <= row["q97.5"],
                    abs(row["mean"] - truth) < 1.96 * combined,
                    combined / table.loc[name, "sd"],
                )
            )
    print("| parameter | captures | 95% interval holds | with the set-up | factor |")
    print("|---|---|---|---|---|")
    for name, rows in held.items():
        alone, combined, factor = zip(*rows, strict=True)
        shares = [_share(sum(each), len(rows)) for each in (alone, combined)]
        print(f"| {name} | {len(rows)} | {shares[0]} | {shares[1]} | {np.median(factor):.2f} |")


def _share(count: int, of: int) -> str:
    low, high = stats.binomtest(int(count), of).proportion_ci(method="wilson")
    return f"{count / of:.2f} [{low:.2f}, {high:.2f}]"


if __name__ == "__main__":
    main()
