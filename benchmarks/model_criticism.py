"""False alarms and power of the verdict: correct models, and effects that the scene lacks.

    python benchmarks/model_criticism.py right --fits 334    share of right models flagged
    python benchmarks/model_criticism.py perfect --fits 334  the same of bare, perfect set-ups
    python benchmarks/model_criticism.py wrong --fits 3      wrong worlds, of 40 readings
    python benchmarks/model_criticism.py wrong --chosen      the same where the fit chooses a scene
    python benchmarks/model_criticism.py chosen --fits 100   coverage where the scene is chosen, too
    python benchmarks/model_criticism.py cost                seconds of the checks and of a warm fit

A fit is flagged where its verdict has a caution or a problem. It is silent and wrong where it is
not flagged although the 95% interval of a material parameter misses the truth by more than 2 sds.
`right` draws the truth from the priors of the set-up, except for the exposure, which is set as a
camera sets it; in `perfect` no light comes from the body and the instrument has no faults; `chosen`
draws the scene as well, of ten, and fits with `scene="auto"`. Results are
appended to a file of JSON lines, so that a run that was stopped goes on where it was.
"""

import argparse
import dataclasses
import functools
import json
import platform
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pandas as pd
import xarray as xr
from scipy import stats

import polar_bayes as pb
from polar_bayes.diagnostics.criticism import criticize
from polar_bayes.inference.result import provenance_of
from polar_bayes.observation.links import noise_parameters
from polar_bayes.scenes import scene_library
from polar_bayes.scenes.neighbors import INDICES_UNDER
from polar_bayes.setups import SETUPS
from polar_bayes.simulation import MirrorScan, Protocol

READINGS = 40
COST_FITS = 5
now = time.perf_counter
MISS = 2.0
MATERIAL = ("roughness", "subsurface_fraction", "absorption", "refractive_index")
BODY, INDEX = "subsurface_fraction", "refractive_index"
UNDER_WATER = INDICES_UNDER["water film"][0][1]  # the largest index that a film of water gives
PAPER, CAMERA, GONIOMETER = (SETUPS[name].scene for name in ("paper", "camera", "goniometer"))
Change = Callable[[xr.Dataset, np.random.Generator], xr.Dataset]


def unchanged(capture: xr.Dataset, random: np.random.Generator) -> xr.Dataset:
    """The capture as it was simulated."""
    del random
    return capture


def mirror_scan(views: int, largest: float, wavelengths: tuple[float, ...] = ()) -> MirrorScan:
    """Even steps from near the normal to a zenith, with the light on the other side."""
    return MirrorScan(
        views=views,
        smallest_view_zenith=largest / views,
        largest_view_zenith=largest,
        wavelengths=wavelengths,
    )


@dataclasses.dataclass(frozen=True)
class World:
    """A simulated scene, a change of the readings, the set-up that is fitted, and by what method.

    Without a method of its own, a world is fitted by the one that is asked for.
    """

    setup: str
    preset: str = "plastic"
    truth: pb.Scene | None = None
    parameters: Mapping[str, float] = dataclasses.field(default_factory=dict)
    noise: Mapping[str, float] = dataclasses.field(default_factory=dict)
    change: Change = unchanged
    method: str = ""
    largest_view_zenith: float = 85.0
    azimuths: tuple[float, ...] = (180.0, 150.0, 120.0, 60.0)
    wavelengths: tuple[float, ...] = ()

    def capture(self, readings: int, seed: int) -> xr.Dataset:
        """A capture of this world, with as many views as there are readings of each variable."""
        protocol = Protocol(
            views=readings,
            wavelengths=self.wavelengths,
            largest_view_zenith=self.largest_view_zenith,
            azimuths=self.azimuths,
        )
        if self.setup == "goniometer":
            protocol = mirror_scan(readings, 78.0, self.wavelengths)
        made = pb.simulate(
            self.preset,
            scene=self.truth or SETUPS[self.setup].scene,
            links=SETUPS[self.setup].links,
            protocol=protocol,
            parameters=dict(self.parameters),
            noise=dict(self.noise),
            seed=seed,
        )
        return self.change(made, np.random.default_rng(seed))


# --- What happens to readings ---------------------------------------------------------------------


def scaled(**factors: float) -> Change:
    """Variables times factors."""

    def change(capture: xr.Dataset, random: np.random.Generator) -> xr.Dataset:
        del random
        return capture.assign({name: capture[name] * factors[name] for name in factors})

    return change


