"""What a simulated capture is drawn from: parameters and noise, checked, and the image they span.

A value is one number, one for each wavelength, or an image (y, x): its rank says which.
"""

from collections.abc import Mapping

import numpy as np

from polar_bayes.errors import CaptureError, FitError, SceneError
from polar_bayes.observation.links import AbstractLink, noise_parameters
from polar_bayes.physics.scene import Scene
from polar_bayes.priors import RANGES
from polar_bayes.simulation.presets import Material

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

Value = float | np.ndarray


def checked_parameters(
    scene: Scene, material: Material, wavelengths: np.ndarray, overrides: Mapping[str, Value]
) -> dict[str, np.ndarray]:
    """A value for every parameter of the scene."""
    unknown = set(overrides) - set(scene.parameters)
    if unknown:
        raise SceneError(
            f"the scene has no parameter {', '.join(sorted(unknown))}",
            where="simulate: parameters",
            mend=f"give any of {', '.join(scene.parameters)}",
        )
    known = material.at(wavelengths if wavelengths.size else np.asarray(550.0))
    given = {name: _numbers(_parameter(name), value) for name, value in overrides.items()}
    available = {**NEUTRAL, **known, **given}
    missing = [name for name in scene.parameters if name not in available]
    if missing:
        raise SceneError(
            f"no value for {', '.join(missing)}",
            where="simulate: parameters",
            mend=f"give parameters={{{missing[0]!r}: <a number>}}",
        )
    truth = {name: available[name] for name in scene.parameters}
    for name, value in truth.items():
        where = _parameter(name)
        _check_range(where, name, value)
        if is_vector(name):
            _check_shape(where, value, value.ndim <= 1, "give one number for each function")
            continue
        color = wavelengths.size > 0 and value.shape == wavelengths.shape
        each = f", or one per wavelength ({wavelengths.size})" if wavelengths.size else ""
        mend = f"give one number{each}, or an image (y, x)"
        _check_shape(where, value, color or _is_number_or_image(value), mend)
    return truth


def checked_noise(
    links: Mapping[str, AbstractLink], usual: Mapping[str, float], overrides: Mapping[str, Value]
) -> dict[str, np.ndarray | None]:
    """A value for every noise parameter of the links."""
    parameters = noise_parameters(links)
    unknown = set(overrides) - set(parameters)
    if unknown:
        raise FitError(
            f"no link reads {', '.join(sorted(unknown))}",
            where="simulate: noise",
            mend=f"give any of {', '.join(parameters)}",
        )
    given: dict[str, Value | None] = {"exposure": None, **usual, **overrides}
    levels: dict[str, np.ndarray | None] = {}
    for name in parameters:
        where = f"simulate: noise[{name!r}]"
        if name not in given:
            raise FitError(
                "it has no value", where=where, mend=f"give noise={{{name!r}: <number>}}"
            )
        value = given[name]
        if value is None:
            levels[name] = None
            continue
        level = levels[name] = _numbers(where, value)
        _check_range(where, name, level, above=True)
        mend = "give one number, or an image (y, x)"
        _check_shape(where, level, _is_number_or_image(level), mend)
    return levels


def image_of(
    parameters: Mapping[str, np.ndarray], noise: Mapping[str, np.ndarray | None]
) -> tuple[int, ...]:
    """The image that parameters and noise span together."""
    named = [(f"parameters[{name!r}]", value) for name, value in parameters.items()]
    named += [(f"noise[{name!r}]", level) for name, level in noise.items() if level is not None]
    images = [(name, value.shape) for name, value in named if value.ndim == 2]
    for name, shape in images[1:]:
        first, expected = images[0]
        if shape != expected:
            raise CaptureError(
                f"its shape is {shape} and that of {first} is {expected}",
                where=f"simulate: {name}",
                mend="give images (y, x) of one shape",
            )
    return images[0][1] if images else ()


def is_vector(name: str) -> bool:
    """True of a parameter that has an axis of its own, for which a capture has no dim."""
    return np.ndim(NEUTRAL.get(name, 0.0)) > 0


def _parameter(name: str) -> str:
    return f"simulate: parameters[{name!r}]"


def _numbers(where: str, value: Value) -> np.ndarray:
    try:
        return np.asarray(value, float)
    except (TypeError, ValueError):
        raise CaptureError(
            "it is no array of numbers",
            where=where,
            mend="give a number, or rows of numbers that are equally long",
        ) from None


def _is_number_or_image(value: np.ndarray) -> bool:
    return value.ndim == 0 or (value.ndim == 2 and value.size > 0)


def _check_shape(where: str, value: np.ndarray, fits: bool, mend: str) -> None:
    if not fits:
        raise CaptureError(f"its shape is {value.shape}", where=where, mend=mend)


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
