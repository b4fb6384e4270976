"""The chosen effects against all effects: differences of the posterior, and the speed-up.

    python benchmarks/effects.py [glass plastic leaf paint]

Four scenes, each simulated with everything on and fitted by NUTS twice. Prints Markdown tables;
takes some tens of minutes.
"""

import dataclasses
import sys
import time
from typing import Any

import jax
import numpy as np
import xarray as xr
from effect_costs import gradients

import polar_bayes as pb
from polar_bayes.inference.result import provenance_of
from polar_bayes.physics.scene import FULL_SCENES, MANY_FACETS
from polar_bayes.scenes.effects import ledger_table

METHOD = pb.methods.Nuts(draws=1000, most_draws=4000, ess=1500)

PAINT = pb.Scene(
    surface=pb.RoughSurface(
        pb.Beckmann(),
        pb.PointSource(),
        MANY_FACETS,
        shadowing=pb.physics.HeightCorrelatedShadowing(),
    ),
    subsurface=pb.Lambertian(internal_reflection=pb.physics.InternalReflection()),
    mixing=pb.StokesMixing(),
    coat=pb.ClearCoat(1.49, 0.05),  # the lacquer of a data sheet
    instrument=pb.instrument.Instrument(
        (pb.instrument.AngleZero(), pb.instrument.DolpGain(), pb.instrument.DarkLevel())
    ),
)


@dataclasses.dataclass(frozen=True)
class Case:
    """One of the four cases.

    Args:
        preset: Material to simulate.
        setup: Set-up whose links describe the noise.
        scene: Everything on.
        protocol: Where to look from.
        truth: Parameters that the material does not have.
    """

    preset: str
    setup: str
    scene: pb.Scene
    protocol: pb.simulation.Protocol
    truth: dict[str, Any]

    def capture(self) -> xr.Dataset:
        """Readings of known truth."""
        captured = pb.simulate(
            self.preset,
            scene=self.scene,
            links=pb.setups.SETUPS[self.setup].links,
            protocol=self.protocol,
            parameters=self.truth,
            seed=1,
        )
        return captured.assign_attrs(setup=self.setup)


ONE_COLOR = pb.simulation.Protocol(wavelengths=())
CASES = {
    "glass": Case(
        "glass",
        "goniometer",
        FULL_SCENES["goniometer"],
        pb.simulation.MirrorScan(
            smallest_view_zenith=15.0, largest_view_zenith=78.0, wavelengths=()
        ),
        {
            "angle_zero": 0.2,
            "leakage": 0.005,
            "channel_gain_ratio": 1.02,
            "beam_overlap_zenith": 82.0,
            "discrepancy_amplitude": 0.03,
            "discrepancy_weights": np.asarray([0.5, -0.5, 0.5]),
        },
    ),
    "plastic": Case(
        "plastic",
        "camera",
        FULL_SCENES["camera"],
        ONE_COLOR,
        {"roughness": 0.25, "angle_zero": 0.2, "dolp_gain": 0.97, "dark_level": 0.0005},
    ),
    "leaf": Case(
        "leaf", "paper", FULL_SCENES["paper"], ONE_COLOR, {"angle_zero": 0.2, "dark_level": 0.0005}
    ),
    "paint": Case(
        "coating",
        "camera",
        PAINT,
        ONE_COLOR,
        {
            "roughness": 0.15,
            "subsurface_fraction": 0.4,
            "angle_zero": 0.2,
            "dolp_gain": 0.97,
            "dark_level": 0.0005,
        },
    ),
}


def fit(data: xr.Dataset, scene: pb.Scene) -> tuple[Any, float, bool]:
    """The table of parameters, seconds of search and sampling, and whether the fit converged."""
    result = pb.fit(data, scene=scene, method=METHOD, seed=0)
    timings = provenance_of(result)["timings"]
    return pb.summary(result), timings["modes"] + timings["draws"], pb.verdict(result).passed


def run(name: str) -> None:
    """Choose effects, fit twice, and print the result."""
    case = CASES[name]
    data = case.capture()
    begin = time.perf_counter()
    chosen = pb.choose_effects(data, scene=case.scene)
    choosing = time.perf_counter() - begin
    plain = dataclasses.replace(chosen)
    full_cost, chosen_cost = gradients([case.scene, plain], data)
    (full, full_seconds, full_ok), (less, less_seconds, less_ok) = (
        fit(data, case.scene),
        fit(data, plain),
    )
    print(f"\n### {name}\n\n```text\n{ledger_table(chosen.ledger).to_string()}\n```\n")
    print("| parameter | shift [sd] | error of it | sd ratio |\n|---|---|---|---|")
    for label in full.index.intersection(less.index, sort=False):
        one, other = full.loc[label], less.loc[label]
        shift = (other["mean"] - one["mean"]) / one["sd"]
        error = np.hypot(other["mcse_mean"], one["mcse_mean"]) / one["sd"]
        print(f"| {label} | {shift:+.3f} | {error:.3f} | {other['sd'] / one['sd']:.3f} |")
    print(
        f"\n| {name} | everything | chosen | ratio |\n|---|---|---|---|\n"
        f"| one gradient | {1e3 * full_cost.run_seconds:.2f} ms "
        f"| {1e3 * chosen_cost.run_seconds:.2f} ms "
        f"| {full_cost.run_seconds / chosen_cost.run_seconds:.1f} |\n"
        f"| fit | {full_seconds:.0f} s | {less_seconds:.0f} s "
        f"| {full_seconds / less_seconds:.1f} |\n"
        f"| converged | {full_ok} | {less_ok} | |\n"
        f"| choosing | | {choosing:.0f} s | |",
        flush=True,
    )


def main() -> None:
    """Run the selected cases."""
    jax.config.update("jax_enable_x64", True)
    for name in sys.argv[1:] or CASES:
        run(name)


if __name__ == "__main__":
    main()
