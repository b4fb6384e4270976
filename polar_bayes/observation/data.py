"""A capture as arrays, for compiled programs.

Labels are dropped here and restored in `polar_bayes.inference.result`. Missing readings become
placeholders with `valid=False`, so that every shape is static and no entry is dropped.
"""

from collections.abc import Collection

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array, Bool, Float, Int

from polar_bayes.physics.geometry import Geometry

READINGS = ("dop", "q", "u", "intensity")
ANGLES = ("view_zenith", "view_azimuth", "light_zenith", "light_azimuth")


class Observations(eqx.Module):
    """One capture in the layout of a model: leading dims, then wavelength, then view.

    Args:
        geometry: Directions in degree, each broadcastable to the readings.
        readings: The recorded variables, each (..., [wavelength,] view).
        errors: Their stated standard errors, where the capture has them.
        brightness: Recorded intensity over the largest of the capture; 1 without intensity.
        full_scale: Where the sensor saturates, in the unit of `readings["intensity"]`.
        intensity_unit: What an intensity reading of 1 is in the capture's own unit.
        valid: False where a view is missing or set aside.
        saturated: True where the intensity is censored at full scale; the polarization of such a
            view comes from frames that are full, and does not count.
        dims: Names and lengths of all axes, outermost first, ending with the view.
        confidence: Confidence in the stated normal, in (0, 1], which broadcasts with the readings;
            None where the capture states none.
        shared: Means and sds of normal priors, in the unconstrained coordinates, of parameters
            that other pixels determine too; they replace the priors of those names.
        held: Values of latent sites that are not estimated, in their supports, NaN where one is;
            a site that is not among them is estimated.
        views: How many views the capture has; those beyond are padding, never valid, or candidates
            for which no exposure was set. None where there are no others.
    """

    geometry: Geometry
    readings: dict[str, Float[Array, "... view"]]
    errors: dict[str, Float[Array, "... view"]]
    brightness: Float[Array, "... view"]
    full_scale: Float[Array, ""]
    intensity_unit: Float[Array, ""]
    valid: Bool[Array, "... view"]
    saturated: Bool[Array, "... view"]
    dims: tuple[tuple[str, int], ...] = eqx.field(static=True)
    confidence: Float[Array, "... #view"] | None = None
    shared: dict[str, tuple[Float[Array, "..."], Float[Array, "..."]]] = eqx.field(
        default_factory=dict
    )
    held: dict[str, Float[Array, "..."]] = eqx.field(default_factory=dict)
    views: Int[Array, ""] | None = None

    @property
    def shape(self) -> tuple[int, ...]:
        """Lengths of all axes, outermost first."""
        return tuple(length for _, length in self.dims)

    @property
    def leading(self) -> tuple[tuple[str, int], ...]:
        """Names and lengths of the axes of materials, patches or pixels."""
        return tuple(axis for axis in self.dims if axis[0] not in ("wavelength", "view"))

    def fitted(self, name: str) -> Bool[Array, "... view"]:
        """Which readings of a variable count; saturated frames do not tell the polarization."""
        return self.valid if name == "intensity" else self.valid & ~self.saturated

    @property
    def measured(self) -> slice:
        """The views of the capture, along the last axis."""
        return slice(None if self.views is None else int(self.views))

    @property
    def is_measured(self) -> Bool[Array, " view"]:
        """True for the views of the capture."""
        count = self.shape[-1]
        return jnp.arange(count) < (count if self.views is None else self.views)

    def in_single_precision(self) -> "Observations":
        """Return the readings as 32-bit numbers; masks are unchanged."""
        return jax.tree.map(lambda x: x.astype(jnp.float32) if x.dtype == jnp.float64 else x, self)


def padded_length(views: int) -> int:
    """Return the number of views to compile for: 8, 12, 16, 24, 32, 48, 64, ..."""
    power = max(8, 1 << (views - 1).bit_length())
    between = 3 * power // 4
    return between if 8 < between and views <= between else power