def repeated(capture: xr.Dataset, random: np.random.Generator) -> xr.Dataset:
    """A quarter of the views, each entered four times."""
    del random
    views = np.repeat(np.arange(2, capture.sizes["view"], 4), 4)
    return capture.isel(view=views)


def turned(capture: xr.Dataset, random: np.random.Generator) -> xr.Dataset:
    """View zeniths read 3 degrees too low."""
    del random
    return capture.assign(view_zenith=np.maximum(capture["view_zenith"] - 3.0, 0.0))


def drifting(capture: xr.Dataset, random: np.random.Generator) -> xr.Dataset:
    """A smooth error of 6% over the angle."""
    phase = random.uniform(0.0, 2.0 * np.pi)
    wave = 1.0 + 0.06 * np.sin(np.radians(capture["view_zenith"]) * 5.0 + phase)
    name = "dop" if "dop" in capture else "q"
    return capture.assign({name: np.clip(capture[name] * wave, -0.999, 0.999)})


def spoiled(capture: xr.Dataset, random: np.random.Generator) -> xr.Dataset:
    """One reading in ten is 0.15 off."""
    name = "dop" if "dop" in capture else "q"
    hit = random.random(capture[name].shape) < 0.1
    return capture.assign({name: np.clip(capture[name] + 0.15 * hit, -0.999, 0.999)})


def rounded(capture: xr.Dataset, random: np.random.Generator) -> xr.Dataset:
    """Readings noted to one decimal."""
    del random
    name = "dop" if "dop" in capture else "q"
    return capture.assign({name: capture[name].round(1)})


def stray(capture: xr.Dataset, random: np.random.Generator) -> xr.Dataset:
    """Unpolarized stray light that is a quarter of the brightest view's."""
    del random
    light = 0.25 * float(capture["intensity"].max())
    share = capture["intensity"] / (capture["intensity"] + light)
    return capture.assign(dop=capture["dop"] * share)


def counted(count: Callable[[Any], Any]) -> Change:
    """Frames behind a polarizer as a sensor counts them, which sees 1 of the brightest light."""

    def change(capture: xr.Dataset, random: np.random.Generator) -> xr.Dataset:
        del random
        full = float(capture["intensity"].max())
        light = capture["intensity"] / full
        found = {}
        for name in ("q", "u"):
            one, other = (count(0.5 * light * (1.0 + sign * capture[name])) for sign in (1.0, -1.0))
            found[name] = np.clip((one - other) / (one + other), -0.999, 0.999)
        level = count(capture["intensity"].attrs["saturation_level"] / full)
        counts = count(light).assign_attrs(saturation_level=float(level))
        return capture.assign({**found, "intensity": counts})

    return change


def walled(capture: xr.Dataset, random: np.random.Generator) -> xr.Dataset:
    """Unpolarized light besides the lamp's, a tenth of the mean brightness, in every view."""
    del random
    light = 0.1 * float(capture["intensity"].mean())
    share = capture["intensity"] / (capture["intensity"] + light)
    found = {name: capture[name] * share for name in ("dop", "q", "u") if name in capture}
    return capture.assign({**found, "intensity": capture["intensity"] + light})


def twice_off(quantity: Any) -> dict[str, float]:
    """The offset of an input quantity at twice its standard uncertainty."""
    return {name: 2.0 * float(pb.PRIORS[name].variance) ** 0.5 for name in quantity.parameters}


def clipped(capture: xr.Dataset, random: np.random.Generator) -> xr.Dataset:
    """A sensor that saturates at 60% of the largest degree of polarization, unmarked."""
    del random
    name = "dop" if "dop" in capture else "q"
    return capture.assign({name: np.minimum(capture[name], 0.6 * float(capture[name].max()))})


def _part(scene: pb.Scene, **changes: Any) -> pb.Scene:
    """A scene with fields of its surface, or of itself, replaced."""
    own = {field.name for field in dataclasses.fields(scene)}
    outer = {name: part for name, part in changes.items() if name in own}
    inner = {name: part for name, part in changes.items() if name not in own}
    surface = dataclasses.replace(scene.surface, **inner) if inner else scene.surface
    return dataclasses.replace(scene, surface=surface, **outer)


