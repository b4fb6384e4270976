"""Cost of each effect: compilation, operations and time of one gradient, on against off.

    python benchmarks/effect_costs.py

Every effect of five scenes is switched on alone in the plain scene that is left when all are off.
Prints a Markdown table.
"""

import argparse
import dataclasses

import jax
import numpy as np
import xarray as xr

import polar_bayes as pb
from polar_bayes.inference.program import compile_program
from polar_bayes.inference.request import resolve
from polar_bayes.observation.data import observe
from polar_bayes.physics.scene import MANY_FACETS
from polar_bayes.physics.variants import Effect, effects_of, simplify
from polar_bayes.scenes.posterior_change import compile_and_count, run_seconds

FILM, COAT = pb.ThinFilm(1.38, 120.0), pb.ClearCoat(1.5, 0.05)

ROUGH = pb.Scene(
    surface=pb.RoughSurface(
        pb.Beckmann(),
        pb.Disc(5.0),
        MANY_FACETS,
        pb.physics.AnisotropicSlopes(),
        pb.physics.HeightCorrelatedShadowing(),
    ),
    subsurface=pb.Lambertian(internal_reflection=pb.physics.InternalReflection()),
    mixing=pb.StokesMixing(),
    coat=COAT,
    instrument=pb.instrument.Instrument(
        (
            pb.instrument.AngleZero(),
            pb.instrument.BeamOverlap(),
            pb.instrument.DolpGain(),
            pb.instrument.ChannelGain(),
            pb.instrument.Leakage(),
            pb.instrument.DarkLevel(),
            pb.instrument.Discrepancy(),
        )
    ),
)
# Without a body: light enters one under filmed facets through facets only.
FILMED = pb.Scene(pb.RoughSurface(), coat=FILM)

POLARIZED = pb.Scene(
    surface=pb.RoughSurface(
        illumination=pb.PointSource(pb.physics.LinearPolarization(0.5, 30.0)),
        quadrature=pb.physics.FacetQuadrature(5, 4),
        way_out=pb.physics.SmoothExit(),
    ),
    subsurface=pb.Unpolarized(),
    mixing=pb.StokesMixing(),
)

TURBID = pb.Scene(
    surface=pb.RoughSurface(
        quadrature=pb.physics.FacetQuadrature(5, 4), way_out=pb.physics.SmoothExit()
    ),
    subsurface=pb.TurbidMedium(internal_reflection=None),
    mixing=pb.StokesMixing(),
)
FORWARD = dataclasses.replace(
    TURBID, subsurface=pb.Depolarizer(None, pb.physics.HenyeyGreenstein())
)


def capture() -> xr.Dataset:
    """Forty views in three colors, with q, u and intensity."""
    return pb.simulate("plastic", scene="camera", seed=0)


def gradients(scenes: list[pb.Scene], data: xr.Dataset) -> list[tuple[float, float, float]]:
    """Operations, compile and run seconds of a log density with its gradient, by scene."""
    compiled, calls = [], []
    for scene in scenes:
        # The set-up of the capture would add its input quantities to every scene.
        arguments = (data, "per_material", scene, None, None, None, 0, "double")
        request = resolve(*arguments, shared=())
        readings = observe(request.capture, largest_view_zenith=request.largest_view_zenith)
        program = compile_program(request.bind(), readings)
        z = np.zeros(program.size)
        compiled.append(compile_and_count(jax.value_and_grad(program.potential), z, readings))
        calls.append(lambda call=compiled[-1][0], z=z, readings=readings: call(z, readings))
    return [
        (operations, compile_seconds, seconds)
        for (_, operations, compile_seconds), seconds in zip(
            compiled, run_seconds(calls), strict=True
        )
    ]


def plain_with(scene: pb.Scene, effect: Effect | None) -> pb.Scene:
    """The scene with all its effects off but one."""
    off = {other.key_path: other for other in effects_of(scene)}
    if effect is not None:
        del off[effect.key_path]
    return simplify(scene, off.values())


def table(scene: pb.Scene, data: xr.Dataset) -> list[str]:
    """A row for the plain scene and one for each effect switched on."""
    effects = list({effect.key_path: effect for effect in effects_of(scene)}.values())
    costs = gradients([plain_with(scene, effect) for effect in (None, *effects)], data)
    plain_operations, _, plain_seconds = costs[0]
    lines = []
    names = ("none", *(type(effect.part).__name__ for effect in effects))
    for name, (operations, compilation, seconds) in zip(names, costs, strict=True):
        lines.append(
            f"| {name} | {operations:,.0f} | {operations / plain_operations:.2f} "
            f"| {compilation:.1f} s | {1e3 * seconds:.3f} ms | {seconds / plain_seconds:.2f} |"
        )
    return lines


def main() -> None:
    """Print the table."""
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    jax.config.update("jax_enable_x64", True)
    data = capture()
    print("| effect on | operations | ratio | compilation | one gradient | ratio |")
    print("|---|---|---|---|---|---|")
    for scene in (ROUGH, FILMED, POLARIZED, TURBID, FORWARD):
        print("\n".join(table(scene, data)), flush=True)


if __name__ == "__main__":
    main()
