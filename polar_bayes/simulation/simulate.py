"""Captures of known truth: the forward story of a model, told without data."""

import dataclasses
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array

from polar_bayes.capture.schema import validate
from polar_bayes.errors import CaptureError, FitError, SceneError
from polar_bayes.observation.data import Observations
from polar_bayes.observation.links import AbstractLink, noise_parameters
from polar_bayes.physics.geometry import Geometry
from polar_bayes.physics.notation import notation
from polar_bayes.physics.scene import Scene
from polar_bayes.priors import RANGES
from polar_bayes.setups import SETUPS, Setup, find_setup
from polar_bayes.simulation.presets import Material, find_preset
from polar_bayes.simulation.protocol import Protocol

NOISE: Mapping[str, float] = {
    "concentration_scale": 300.0,
    "logit_scale": 0.15,
    "normal_scale": 0.02,
    "stokes_scale": 0.01,
    "stokes_error_factor": 1.0,
    "intensity_scale": 0.01,
}
"""Noise of a careful laboratory capture, by the names of the links' parameters."""

NEUTRAL: Mapping[str, np.ndarray] = {
    "dolp_gain": np.asarray(1.0),
    "channel_gain_ratio": np.asarray(1.0),
    "leakage": np.asarray(0.0),
    "dark_level": np.asarray(0.0),
    "angle_zero": np.asarray(0.0),
    "beam_overlap_zenith": np.asarray(90.0),
    "discrepancy_amplitude": np.asarray(0.0),
    "discrepancy_weights": np.zeros(4),
    "normal_tilt_x": np.asarray(0.0),
    "normal_tilt_y": np.asarray(0.0),
}
"""A perfect instrument and a level sample, by the names of the terms' parameters."""

STATED_ERROR = 0.01
"""Standard error that the instrument states of every reading, for the links that read it."""

FULL_SCALE = 1.0
BRIGHT_QUANTILE = 0.9
BRIGHT_LEVEL = 0.6
"""Exposure puts the 90% brightest view at 60% of full scale; a specular lobe may saturate."""


def simulate(
    preset: str | Material = "leaf",
    *,
    scene: str | Scene = "paper",
    links: Mapping[str, AbstractLink] | None = None,
    protocol: Protocol | None = None,
    parameters: Mapping[str, float | np.ndarray] | None = None,
    noise: Mapping[str, float] | None = None,
    seed: int = 0,
) -> xr.Dataset:
    """Draw a capture of a known material.

    Args:
        preset: A name in `PRESETS` or a `Material`.
        scene: A name in `SETUPS` or a `Scene`.
        links: How each variable scatters; by default those of the scene's set-up.
        protocol: Where to look from; the paper's by default.
        parameters: Values that replace the preset's, and those of instrument terms (which are
            otherwise 0 for offsets and 1 for gains); shape () or (wavelength,).
        noise: Values that replace those of `NOISE`; `exposure` is otherwise chosen so that the
            brighter views come to 60% of full scale.
        seed: The same seed gives the same capture.

    Returns:
        A validated capture with dims (view, wavelength), or (view,) without wavelengths. The
        truth rides along as `true_<parameter>`; readings at full scale are flagged `saturated`.
        Links that read stated errors find them as `<reading>_error`.

    Raises:
        CaptureError: No such preset, or a seed, parameter or noise outside its range.
        SceneError: No such scene, or a parameter that it does not have.
        FitError: A link that does not describe its variable, or noise that no link reads.
    """
    protocol = protocol or Protocol()
    setup = Setup(scene, SETUPS["paper"].links) if isinstance(scene, Scene) else find_setup(scene)
    links = _checked_links(setup.links if links is None else links)
    if not isinstance(seed, int) or isinstance(seed, bool) or not 0 <= seed < 2**32:
        raise CaptureError(
            f"seed is {seed!r}", where="simulate", mend="give an integer from 0 to 2**32 - 1"
        )
    material = preset if isinstance(preset, Material) else find_preset(preset)
    wavelengths = np.asarray(protocol.wavelengths, float)
    truth = _truth(material, setup.scene, wavelengths, parameters or {})
    levels = _levels(links, noise or {})
    with jax.enable_x64(True):
        recorded = _record(setup.scene, links, protocol, truth, levels, seed)
    name = preset if isinstance(preset, str) else "simulated"
    attributes: dict[str, str | int] = {"name": name, "seed": seed}
    if isinstance(scene, str):  # a fit then takes the same set-up unless told otherwise
        attributes["setup"] = scene
    return _label(recorded, protocol, truth, attributes)


