"""Coverage of intervals with errors of the set-up as large as stated, and in a perfect set-up.

    python benchmarks/setup_budget.py camera --captures 90

Materials of one color are simulated in a set-up whose input quantities are off by amounts drawn
from their priors, or in a perfect one. Every capture is fitted twice: as a set-up that is known
perfectly, and with its input quantities. Prints for each parameter of the material how often the
central 95% interval holds the truth, with Wilson's intervals, how wide the interval with the
quantities is beside the other one (median), and how many verdicts are a problem or flagged. With
`--calibrate`, truths are drawn from the priors instead (simulation-based calibration).
"""

import argparse
import dataclasses
from collections import defaultdict

import jax
import numpy as np
from scipy import stats

import polar_bayes as pb
from polar_bayes.physics.scene import MATERIAL_PARAMETERS
from polar_bayes.setups import SETUPS
from polar_bayes.simulation import PRESETS, Protocol


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", choices=[name for name, own in SETUPS.items() if own.known])
    parser.add_argument("--captures", type=int, default=90)
    parser.add_argument("--method", default="importance")
    parser.add_argument("--perfect", action="store_true", help="The instrument has no error.")
    parser.add_argument("--calibrate", action="store_true", help="Draw truths from the priors.")
    asked = parser.parse_args()
    protocol = Protocol(views=24, wavelengths=())
    if asked.calibrate:
        layout = pb.simulate("leaf", scene=asked.scene, protocol=protocol, seed=0)
        found = pb.calibrate(layout, method=asked.method, simulations=asked.captures, seed=0)
        print(pb.summary(found).filter(like="held_95"), *pb.verdict(found).sentences, sep="\n")
        return
    setup = SETUPS[asked.scene]
    known_perfectly = dataclasses.replace(setup, known=())
    real = dataclasses.replace(setup, scene=setup.scene.known_to(setup.known))
    held: dict[str, list[tuple[bool, bool, float]]] = defaultdict(list)
    judged: dict[str, list[tuple[bool, bool]]] = defaultdict(list)
    for seed in range(asked.captures):
        material = list(PRESETS)[seed % len(PRESETS)]
        offsets = {} if asked.perfect else drawn(setup.known, seed)
        capture = pb.simulate(
            material, scene=real, parameters=offsets, protocol=protocol, seed=seed
        )
        capture.attrs["setup"] = asked.scene
        tables = []
        for name, scene in (("perfect", known_perfectly), ("known", setup)):
            fit = pb.fit(capture, scene=scene, method=asked.method)
            verdict = pb.verdict(fit)
            judged[name].append((bool(verdict.problems), bool(verdict.cautions)))
            tables.append(pb.summary(fit))
        for name in (n for n in MATERIAL_PARAMETERS if n in tables[0].index):
            truth = float(capture[f"true_{name}"])
            ends = [table.loc[name, ["q2.5", "q97.5"]].to_numpy() for table in tables]
            widths = [np.ptp(each) for each in ends]
            within = (bool(low <= truth <= high) for low, high in ends)
            held[name].append((*within, widths[1] / widths[0]))
        print(".", end="", flush=True)
    print("\n| parameter | captures | holds, set-up perfect | holds, set-up known | width |")
    print("|---|---|---|---|---|")
    for name, rows in held.items():
        perfect, known, width = zip(*rows, strict=True)
        shares = [_share(sum(each), len(rows)) for each in (perfect, known)]
        print(f"| {name} | {len(rows)} | {shares[0]} | {shares[1]} | {np.median(width):.2f} |")
    for name, each in judged.items():
        problems, cautions = (_share(sum(kind), len(each)) for kind in zip(*each, strict=True))
        print(f"set-up {name}: with a problem {problems}, with a caution {cautions}")


def drawn(known: tuple, seed: int) -> dict[str, float]:
    """Offsets of the input quantities, from their priors."""
    names = [name for quantity in known for name in quantity.parameters]
    keys = jax.random.split(jax.random.key(seed), len(names))
    return {n: float(pb.PRIORS[n].sample(key)) for n, key in zip(names, keys, strict=True)}


def _share(count: int, of: int) -> str:
    low, high = stats.binomtest(int(count), of).proportion_ci(method="wilson")
    return f"{count / of:.2f} [{low:.2f}, {high:.2f}]"


if __name__ == "__main__":
    main()
