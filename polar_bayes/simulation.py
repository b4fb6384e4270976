"""Simulated captures with known truth: materials, view protocols, and `simulate`.

The presets are plausible values, not measurements. Refractive indices at 450, 550 and 650 nm follow
published dispersion (water, BK7 glass and PMMA to 0.002); a leaf absorbs blue and red and leaves
green, a ripe fruit leaves red.

A value is one number, one for each wavelength, or an image (y, x): its rank says which.
"""

import dataclasses
import functools
from collections.abc import Mapping
from types import MappingProxyType
from typing import override

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array

from polar_bayes.capture.schema import Interval, validate
from polar_bayes.errors import CaptureError, FitError, SceneError
from polar_bayes.numerics.compile import JitOnce, LRUCache
from polar_bayes.numerics.fingerprint import fingerprint, uses_own_code
from polar_bayes.observation.data import Observations
from polar_bayes.observation.links import AbstractLink, noise_parameters
from polar_bayes.physics.geometry import Geometry
from polar_bayes.physics.instrument import (
    AngleZero,
    BeamOverlap,
    ChannelGain,
    DarkLevel,
    Discrepancy,
    DolpGain,
    Leakage,
)
from polar_bayes.physics.part import notation
from polar_bayes.physics.scene import Scene
from polar_bayes.priors import CONTRAST, PRIORS, RANGES
from polar_bayes.setups import SETUPS, Setup, find_setup, setup_name

__all__ = ["PRESETS", "Material", "MirrorScan", "Protocol"]

REFERENCE_WAVELENGTHS = (450.0, 550.0, 650.0)


@dataclasses.dataclass(frozen=True)
class Material:
    """True parameters of one material.

    Args:
        roughness: Microfacet roughness, unit 1.
        subsurface_fraction: Share of the subsurface, unit 1, range [0, 1].
        absorption: Absorption over reduced scattering at the reference wavelengths, unit 1.
        refractive_index: At the reference wavelengths, unit 1.
    """

    roughness: float
    subsurface_fraction: float
    absorption: tuple[float, float, float]
    refractive_index: tuple[float, float, float]

    def at(self, wavelengths: np.ndarray) -> dict[str, np.ndarray]:
        """Return parameters at any wavelengths, interpolated, and constant beyond the ends.

        Args:
            wavelengths: (wavelength,), unit nm.

        Returns:
            Scalars for what color does not change, (wavelength,) for the rest.
        """
        spectra = {"absorption": self.absorption, "refractive_index": self.refractive_index}
        return {
            "roughness": np.asarray(self.roughness),
            "subsurface_fraction": np.asarray(self.subsurface_fraction),
            **{n: np.interp(wavelengths, REFERENCE_WAVELENGTHS, x) for n, x in spectra.items()},
        }


PRESETS: Mapping[str, Material] = MappingProxyType(
    {
        "leaf": Material(0.20, 0.45, (1.20, 0.25, 0.90), (1.448, 1.440, 1.435)),
        "fruit": Material(0.12, 0.40, (1.00, 0.60, 0.15), (1.418, 1.410, 1.405)),
        "plastic": Material(0.10, 0.30, (0.30, 0.30, 0.30), (1.501, 1.494, 1.490)),
        "coating": Material(0.06, 0.20, (0.60, 0.50, 0.45), (1.524, 1.515, 1.510)),
        "glass": Material(0.03, 0.05, (0.20, 0.20, 0.20), (1.525, 1.519, 1.515)),
        "water": Material(0.05, 0.15, (0.15, 0.20, 0.60), (1.338, 1.334, 1.331)),
    }
)


def find_preset(name: str) -> Material:
    """Return the material of a name."""
    if not isinstance(name, str) or name not in PRESETS:
        hint = f"give one of {', '.join(PRESETS)}"
        raise CaptureError("no such material", where=f"preset={name!r}", hint=hint)
    return PRESETS[name]