P, T = pb.physics, pb.instrument
WRONG: dict[str, World] = {
    # The surface.
    "GGX fitted as Beckmann": World("polarimeter", truth=_part(PAPER, distribution=P.GGX())),
    "GGX fitted as Beckmann, camera": World("camera", truth=_part(CAMERA, distribution=P.GGX())),
    "grooves fitted as isotropic": World(
        "polarimeter",
        truth=_part(PAPER, slopes=P.AnisotropicSlopes()),
        parameters={"roughness": 0.05, "roughness_across": 0.3},
    ),
    "no shadowing": World("polarimeter", "leaf", truth=_part(PAPER, shadowing=P.NoShadowing())),
    "a coat": World(
        "polarimeter",
        truth=_part(PAPER, coat=P.ClearCoat()),
        parameters={"coat_refractive_index": 1.6, "coat_absorbance": 0.3},
    ),
    "polarized light": World(
        "polarimeter",
        truth=_part(
            PAPER, illumination=P.PointSource(P.LinearPolarization(degree=0.3, angle=30.0))
        ),
    ),
    "a sample that leans by 5 degrees": World(
        "polarimeter",
        truth=_part(PAPER, normal=T.TiltedNormal()),
        parameters={"normal_tilt_x": 5.0},
    ),
    "a near mirror that no view sees": World(
        "polarimeter", "glass", parameters={"roughness": 0.01}, azimuths=(120.0, 60.0)
    ),
    "the same by laplace": World(
        "polarimeter",
        "glass",
        parameters={"roughness": 0.01},
        azimuths=(120.0, 60.0),
        method="laplace",
    ),
    # The body.
    "turbid body fitted as depolarizer": World(
        "polarimeter", "leaf", truth=_part(PAPER, subsurface=P.TurbidMedium())
    ),
    "unpolarized body fitted as Lambertian": World(
        "camera", "leaf", truth=_part(CAMERA, subsurface=P.Unpolarized())
    ),
    "depolarizer fitted as Lambertian": World(
        "camera", "leaf", truth=_part(CAMERA, subsurface=P.Depolarizer())
    ),
    "index above the prior": World("polarimeter", parameters={"refractive_index": 2.3}),
    "index below the prior": World("polarimeter", parameters={"refractive_index": 1.15}),
    "a plate of index 2.3": World(
        "goniometer", "glass", parameters={"refractive_index": 2.3, "subsurface_fraction": 0.02}
    ),
    # The light.
    "light from the whole sky": World(
        "camera", "water", truth=_part(CAMERA, illumination=P.UniformSky())
    ),
    "light 12 degrees wide": World(
        "polarimeter", truth=_part(PAPER, illumination=P.Disc(half_width=12.0))
    ),
    "stray light": World("polarimeter", change=stray),
    # The instrument.
    "angles 3 degrees off": World("polarimeter", change=turned),
    "angles 3 degrees off, goniometer": World(
        "goniometer", "glass", parameters={"subsurface_fraction": 0.02}, change=turned
    ),
    "DoLP reads 20% low": World("polarimeter", change=scaled(dop=0.8)),
    "s and p swapped": World(
        "goniometer", "glass", parameters={"subsurface_fraction": 0.02}, change=scaled(q=-1.0)
    ),
    "a smooth error of 6%": World("polarimeter", change=drifting),
    "a smooth error of 6%, camera": World("camera", change=drifting),
    "a channel that saturates": World("camera", change=clipped),
    # The noise.
    "noise 30 times the stated": World(
        "goniometer",
        "glass",
        parameters={"subsurface_fraction": 0.02},
        noise={"stokes_error_factor": 30.0},
    ),
    "one reading in ten spoiled": World("polarimeter", change=spoiled),
    "one reading in ten spoiled, camera": World("camera", change=spoiled),
    "noted to one decimal": World("polarimeter", change=rounded),
    "a quarter of the views entered four times": World("polarimeter", change=repeated),
    # What nobody sees.
    "a water film on a rough body": World(
        "camera", truth=_part(CAMERA, coat=P.ClearCoat(1.333, 0.0))
    ),
    "a thick water film on a plate": World(
        "goniometer",
        "glass",
        truth=_part(GONIOMETER, coat=P.ClearCoat(1.333, 0.0)),
        parameters={"subsurface_fraction": 0.02},
    ),
    "a quarter-wave film on a plate": World(
        "goniometer",
        "glass",
        truth=_part(GONIOMETER, coat=P.ThinFilm(1.38, 115.0)),
        parameters={"subsurface_fraction": 0.02},
        wavelengths=(633.0,),
    ),
    # What a set-up does, further off than it states.
    "frames with a tone curve": World("camera", change=counted(lambda light: light ** (1 / 2.2))),
    "frames that are overexposed": World(
        "camera", change=counted(lambda light: np.minimum(light, 0.3))
    ),
    "a sensor that compresses": World("camera", change=counted(lambda light: light / (1 + light))),
    "a wall that gives back a tenth": World("camera", change=walled),
    "a wall that gives back a tenth, table": World("polarimeter", change=walled),
    "zeniths 3% long": World("polarimeter", change=scaled(view_zenith=1.03)),
    "zeniths 3% long, camera": World("camera", change=scaled(view_zenith=1.03)),
    # Each input quantity at twice what it is known to.
    **{
        f"{name}: {quantity.name} off by twice its uncertainty": World(
            name,
            truth=SETUPS[name].scene.known_to([quantity]),
            parameters=twice_off(quantity),
        )
        for name in ("polarimeter", "camera")
        for quantity in SETUPS[name].known
    },
    "goniometer: angle zero off by twice its uncertainty": World(
        "goniometer", "glass", parameters={"subsurface_fraction": 0.02, "angle_zero": 1.5}
    ),
}