def _truth(
    material: Material,
    scene: Scene,
    wavelengths: np.ndarray,
    overrides: Mapping[str, float | np.ndarray],
) -> dict[str, np.ndarray]:
    unknown = set(overrides) - set(scene.parameters)
    if unknown:
        raise SceneError(
            f"the scene has no parameter {', '.join(sorted(unknown))}",
            where="simulate: parameters",
            mend=f"give any of {', '.join(scene.parameters)}",
        )
    known = material.at(wavelengths if wavelengths.size else np.asarray(550.0))
    available = {**NEUTRAL, **known, **{k: np.asarray(v, float) for k, v in overrides.items()}}
    missing = [name for name in scene.parameters if name not in available]
    if missing:
        raise SceneError(
            f"no value for {', '.join(missing)}",
            where="simulate: parameters",
            mend=f"give parameters={{{missing[0]!r}: <a number>}}",
        )
    truth = {name: available[name] for name in scene.parameters}
    for name, value in truth.items():
        _check_range(f"simulate: parameters[{name!r}]", name, value)
        if np.ndim(NEUTRAL.get(name, 0.0)) == 0 and value.shape not in {(), wavelengths.shape}:
            raise CaptureError(
                f"its shape is {value.shape}",
                where=f"simulate: parameters[{name!r}]",
                mend=f"give one number, or one per wavelength ({wavelengths.size})",
            )
    return truth


def _levels(
    links: Mapping[str, AbstractLink], overrides: Mapping[str, float]
) -> dict[str, float | None]:
    """A value for every noise parameter; None for an exposure that the scene decides."""
    parameters = noise_parameters(links)
    unknown = set(overrides) - set(parameters)
    if unknown:
        raise FitError(
            f"no link reads {', '.join(sorted(unknown))}",
            where="simulate: noise",
            mend=f"give any of {', '.join(parameters)}",
        )
    levels = {"exposure": None, **NOISE, **overrides}
    for name in parameters:
        where = f"simulate: noise[{name!r}]"
        if name not in levels:
            raise FitError(
                "it has no value", where=where, mend=f"give noise={{{name!r}: <number>}}"
            )
        if levels[name] is not None:
            _check_range(where, name, np.asarray(levels[name], float), above=True)
    return {name: levels[name] for name in parameters}


def _checked_links(links: Mapping[str, AbstractLink]) -> dict[str, AbstractLink]:
    if not isinstance(links, Mapping) or not links:
        raise FitError(
            "that is no set of links",
            where="simulate: links",
            mend="give a mapping such as {'dop': BetaLink()}",
        )
    for name, link in links.items():
        if not isinstance(link, AbstractLink) or name not in link.observables:
            raise FitError(
                f"{link!r} does not describe {name}",
                where=f"simulate: links[{name!r}]",
                mend="give a link that names it in `observables`, such as {'dop': BetaLink()}",
            )
    return dict(links)


def _check_range(where: str, name: str, value: np.ndarray, *, above: bool = False) -> None:
    """Refuse what is outside the physical range; with `above`, its lower end as well."""
    low, high = RANGES.get(name, (-np.inf, np.inf))
    inside = np.isfinite(value) & ((value > low) if above else (value >= low)) & (value <= high)
    if not inside.all():
        sign = "<" if above else "<="
        raise CaptureError(
            f"{value[~inside].flat[0]:g} is outside {low:g} {sign} value <= {high:g}",
            where=where,
            mend="give a finite number in that range",
        )