# --- Protocol of views ----------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Protocol:
    """Views on rings of azimuth under a fixed light.

    Args:
        views: How many, at least 2.
        largest_view_zenith: Unit degree, range (0, 90).
        azimuths: View azimuths; 180 is the mirror side of a light at azimuth 0. Unit degree.
        light_zenith: Unit degree, range [0, 90).
        wavelengths: Unit nm; empty for a capture without color.

    Raises:
        CaptureError: A value is outside its range.
    """

    views: int = 40
    largest_view_zenith: float = 85.0
    azimuths: tuple[float, ...] = (180.0, 150.0, 120.0, 60.0)
    light_zenith: float = 45.0
    wavelengths: tuple[float, ...] = (450.0, 550.0, 650.0)

    def __post_init__(self) -> None:
        are_angles = len(self.azimuths) > 0 and all(abs(a) <= 360.0 for a in self.azimuths)
        are_positive = all(0.0 < w < 1e6 for w in self.wavelengths)
        is_count = isinstance(self.views, int) and 2 <= self.views <= 100_000
        is_below_90 = 0.0 < self.largest_view_zenith < 90.0
        for holds, name, hint in (
            (is_count, "views", "give a whole number from 2 to 100000"),
            (is_below_90, "largest_view_zenith", "give degrees above 0 and below 90"),
            (0.0 <= self.light_zenith < 90.0, "light_zenith", "give degrees from 0 to below 90"),
            (are_angles, "azimuths", "give at least one, each from -360 to 360 degrees"),
            (are_positive, "wavelengths", "give nanometers above zero"),
        ):
            if not holds:
                raise CaptureError(f"{name} is {getattr(self, name)}", where="Protocol", hint=hint)

    def angles(self) -> dict[str, np.ndarray]:
        """Return directions of every view.

        Returns:
            view_zenith, view_azimuth, light_zenith and light_azimuth, each (view,), in degree.
            The zeniths step evenly from near the normal to the largest, the azimuths alternate, so
            that every azimuth covers the whole range.
        """
        steps = np.arange(1, self.views + 1) / self.views
        azimuths = np.resize(np.asarray(self.azimuths, float), self.views)
        return {
            "view_zenith": steps * self.largest_view_zenith,
            "view_azimuth": azimuths,
            "light_zenith": np.full(self.views, self.light_zenith),
            "light_azimuth": np.zeros(self.views),
        }


@dataclasses.dataclass(frozen=True)
class MirrorScan(Protocol):
    """Views in the mirror direction of a light that moves along, as a goniometer scans a plate.

    The azimuths and the light zenith of `Protocol` are not used.

    Args:
        smallest_view_zenith: Unit degree, range [0, largest_view_zenith].

    Raises:
        CaptureError: A value is outside its range.
    """

    smallest_view_zenith: float = 20.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 <= self.smallest_view_zenith <= self.largest_view_zenith:
            what = f"smallest_view_zenith is {self.smallest_view_zenith}"
            hint = f"give degrees from 0 to {self.largest_view_zenith:g}, the largest"
            raise CaptureError(what, where="MirrorScan", hint=hint)

    @override
    def angles(self) -> dict[str, np.ndarray]:
        """Return directions of every view, as `Protocol` does, with even steps of the zenith."""
        zenith = np.linspace(self.smallest_view_zenith, self.largest_view_zenith, self.views)
        mirror = {"view_zenith": zenith, "light_zenith": zenith}
        return super().angles() | mirror | {"view_azimuth": np.full(self.views, 180.0)}


# --- Validation of parameters and noise -----------------------------------------------------------

NEUTRAL: Mapping[str, np.ndarray] = {
    **{
        name: np.asarray(x)
        for term in (AngleZero, BeamOverlap, ChannelGain, DarkLevel, Discrepancy, DolpGain, Leakage)
        for name, x in term.neutral.items()
    },
    **dict.fromkeys(("normal_tilt_x", "normal_tilt_y"), np.asarray(0.0)),
    **dict.fromkeys((name for name in PRIORS if name.endswith("_offset")), np.asarray(0.0)),
    "discrepancy_weights": np.zeros(3),
}
"""Values of a perfect instrument and a level sample, by parameter of the terms."""

Value = float | np.ndarray


def checked_parameters(
    scene: Scene, material: Material, wavelengths: np.ndarray, overrides: Mapping[str, Value]
) -> dict[str, np.ndarray]:
    """Return a value for every parameter of the scene."""
    if unknown := set(overrides) - set(scene.parameters):
        what = f"the scene has no parameter {', '.join(sorted(unknown))}"
        hint = f"give any of {', '.join(scene.parameters)}"
        raise SceneError(what, where="simulate: parameters", hint=hint)
    known = material.at(wavelengths if wavelengths.size else np.asarray(550.0))
    available = {**NEUTRAL, **known, **overrides}
    missing = [name for name in scene.parameters if name not in available]
    if missing:
        what = f"no value for {', '.join(missing)}"
        hint = f"give parameters={{{missing[0]!r}: <a number>}}"
        raise SceneError(what, where="simulate: parameters", hint=hint)
    truth = {}
    spectrum = f", or one per wavelength ({wavelengths.size})" if wavelengths.size else ""
    for name in scene.parameters:
        where = f"simulate: parameters[{name!r}]"
        truth[name] = value = _checked_numbers(name, available[name], where)
        has_shape, hint = value.ndim <= 1, "give one number for each function"
        if not is_vector(name):
            is_spectrum = wavelengths.size > 0 and value.shape == wavelengths.shape
            has_shape = is_spectrum or _is_number_or_image(value)
            hint = f"give one number{spectrum}, or an image (y, x)"
        if not has_shape:
            raise CaptureError(f"its shape is {value.shape}", where=where, hint=hint)
    return truth