def observe(
    capture: xr.Dataset,
    *,
    largest_view_zenith: float = 90.0,
    intensity_unit: float | None = None,
    padded: bool = False,
    described: Collection[str] = READINGS,
) -> Observations:
    """Convert a validated capture to arrays, padded to `padded_length` on request.

    A saturated view is not valid unless the intensity is among the `described` variables.
    """
    views = capture.sizes["view"]
    if padded:  # by the last view again, whose directions are possible ones
        capture = capture.isel(view=np.minimum(np.arange(padded_length(views)), views - 1))
    names = [name for name in READINGS if name in capture]
    order = _axis_order(capture[names[0]])
    measured = np.asarray(_values(capture, "valid", order, default=True), bool)
    largest, full_scale = _intensity_range(capture, order, measured, intensity_unit)
    valid = measured & (_values(capture, "view_zenith", order) <= largest_view_zenith)
    valid = valid & (np.arange(capture.sizes["view"]) < views)
    saturated = np.asarray(_values(capture, "saturated", order, default=False), bool)
    if np.isfinite(full_scale):  # a reading at full scale is censored, flagged or not
        saturated = saturated | (_values(capture, "intensity", order) >= full_scale)
    valid = valid if "intensity" in described else valid & ~saturated
    shape = np.broadcast_shapes(
        valid.shape, *(_values(capture, name, order).shape for name in names)
    )
    valid, saturated = (np.broadcast_to(mask, shape) for mask in (valid, saturated))

    readings, errors = {}, {}
    for name in names:
        unit = largest if name == "intensity" else 1.0
        # 0.5 is inside the range of every reading; `valid` keeps it out of the likelihood.
        readings[name] = np.where(valid, _values(capture, name, order), 0.5 * unit) / unit
        if f"{name}_error" in capture:
            error = _values(capture, f"{name}_error", order)
            errors[name] = np.where(valid, error, unit) / unit
    brightness = readings.get("intensity", np.ones(shape))
    stated = {name: _values(capture, name, order) for name in ANGLES}
    angles = {name: np.where(np.isfinite(x), x, 0.0) for name, x in stated.items()}
    if "wavelength" in capture.coords:
        angles["wavelength"] = _values(capture, "wavelength", order)
    confidence = None
    if "normal_confidence" in capture:
        confidence = _values(capture, "normal_confidence", order)
    arrays = {
        "readings": readings,
        "errors": errors,
        "brightness": np.clip(brightness, 0.0, 1.0),
        "full_scale": np.asarray(full_scale / largest),
        "intensity_unit": np.asarray(largest),
        "valid": valid,
        "saturated": saturated,
        "confidence": confidence,
        "views": np.int32(views) if padded else None,
    }
    return Observations(
        geometry=Geometry.from_degrees(**angles),
        dims=tuple(zip(order, shape, strict=True)),
        **jax.device_put(arrays),  # where `jnp.asarray` of each would run a program
    )


def _axis_order(reading: xr.DataArray) -> tuple[str, ...]:
    last = [dim for dim in ("wavelength", "view") if dim in reading.dims]
    return (*(str(dim) for dim in reading.dims if dim not in last), *last)


def _values(
    capture: xr.Dataset, name: str, order: tuple[str, ...], default: bool | None = None
) -> np.ndarray:
    """Return one variable with the axes of `order`; missing axes have length 1."""
    if name not in capture and default is not None:
        return np.full((1,) * len(order), default)
    variable = capture[name]
    present = [dim for dim in order if dim in variable.dims]
    values = variable.transpose(*present).to_numpy()
    return values.reshape([variable.sizes.get(dim, 1) for dim in order])


def _intensity_range(
    capture: xr.Dataset, order: tuple[str, ...], measured: np.ndarray, unit: float | None
) -> tuple[float, float]:
    """Return the unit of intensity (saturation level or largest reading) and full scale."""
    if "intensity" not in capture:
        return 1.0, np.inf
    level = capture["intensity"].attrs.get("saturation_level")
    if level is not None:
        return float(level), float(level)
    if unit is not None:
        return unit, np.inf
    # Over the whole capture, angles set aside included: leaving out the views beyond a limit
    # changes no other's noise. Missing entries hold anything, so they do not count.
    largest = float(np.max(_values(capture, "intensity", order), where=measured, initial=0.0))
    return (largest if largest > 0.0 else 1.0), np.inf
