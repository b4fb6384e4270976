"""Captures of known truth: the forward story of a model, told without data."""

import dataclasses
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array

from polar_bayes.capture.schema import validate
from polar_bayes.errors import CaptureError, FitError
from polar_bayes.observation.data import Observations
from polar_bayes.observation.links import AbstractLink
from polar_bayes.physics.geometry import Geometry
from polar_bayes.physics.notation import notation
from polar_bayes.physics.scene import Scene
from polar_bayes.setups import SETUPS, Setup, find_setup
from polar_bayes.simulation.presets import Material, find_preset
from polar_bayes.simulation.protocol import Protocol
from polar_bayes.simulation.truth import checked_noise, checked_parameters, image_of, is_vector

NOISE: Mapping[str, float] = {
    "concentration_scale": 300.0,
    "logit_scale": 0.15,
    "normal_scale": 0.02,
    "stokes_scale": 0.01,
    "stokes_error_factor": 1.0,
    "intensity_scale": 0.01,
}
"""Noise of a careful laboratory capture, by the names of the links' parameters."""

IMAGE = ("y", "x")

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
    noise: Mapping[str, float | np.ndarray] | None = None,
    seed: int = 0,
) -> xr.Dataset:
    """Draw a capture of a known material, or an image of many.

    It is an image as soon as one value has shape (y, x): every pixel is then seen from the same
    directions and draws noise of its own. All are predicted at once, which takes about 1 kB for
    each reading of a smooth scene and 2 kB of the paper's: 100,000 pixels at 12 views are 1 to 2
    GB. Larger ones are drawn some rows at a time, with a stated exposure and a seed for each part.

    Args:
        preset: A name in `PRESETS` or a `Material`.
        scene: A name in `SETUPS` or a `Scene`.
        links: How each variable scatters; by default those of the scene's set-up.
        protocol: Where to look from; the paper's by default.
        parameters: Values that replace the preset's, and those of instrument terms (which are
            otherwise 0 for offsets and 1 for gains); shape (), (wavelength,) or (y, x).
        noise: Values that replace those of `NOISE`; shape () or (y, x). `exposure` is otherwise
            one number, chosen so that the brighter views come to 60% of full scale.
        seed: The same seed gives the same capture.

    Returns:
        A validated capture with dims ([y, x,] view[, wavelength]). The truth rides along as
        `true_<parameter>`, with dims (y, x) where it is an image; readings at full scale are
        flagged `saturated`. Links that read stated errors find them as `<reading>_error`.

    Raises:
        CaptureError: No such preset, a seed, parameter or noise outside its range, or shapes that
            are not told above or do not agree.
        SceneError: No such scene, or a parameter that it does not have.
        FitError: A link that does not describe its variable, or noise that no link reads.

    Example:
        Two glasses under uneven light. A shadow is a low exposure: polarization is noisier
        there, where the link says so. A highlight is a high one: it saturates.

        >>> index = np.array([[1.5, 1.5, 1.7, 1.7], [1.5, 1.5, 1.7, 1.7]])
        >>> light = np.array([[0.5, 10.0, 10.0, 10.0], [10.0, 10.0, 10.0, 500.0]])
        >>> image = pb.simulate(
        ...     "glass",
        ...     scene=pb.Scene(pb.SmoothSurface()),
        ...     protocol=pb.Protocol(views=5, wavelengths=()),
        ...     parameters={"refractive_index": index},
        ...     noise={"exposure": light},
        ... )
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
    truth = checked_parameters(setup.scene, material, wavelengths, parameters or {})
    levels = checked_noise(links, NOISE, noise or {})
    image = image_of(truth, levels)
    with jax.enable_x64(True):
        recorded = _record(setup.scene, links, _blank(protocol, links, image), truth, levels, seed)
    name = preset if isinstance(preset, str) else "simulated"
    attributes: dict[str, str | int] = {"name": name, "seed": seed}
    if isinstance(scene, str):  # a fit then takes the same set-up unless told otherwise
        attributes["setup"] = scene
    return _label(recorded, protocol, IMAGE if image else (), truth, attributes)


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


def _record(
    scene: Scene,
    links: Mapping[str, AbstractLink],
    blank: Observations,
    truth: Mapping[str, np.ndarray],
    noise: Mapping[str, np.ndarray | None],
    seed: int,
) -> dict[str, np.ndarray]:
    """Readings with the dims of `blank`: intensity first, since noise depends on it."""
    key_intensity, key_rest = jax.random.split(jax.random.key(seed))
    axes = len(blank.shape)
    parameters = {name: jnp.asarray(_in_front(x, axes - 1)) for name, x in truth.items()}
    prediction = scene.predict(parameters, blank.geometry)
    prediction = {n: jnp.broadcast_to(x, blank.shape) for n, x in prediction.items()}
    exposure = BRIGHT_LEVEL / jnp.quantile(prediction["intensity"], BRIGHT_QUANTILE)
    levels = {
        name: exposure if level is None else jnp.asarray(_in_front(level, axes))
        for name, level in noise.items()
    }
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


def _in_front(value: np.ndarray, axes: int) -> np.ndarray:
    """An image with axes of length 1 behind it, so many in all; other values as they are."""
    return value.reshape(value.shape + (1,) * (axes - 2)) if value.ndim == 2 else value


def _possible(recorded: Mapping[str, Array]) -> dict[str, Array]:
    """The polarization as an instrument reports it: noise carries it no further than fully."""
    stokes = {name: recorded[name] for name in ("q", "u") if name in recorded}
    length = jnp.sqrt(sum(value**2 for value in stokes.values()))
    possible = {name: value / jnp.maximum(length, 1.0) for name, value in stokes.items()}
    if "dop" in recorded:
        possible["dop"] = jnp.clip(recorded["dop"], 0.0, 1.0)
    return possible


def _blank(
    protocol: Protocol, links: Mapping[str, AbstractLink], image: tuple[int, ...]
) -> Observations:
    """The layout of the capture before anything was recorded."""
    dims: tuple[tuple[str, int], ...] = (("view", protocol.views),)
    if protocol.wavelengths:
        dims = (("wavelength", len(protocol.wavelengths)), *dims)
    if image:
        dims = (*zip(IMAGE, image, strict=True), *dims)
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
    leading: tuple[str, ...],
    truth: Mapping[str, np.ndarray],
    attributes: Mapping[str, str | int],
) -> xr.Dataset:
    dims = (*leading, *(("wavelength",) if protocol.wavelengths else ()), "view")
    capture = xr.Dataset(
        {name: ("view", angle) for name, angle in protocol.angles().items()}, attrs=attributes
    )
    for name, value in recorded.items():
        capture[name] = (dims, value)
    for name, value in truth.items():
        if not is_vector(name):
            units = {"units": notation(name).unit}
            capture[f"true_{name}"] = (((), ("wavelength",), IMAGE)[value.ndim], value, units)
    if protocol.wavelengths:
        capture = capture.assign_coords(wavelength=np.asarray(protocol.wavelengths, float))
    if "intensity" in capture:
        capture["intensity"].attrs["saturation_level"] = FULL_SCALE
    return validate(capture, source="simulate")