def checked_noise(
    links: Mapping[str, AbstractLink], defaults: Mapping[str, float], overrides: Mapping[str, Value]
) -> dict[str, np.ndarray | None]:
    """Return a value for every noise parameter of the links."""
    parameters = noise_parameters(links)
    if unknown := set(overrides) - set(parameters):
        what = f"no link reads {', '.join(sorted(unknown))}"
        raise FitError(what, where="simulate: noise", hint=f"give any of {', '.join(parameters)}")
    given: dict[str, Value | None] = {"exposure": None, **defaults, **overrides}
    levels: dict[str, np.ndarray | None] = {}
    for name in parameters:
        where = f"simulate: noise[{name!r}]"
        if name not in given:
            hint = f"give noise={{{name!r}: <number>}}"
            raise FitError("it has no value", where=where, hint=hint)
        levels[name] = None
        if (value := given[name]) is not None:
            levels[name] = level = _checked_numbers(name, value, where, open_low=True)
            if not _is_number_or_image(level):
                hint = "give one number, or an image (y, x)"
                raise CaptureError(f"its shape is {level.shape}", where=where, hint=hint)
    return levels


def image_shape(
    parameters: Mapping[str, np.ndarray], noise: Mapping[str, np.ndarray | None]
) -> tuple[int, ...]:
    """Return the shape of the image of parameters and noise; empty without one."""
    named = [(f"parameters[{name!r}]", value) for name, value in parameters.items()]
    named += [(f"noise[{name!r}]", level) for name, level in noise.items() if level is not None]
    images = [(name, value.shape) for name, value in named if value.ndim == 2]
    for name, shape in images[1:]:
        first, expected = images[0]
        if shape != expected:
            what = f"its shape is {shape} and that of {first} is {expected}"
            hint = "give images (y, x) of one shape"
            raise CaptureError(what, where=f"simulate: {name}", hint=hint)
    return images[0][1] if images else ()


def is_vector(name: str) -> bool:
    """Return True for a parameter with an axis that no dim of a capture represents."""
    return np.ndim(NEUTRAL.get(name, 0.0)) > 0


def _checked_numbers(name: str, value: Value, where: str, *, open_low: bool = False) -> np.ndarray:
    """Return numbers inside the physical range, which may be open below."""
    try:
        numbers = np.asarray(value, float)
    except (TypeError, ValueError):
        hint = "give a number, or rows of numbers that are equally long"
        raise CaptureError("it is no array of numbers", where=where, hint=hint) from None
    allowed = Interval(*RANGES.get(name, (-np.inf, np.inf)), open_low=open_low)
    valid = np.isfinite(numbers) & allowed.contains(numbers)
    if not valid.all():
        what = f"{numbers[~valid].flat[0]:g} is outside {allowed}"
        raise CaptureError(what, where=where, hint="give a finite number in that range")
    return numbers


def _is_number_or_image(value: np.ndarray) -> bool:
    return value.ndim == 0 or (value.ndim == 2 and value.size > 0)


# --- Captures of known truth ----------------------------------------------------------------------

NOISE: Mapping[str, float] = {
    "concentration_scale": 300.0,
    "logit_scale": 0.15,
    "normal_scale": 0.02,
    "stokes_scale": 0.01,
    "stokes_error_factor": 1.0,
    "intensity_scale": 0.01,
}
"""Noise of a careful laboratory capture, by parameter of the links."""

IMAGE = ("y", "x")

STATED_ERROR = 0.01
"""Standard error that the simulated instrument states of every reading."""

BRIGHT_QUANTILE, BRIGHT_LEVEL = 0.9, 0.6
"""Exposure: the 90% quantile of brightness is at 60% of full scale; specular lobes may saturate."""