def _record(
    scene: Scene,
    links: Mapping[str, AbstractLink],
    protocol: Protocol,
    truth: Mapping[str, np.ndarray],
    noise: Mapping[str, float | None],
    seed: int,
) -> dict[str, np.ndarray]:
    """Readings with dims ([wavelength,] view): intensity first, since noise depends on it."""
    key_intensity, key_rest = jax.random.split(jax.random.key(seed))
    blank = _blank(protocol, links)
    parameters = {name: jnp.asarray(value) for name, value in truth.items()}
    prediction = scene.predict(parameters, blank.geometry)
    prediction = {n: jnp.broadcast_to(x, blank.shape) for n, x in prediction.items()}
    exposure = BRIGHT_LEVEL / jnp.quantile(prediction["intensity"], BRIGHT_QUANTILE)
    levels = {n: exposure if x is None else jnp.asarray(x, float) for n, x in noise.items()}
    recorded: dict[str, Array] = {}
    data = blank
    if "intensity" in links:
        link = links["intensity"]
        intensity = link.distribution("intensity", prediction, blank, levels).sample(key_intensity)
        intensity = jnp.clip(intensity, 0.0, FULL_SCALE)
        recorded["intensity"] = intensity
        recorded["saturated"] = intensity >= FULL_SCALE
        data = _with_intensity(blank, intensity, recorded["saturated"])
    for name, key in zip(links, jax.random.split(key_rest, len(links)), strict=True):
        if name != "intensity":
            recorded[name] = links[name].distribution(name, prediction, data, levels).sample(key)
    recorded |= _possible(recorded)
    for name in (name for name, link in links.items() if link.reads_errors):
        recorded[f"{name}_error"] = blank.errors[name]
    return {name: np.asarray(value) for name, value in recorded.items()}


def _possible(recorded: Mapping[str, Array]) -> dict[str, Array]:
    """The polarization as an instrument reports it: noise carries it no further than fully."""
    stokes = {name: recorded[name] for name in ("q", "u") if name in recorded}
    length = jnp.sqrt(sum(value**2 for value in stokes.values()))
    possible = {name: value / jnp.maximum(length, 1.0) for name, value in stokes.items()}
    if "dop" in recorded:
        possible["dop"] = jnp.clip(recorded["dop"], 0.0, 1.0)
    return possible


def _blank(protocol: Protocol, links: Mapping[str, AbstractLink]) -> Observations:
    """The layout of the capture before anything was recorded."""
    dims: tuple[tuple[str, int], ...] = (("view", protocol.views),)
    if protocol.wavelengths:
        dims = (("wavelength", len(protocol.wavelengths)), *dims)
    shape = tuple(length for _, length in dims)
    angles = {name: jnp.asarray(angle) for name, angle in protocol.angles().items()}
    colors = jnp.asarray(protocol.wavelengths)[:, None] if protocol.wavelengths else None
    return Observations(
        geometry=Geometry.from_degrees(**angles, wavelength=colors),
        readings={},
        errors={name: jnp.full(shape, STATED_ERROR) for name in links},
        brightness=jnp.ones(shape),
        full_scale=jnp.asarray(FULL_SCALE),
        intensity_unit=jnp.asarray(1.0),
        valid=jnp.ones(shape, bool),
        saturated=jnp.zeros(shape, bool),
        dims=dims,
    )


def _with_intensity(data: Observations, intensity: Array, saturated: Array) -> Observations:
    brightness = jnp.clip(intensity / FULL_SCALE, 0.0, 1.0)
    return dataclasses.replace(data, brightness=brightness, saturated=saturated)


def _label(
    recorded: Mapping[str, np.ndarray],
    protocol: Protocol,
    truth: Mapping[str, np.ndarray],
    attributes: Mapping[str, str | int],
) -> xr.Dataset:
    dims = ("view", "wavelength") if protocol.wavelengths else ("view",)
    capture = xr.Dataset(
        {name: ("view", angle) for name, angle in protocol.angles().items()}, attrs=attributes
    )
    for name, value in recorded.items():
        capture[name] = (dims, value.T)
    for name, value in truth.items():
        if np.ndim(NEUTRAL.get(name, 0.0)) == 0:  # a capture has no dim for a vector of weights
            units = {"units": notation(name).unit}
            capture[f"true_{name}"] = ("wavelength" if value.ndim else (), value, units)
    if protocol.wavelengths:
        capture = capture.assign_coords(wavelength=np.asarray(protocol.wavelengths, float))
    if "intensity" in capture:
        capture["intensity"].attrs["saturation_level"] = FULL_SCALE
    return validate(capture, source="simulate")