# --- One fit --------------------------------------------------------------------------------------


def judge(capture: xr.Dataset, truth: Mapping[str, float], **settings: Any) -> dict[str, Any]:
    """Fit once; return the verdict, and by how many sds an interval misses."""
    result = pb.fit(capture, **settings)
    table, found = criticize(result), pb.verdict(result)
    summary = pb.summary(result)
    misses = {  # of an index at one wavelength, too
        label: max(row["q2.5"] - truth[name], truth[name] - row["q97.5"]) / row["sd"]
        for label, row in summary.iterrows()
        if (name := str(label).partition("[")[0]) in truth
    }
    return {
        "truth": {name: float(value) for name, value in truth.items()},
        "holds": {name: bool(miss <= 0.0) for name, miss in misses.items()},
        "levels": table["level"].to_dict(),
        "p_values": {name: p for name, p in table["p_value"].items() if np.isfinite(p)},
        "cautions": len(found.cautions),
        "problems": len(found.problems),
        "against": int(table["level"].eq("problem").sum()),
        "messages": [*found.problems, *found.cautions],
        "miss": float(max(0.0, *misses.values())),
    }


def wrong(
    fits: int, *, readings: int = READINGS, chosen: bool = False, method: str = "auto"
) -> Any:
    """Every wrong world, fitted by its set-up or by a chosen scene."""
    for seed in range(fits):
        for name, world in WRONG.items():
            used = world.method or method
            key = f"{name}{', scene chosen' * chosen}, {used}|{readings}|{seed}"
            yield key, lambda w=world, s=seed, m=used: _wrong(w, readings, s, m, chosen=chosen)


def _wrong(world: World, readings: int, seed: int, method: str, *, chosen: bool) -> dict[str, Any]:
    capture = world.capture(readings, seed).assign_attrs(setup=world.setup)
    found = {n: capture.get(f"true_{n}") for n in MATERIAL}
    truth = {n: x.to_numpy().ravel()[0] for n, x in found.items() if x is not None}
    scene = "auto" if chosen else world.setup
    return judge(capture, truth, scene=scene, method=method, seed=seed)


PLATE = mirror_scan(30, 78.0)
RIGHT: tuple[tuple[str, Protocol], ...] = (
    ("polarimeter", Protocol(views=40, wavelengths=(), largest_view_zenith=80.0)),
    ("camera", Protocol(views=16, wavelengths=(), largest_view_zenith=80.0)),
    ("goniometer", PLATE),
    ("picture", mirror_scan(8, 70.0)),
)
"""Set-ups and layouts of right models."""


def right(fits: int, *, perfect: bool = False, method: str = "auto") -> Any:
    """Right models: truth from the priors, or a bare surface and a perfect instrument."""
    for setup, layout in RIGHT:
        for seed in range(fits):
            name = f"{setup}, {layout.views} readings, {method}{', perfect' * perfect}"
            yield (
                f"{name}|{seed}",
                lambda s=setup, x=layout, k=seed: _right(s, x, k, perfect, method),
            )


def _right(setup: str, layout: Protocol, seed: int, perfect: bool, method: str) -> dict[str, Any]:
    scene = SETUPS[setup].scene.known_to(SETUPS[setup].known)
    capture, truth = drawn_from_priors(setup, scene, layout, seed, perfect=perfect)
    return judge(capture, truth, scene=setup, method=method, seed=seed)