def simulate(
    preset: str | Material = "leaf",
    *,
    scene: str | Scene | Setup = "paper",
    links: Mapping[str, AbstractLink] | None = None,
    protocol: Protocol | None = None,
    parameters: Mapping[str, float | np.ndarray] | None = None,
    noise: Mapping[str, float | np.ndarray] | None = None,
    name: str | None = None,
    seed: int = 0,
) -> xr.Dataset:
    """Draw a capture of a known material, or an image of many.

    It is an image as soon as one value has shape (y, x): every pixel is then seen from the same
    directions and draws noise of its own. All are predicted at once, which takes about 1 kB for
    each reading of a smooth scene and 2 kB of the paper's: 100,000 pixels at 12 views are 1 to 2
    GB. Larger ones are drawn some rows at a time, with a stated exposure and a seed for each part.

    Args:
        preset: A name in `PRESETS` or a `Material`.
        scene: A name in `SETUPS`, a `Scene` or a `Setup`.
        links: How each variable scatters; by default those of the scene's set-up.
        protocol: Where to look from; the paper's by default.
        parameters: Values that replace the preset's, and those of instrument terms (which are
            otherwise 0 for offsets and 1 for gains); shape (), (wavelength,) or (y, x).
        noise: Values that replace those of `NOISE`; shape () or (y, x). `exposure` is otherwise
            one number, chosen so that the brighter views come to 60% of full scale.
        name: Name of the capture; by default that of the preset.
        seed: The same seed gives the same capture.

    Returns:
        A validated capture with dims ([y, x,] view[, wavelength]). The true values are in
        `true_<parameter>`, with dims (y, x) where they are an image; readings at full scale are
        flagged `saturated`. Links that read stated errors find them as `<reading>_error`.

    Raises:
        CaptureError: No such preset, a seed, parameter or noise outside its range, or shapes that
            are not listed above or do not agree.
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
        ...     protocol=pb.simulation.Protocol(views=5, wavelengths=()),
        ...     parameters={"refractive_index": index},
        ...     noise={"exposure": light},
        ... )
    """
    protocol = protocol or Protocol()
    setup = Setup(scene, SETUPS["paper"].links) if isinstance(scene, Scene) else find_setup(scene)
    links = _checked_links(setup.links if links is None else links)
    if not isinstance(seed, int) or isinstance(seed, bool) or not 0 <= seed < 2**32:
        hint = "give an integer from 0 to 2**32 - 1"
        raise CaptureError(f"seed is {seed!r}", where="simulate", hint=hint)
    material = preset if isinstance(preset, Material) else find_preset(preset)
    wavelengths = np.asarray(protocol.wavelengths, float)
    truth = checked_parameters(setup.scene, material, wavelengths, parameters or {})
    levels = checked_noise(links, NOISE, noise or {})
    image = image_shape(truth, levels)
    given = protocol.angles(), wavelengths, truth, levels, np.uint32(seed)
    with jax.enable_x64(True):
        found = _recorder(setup.scene, links, image, given)(*given)
    recorded = {key: np.asarray(value) for key, value in found.items()}
    name = name or (preset if isinstance(preset, str) else "simulated")
    attributes: dict[str, str | int] = {"name": name, "seed": seed}
    set_up = "paper" if isinstance(scene, Scene) else setup_name(setup)
    if set_up != "custom":  # a fit takes it by default; that of a scene alone has no error
        attributes["setup"] = set_up
    return _label(recorded, protocol, IMAGE if image else (), truth, attributes)


def _checked_links(links: Mapping[str, AbstractLink]) -> dict[str, AbstractLink]:
    if not isinstance(links, Mapping) or not links:
        hint = "give a mapping such as {'dop': BetaLink()}"
        raise FitError("that is no set of links", where="simulate: links", hint=hint)
    for name, link in links.items():
        if not isinstance(link, AbstractLink) or name not in link.observables:
            what = f"{link!r} does not describe {name}"
            hint = "give a link that names it in `observables`, such as {'dop': BetaLink()}"
            raise FitError(what, where=f"simulate: links[{name!r}]", hint=hint)
    return dict(links)


_RECORDERS: LRUCache[JitOnce] = LRUCache(16)


def _recorder(
    scene: Scene, links: Mapping[str, AbstractLink], image: tuple[int, ...], given: tuple
) -> JitOnce:
    """Return the compiled `_record` of a scene and its links; new code is compiled again."""
    scene = dataclasses.replace(scene)  # without its ledger
    leaves, tree = jax.tree.flatten(given)
    shapes = str(tree), *map(np.shape, leaves)
    key = fingerprint(scene, links, image, *shapes, code=(scene, links))

    def made() -> JitOnce:
        kept = "" if uses_own_code(scene, links) else f"readings of {key}"
        return JitOnce(functools.partial(_record, scene, links, image), kept)

    return _RECORDERS.of(key, made)


def _record(
    scene: Scene,
    links: Mapping[str, AbstractLink],
    image: tuple[int, ...],
    angles: Mapping[str, Array],
    wavelengths: Array,
    truth: Mapping[str, Array],
    noise: Mapping[str, Array | None],
    seed: Array,
) -> dict[str, Array]:
    """Return readings in the layout's dims, intensity first, on which noise depends."""
    layout = _layout(angles, wavelengths, links, image)
    key_intensity, key_rest = jax.random.split(jax.random.key(seed))
    axes = len(layout.shape)
    parameters = {name: _align_image(x, axes - 1) for name, x in truth.items()}
    arriving = scene.arriving(parameters, layout.geometry)
    unlit = parameters | {"exposure": jnp.inf}  # no ambient light
    alone = scene.record(unlit, layout.geometry, arriving)["intensity"]
    light = jnp.broadcast_to(alone, layout.shape)
    # Outside its highlight a bare mirror is black: no camera exposes for what is left of a lobe
    # there, so that the brightest view sets the exposure if the contrast is larger.
    bright = jnp.maximum(jnp.quantile(light, BRIGHT_QUANTILE), jnp.max(light) / CONTRAST)
    exposure = BRIGHT_LEVEL / bright
    chosen = {name: exposure if level is None else level for name, level in noise.items()}
    levels = {name: _align_image(level, axes) for name, level in chosen.items()}
    if "exposure" in chosen:
        parameters["exposure"] = _align_image(chosen["exposure"], axes - 1)
    prediction = scene.record(parameters, layout.geometry, arriving)
    prediction = {n: jnp.broadcast_to(x, layout.shape) for n, x in prediction.items()}
    recorded: dict[str, Array] = {}
    data = layout
    if "intensity" in links:
        link = links["intensity"]
        intensity = link.distribution("intensity", prediction, layout, levels).sample(key_intensity)
        intensity = jnp.clip(intensity, 0.0, 1.0)  # of full scale
        recorded |= {"intensity": intensity, "saturated": intensity >= 1.0}
        data = dataclasses.replace(layout, brightness=intensity, saturated=recorded["saturated"])
    for (name, link), key in zip(
        links.items(), jax.random.split(key_rest, len(links)), strict=True
    ):
        if name != "intensity":
            recorded[name] = link.distribution(name, prediction, data, levels).sample(key)
    recorded |= _physical(recorded)
    errors = {
        f"{name}_error": layout.errors[name] for name, link in links.items() if link.reads_errors
    }
    return recorded | errors


def _align_image(value: Array, axes: int) -> Array:
    """Add trailing axes of length 1 to an image up to `axes` axes."""
    return value.reshape(value.shape + (1,) * (axes - 2)) if value.ndim == 2 else value


def _physical(recorded: Mapping[str, Array]) -> dict[str, Array]:
    """Limit the polarization, as instruments do: its degree is at most one."""
    stokes = {name: recorded[name] for name in ("q", "u") if name in recorded}
    length = jnp.sqrt(sum(value**2 for value in stokes.values()))
    physical = {name: value / jnp.maximum(length, 1.0) for name, value in stokes.items()}
    if "dop" in recorded:
        physical["dop"] = jnp.clip(recorded["dop"], 0.0, 1.0)
    return physical


def _layout(
    angles: Mapping[str, Array],
    wavelengths: Array,
    links: Mapping[str, AbstractLink],
    image: tuple[int, ...],
) -> Observations:
    """Return the layout of the capture without readings."""
    dims: tuple[tuple[str, int], ...] = (("view", len(angles["view_zenith"])),)
    if len(wavelengths):
        dims = (("wavelength", len(wavelengths)), *dims)
    if image:
        dims = (*zip(IMAGE, image, strict=True), *dims)
    shape = tuple(length for _, length in dims)
    colors = wavelengths[:, None] if len(wavelengths) else None
    return Observations(
        geometry=Geometry.from_degrees(**angles, wavelength=colors),
        readings={},
        errors={name: jnp.full(shape, STATED_ERROR) for name in links},
        brightness=jnp.ones(shape),
        full_scale=jnp.asarray(1.0),
        intensity_unit=jnp.asarray(1.0),
        valid=jnp.ones(shape, bool),
        saturated=jnp.zeros(shape, bool),
        dims=dims,
    )


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
        capture["intensity"].attrs["saturation_level"] = 1.0
    return validate(capture, source="simulate")