def drawn_from_priors(
    setup: str, scene: pb.Scene, layout: Protocol, seed: int, *, perfect: bool = False
) -> tuple[xr.Dataset, dict[str, float]]:
    """A capture whose parameters are drawn from their priors, and those of its material.

    A perfect one has no light from the body, and an instrument without faults.
    """
    links, priors = SETUPS[setup].links, {**pb.PRIORS, **SETUPS[setup].priors}
    keys = iter(jax.random.split(jax.random.key(seed), 64))

    def drawn(names: Any) -> dict[str, Any]:
        return {name: np.asarray(priors[name].sample(next(keys)), float) for name in names}

    noise = {n: float(v) for n, v in drawn(noise_parameters(links)).items() if n != "exposure"}
    parameters = drawn(scene.parameters)
    if perfect:
        parameters = {n: x for n, x in parameters.items() if n in MATERIAL}
        parameters[BODY] = np.asarray(0.0)
    capture = pb.simulate(
        "plastic",
        scene=scene,
        links=links,
        protocol=layout,
        parameters=parameters,
        noise=noise,
        seed=seed,
    )
    # No interval holds a truth at the end of its support: n is judged without the body's fraction.
    known = [name for name in MATERIAL if name in parameters and not (perfect and name == BODY)]
    return capture, {name: float(parameters[name]) for name in known}


# --- The scene is drawn, too ----------------------------------------------------------------------


LAYOUTS: Mapping[str, Protocol] = {
    "goniometer": PLATE,
    "paper": Protocol(views=40, largest_view_zenith=80.0, wavelengths=()),
    "camera": Protocol(views=24, largest_view_zenith=80.0, wavelengths=()),
}
CHOICES: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("goniometer", ("mirror", "", "")),
    ("goniometer", ("mirror", "unpolarized body", "")),
    ("goniometer", ("mirror", "", "systematic errors")),
    ("goniometer", ("mirror", "unpolarized body", "systematic errors")),
    ("paper", ("rough surface", "depolarizing body", "")),
    ("paper", ("rough surface", "Lambertian body", "")),
    ("paper", ("rough surface", "depolarizing body", "systematic errors")),
    ("camera", ("rough surface", "Lambertian body", "", "")),
    ("camera", ("rough surface", "unpolarized body", "", "leaning normal")),
)
"""Set-ups and the options that make a scene, as `scene_library` names them."""


def chosen(fits: int) -> Any:
    """Scenes drawn at random, with their parameters; the fit chooses its scene."""
    random = np.random.default_rng(0)
    for seed, which in enumerate(random.integers(0, len(CHOICES), fits)):
        setup, choice = CHOICES[which]
        name = f"{setup}: {' + '.join(filter(None, choice))}"
        yield f"{name}|{seed}", lambda s=setup, c=choice, k=seed: _chosen(s, c, k)


def _chosen(setup: str, choice: tuple[str, ...], seed: int) -> dict[str, Any]:
    layout = LAYOUTS[setup]
    scene = scene_library(pb.simulate("plastic", scene=setup, protocol=layout)).scene(choice)
    capture, truth = drawn_from_priors(setup, scene, layout, seed)
    begun = time.perf_counter()
    found = judge(capture.assign_attrs(setup=setup), truth, scene="auto", seed=seed)
    return found | {"seconds": round(time.perf_counter() - begun, 1)}


def cost() -> None:
    """Print seconds of a fit whose layout is compiled, its checks, and its criticism: medians."""
    for setup in ("paper", "camera", "goniometer"):
        scene, links = SETUPS[setup].scene, SETUPS[setup].links
        rows = []
        for seed in range(1 + COST_FITS):
            capture, begun = pb.simulate("plastic", scene=scene, links=links, seed=seed), now()
            result, ended = pb.fit(capture, scene=setup), now()
            pb.diagnostics.criticize(result)
            timings = provenance_of(result)["timings"]
            checks = {name: timings[name] for name in ("cross-check", "alternatives")}
            rows.append({"fit": ended - begun, **checks, "criticism": now() - ended})
        found = pd.DataFrame(rows[1:]).median()  # the first one compiles
        share = found.drop("fit").sum() / found["fit"]
        print(f"{setup:12}{found.round(2).to_dict()} s; checks are {share:.0%} of the fit")


# --- Tables ---------------------------------------------------------------------------------------


def table(lines: list[dict[str, Any]]) -> pd.DataFrame:
    """Share flagged, by world and number of readings."""
    rows = pd.DataFrame(lines)
    rows[["world", "seed"]] = rows["key"].str.rsplit("|", n=1, expand=True)
    rows["flagged"] = (rows["cautions"] + rows["problems"]) > 0
    rows["failed"] = rows["problems"] > 0
    rows["silent and wrong"] = ~rows["flagged"] & (rows["miss"] > MISS)
    return rows.groupby("world", sort=False).agg(
        fits=("miss", "size"),
        flagged=("flagged", "mean"),
        problem=("failed", "mean"),
        median_miss=("miss", "median"),
        silent_and_wrong=("silent and wrong", "mean"),
    )


def wilson(hits: int, count: int) -> str:
    """A share with its 95% Wilson interval, in percent."""
    interval = stats.binomtest(hits, count).proportion_ci(method="wilson")
    return f"{hits / count:.1%} [{interval.low:.1%}, {interval.high:.1%}]"


def summarize(lines: list[dict[str, Any]]) -> None:
    """Print the table of all results, and shares of fits."""
    found = table(lines)
    print(found.to_string(float_format="{:.2f}".format))
    levels = pd.DataFrame([line["levels"] for line in lines])
    print(levels.apply(lambda column: column.value_counts(normalize=True)).T.to_string())
    failed = sum(line["problems"] > 0 for line in lines)
    silent = round(float((found["silent_and_wrong"] * found["fits"]).sum()))
    print("with a problem:", wilson(failed, len(lines)))
    against = sum(line.get("against", 0) > 0 for line in lines)
    print("with a problem of the model, not of the method:", wilson(against, len(lines)))
    flagged = [line["problems"] + line["cautions"] > 0 for line in lines]
    print("with a problem or a caution:", wilson(sum(flagged), len(lines)))
    index = np.array([line.get("truth", {}).get(INDEX, np.nan) for line in lines])
    for what, where in {"at most": index <= UNDER_WATER, "above": index > UNDER_WATER}.items():
        if where.any():
            share = wilson(int(np.sum(flagged, where=where)), int(where.sum()))
            print(f"with a problem or a caution where n is {what} {UNDER_WATER}:", share)
    print("silent and wrong:", wilson(silent, len(lines)))
    held = pd.DataFrame([line.get("holds", {}) for line in lines])
    for name, column in held.items():
        known = column.dropna()
        print(f"95% interval of {name} holds:", wilson(int(known.sum()), known.size))
    print("machine:", platform.machine(), "python", platform.python_version())


def main() -> None:
    """Run the selected cases, and print what all of them gave."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("part", choices=("right", "perfect", "wrong", "chosen", "cost"))
    parser.add_argument("--fits", type=int, default=5)
    parser.add_argument("--chosen", action="store_true", help="wrong: the fit chooses its scene")
    parser.add_argument("--readings", type=int, default=READINGS, help="wrong: of each variable")
    parser.add_argument("--method", default="auto", help="right, perfect, wrong: of the fits")
    parser.add_argument("--only", default="", help="worlds whose name holds this text")
    parser.add_argument("--keep", type=Path, help="file of JSON lines", default="criticism.jsonl")
    asked = parser.parse_args()
    if asked.part == "cost":
        cost()
        return
    lines = (
        [json.loads(text) for text in asked.keep.read_text().splitlines()]
        if asked.keep.exists()
        else []
    )
    done = {line["key"] for line in lines}
    worlds = {
        "right": functools.partial(right, method=asked.method),
        "perfect": functools.partial(right, perfect=True, method=asked.method),
        "wrong": functools.partial(
            wrong, readings=asked.readings, chosen=asked.chosen, method=asked.method
        ),
        "chosen": chosen,
    }
    called = {key: run for key, run in worlds[asked.part](asked.fits) if asked.only in key}
    if not called:
        parser.error(f"no fit's name holds {asked.only!r}")
    for key, run in called.items():
        if key in done:
            continue
        try:
            found = run()
        except pb.PolarBayesError as error:  # refused at the door: nothing is silent
            found = {"levels": {}, "p_values": {}, "cautions": 0, "problems": 1, "miss": 0.0}
            found["refused"] = str(error)
        lines.append({"key": key, **found})
        with asked.keep.open("a") as file:
            file.write(json.dumps(lines[-1]) + "\n")
    summarize(lines)


if __name__ == "__main__":
    main()
