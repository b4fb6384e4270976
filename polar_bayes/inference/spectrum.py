"""Spectra at wavelengths that were not measured: Gaussian process prediction from a finished fit.

Each posterior draw is conditioned on its weights at the measured wavelengths and drawn at the new
ones (Rasmussen and Williams 2006, *Gaussian Processes for Machine Learning*, section 2.2).
"""

import ast

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array, ArrayLike

from polar_bayes.errors import FitError
from polar_bayes.expressions import parse_value
from polar_bayes.inference.files import check_fit
from polar_bayes.inference.result import Provenance, attributes_of, bounds_of, provenance_of
from polar_bayes.models.gp_spectral import GpSpectral
from polar_bayes.models.spectral_process import (
    SPECTRA,
    SpectralProcess,
    spectrum_around,
    weight_scale,
)
from polar_bayes.numerics.compile import compiled
from polar_bayes.physics.dispersion import AbstractDispersion, Cauchy, Sellmeier
from polar_bayes.physics.scene import Scene


def predict_spectrum(
    result: xr.DataTree,
    wavelengths: ArrayLike,
    *,
    model: GpSpectral | None = None,
    scene: Scene | None = None,
    seed: int = 0,
) -> xr.Dataset:
    """Draw n and a at any wavelengths.

    A Gaussian process is conditioned on each posterior draw and drawn between and beyond the
    measured wavelengths, so bands widen away from them; a law of dispersion is evaluated. The
    conditional covariance is computed in double precision, whatever the precision of the fit; the
    result has the precision of the fit.

    Args:
        result: Of a fit with `GpSpectral`, or of any model in a scene with a law of dispersion;
            fresh or loaded.
        wavelengths: One number or a list. nm, > 0.
        model: The model of the fit; needed where its kernel is no name.
        scene: The scene of the fit; needed where its law of dispersion is the user's own.
        seed: The same seed gives the same draws.

    Returns:
        `refractive_index`, `absorption` or both, as far as the fit couples them, with dims
        (chain, draw, [patch or material,] wavelength).

    Raises:
        FitError: The result has neither a process nor a law, a wavelength is none, or the model
            or scene must be given.
    """
    new = _checked(wavelengths)
    check_fit(result)
    provenance = provenance_of(result)
    found: dict[str, xr.DataArray] = {}
    law = _law_of(provenance, scene)
    if law is not None:
        found["refractive_index"] = _evaluate(law, result["posterior"].dataset, new)
    processes = [n for n in SPECTRA if f"{n}_amplitude" in result["posterior"].data_vars]
    if processes:
        fitted = _model_of(provenance, model)
        for number, name in enumerate(processes):
            key = [seed, number]
            found[name] = _predict(name, fitted.process_of(name), result, provenance, new, key)
    if not found:
        raise FitError(
            "the fit ties no color to another",
            where=f"predict_spectrum: result of model {provenance.get('model', 'unknown')!r}",
            hint="fit with model='gp_spectral', or in a scene with a law of dispersion",
        )
    for name, spectrum in found.items():
        spectrum.attrs = attributes_of(name)
    return xr.Dataset(found)


def _checked(wavelengths: ArrayLike) -> np.ndarray:
    try:
        new = np.atleast_1d(np.asarray(wavelengths, float))
    except (TypeError, ValueError):
        new = np.array([np.nan])
    if new.ndim != 1 or new.size == 0 or not np.all(np.isfinite(new) & (new > 0.0)):
        raise FitError(
            f"{wavelengths!r} is no list of wavelengths",
            where="predict_spectrum: wavelengths",
            hint="give numbers above zero in nm, such as [500.0, 600.0]",
        )
    return new


def _law_of(provenance: Provenance, scene: Scene | None) -> AbstractDispersion | None:
    """Return the dispersion law: of the given scene, or of the one in the provenance."""
    if scene is not None:
        return scene.dispersion
    parts = str(provenance.get("scene_parts", ""))
    try:
        for node in ast.walk(ast.parse(parts, mode="eval")):
            law = node.value if isinstance(node, ast.keyword) and node.arg == "dispersion" else None
            if isinstance(law, ast.Call):
                known = {"Cauchy": Cauchy, "Sellmeier": Sellmeier}
                return parse_value(ast.unparse(law), known, "dispersion")
    except (SyntaxError, ValueError) as error:  # the user's own part or law
        if "dispersion=" in parts and "dispersion=None" not in parts:
            raise FitError(
                "the law of dispersion of the fit's scene is not one of this package",
                where="predict_spectrum: scene",
                hint="give the same scene again: predict_spectrum(result, wavelengths, scene=...)",
            ) from error
    return None


def _model_of(provenance: Provenance, model: GpSpectral | None) -> GpSpectral:
    """Return the model of the fit: the given one, or one from the provenance."""
    if model is not None:
        if not isinstance(model, GpSpectral):
            raise FitError(
                f"a {type(model).__name__} is not a GpSpectral",
                where="predict_spectrum: model",
                hint="give the model of the fit, such as GpSpectral()",
            )
        return model
    settings = provenance.get("model_settings") or {}
    process = settings.get("process", {})
    problem = "the fit's kernel has no name by which it can be found"
    try:
        several = isinstance(process, list)
        made = tuple(SpectralProcess(**each) for each in (process if several else [process]))
        problem = "the settings of the fit's model are not those of GpSpectral"
        return GpSpectral(
            coupled=tuple(settings.get("coupled", SPECTRA)),
            process=made if several else made[0],
            pooled=tuple(settings.get("pooled", ())),
        )
    except (FitError, TypeError, IndexError) as error:
        hint = "give the model again: predict_spectrum(result, wavelengths, model=...)"
        raise FitError(problem, where="predict_spectrum: model", hint=hint) from error


def _evaluate(law: AbstractDispersion, posterior: xr.Dataset, new: np.ndarray) -> xr.DataArray:
    """Evaluate a dispersion law with the coefficients of every draw."""
    draws = xr.DataArray(
        np.zeros((posterior.sizes["chain"], posterior.sizes["draw"])),
        coords={name: posterior[name] for name in ("chain", "draw")},
        dims=("chain", "draw"),
    )
    first, *rest = xr.broadcast(draws, *(posterior[name] for name in law.parameters))
    dtype = np.result_type(*(posterior[name] for name in law.parameters), np.float32)
    with jax.enable_x64(True):
        coefficients = {
            name: jnp.asarray(each.to_numpy())[..., None]
            for name, each in zip(law.parameters, rest, strict=True)
        }
        index = np.asarray(law.index(coefficients, jnp.asarray(new)), dtype)
    return _label(np.broadcast_to(index, (*first.shape, new.size)), first, new)


def _predict(
    name: str,
    process: SpectralProcess,
    result: xr.DataTree,
    provenance: Provenance,
    new: np.ndarray,
    seed: list[int],
) -> xr.DataArray:
    """Draw a process at `new` wavelengths, given draws of its weights and parameters."""
    posterior = result["posterior"].dataset
    coordinates = result.children.get("unconstrained_posterior", xr.DataTree()).dataset
    needed = {name: posterior, f"{name}_level": posterior, f"{name}_weights": coordinates}
    for variable, group in needed.items():
        if variable not in group or (variable == name and "wavelength" not in group[name].coords):
            raise FitError(
                f"it has no draws of {variable} by wavelength",
                where="predict_spectrum: result",
                hint="give the tree that polar_bayes.fit or load returned",
            )
    level = posterior[f"{name}_level"]
    leading = [dim for dim in level.dims if dim not in ("chain", "draw")]
    level = level.transpose("chain", "draw", *leading)
    weights = coordinates[f"{name}_weights"].transpose("chain", "draw", *leading, ...).to_numpy()
    measured = posterior[name].coords["wavelength"].to_numpy()
    if process.fits_length != (f"{name}_length" in posterior):
        raise FitError(
            "the model given does not read the length that the fit has, or the other way round",
            where="predict_spectrum: model",
            hint="give the model of the fit",
        )
    prior = f"{name}_level_location" if f"{name}_level_location" in posterior else f"{name}_level"
    bounds = bounds_of(provenance, prior)
    # A wavelength that is given twice gets the same draw twice.
    distinct, again = np.unique(new, return_inverse=True)
    dtype = weights.dtype
    old, at = (np.asarray(part, dtype) for part in (measured, distinct))

    def one(draw: dict[str, Array]) -> Array:
        length, knot_wavelengths = draw.get("length"), process.knot_wavelengths(jnp.asarray(old))
        widening = weight_scale(name, draw["amplitude"] * process.scales(length, knot_wavelengths))
        both = jnp.concatenate([jnp.asarray(old), jnp.asarray(at)])
        values = process.values(draw["weights"] / widening, length, knot_wavelengths, both)
        mean = jnp.mean(values[..., : old.size], axis=-1, keepdims=True)
        factor = process.remainder(
            None if length is None else length.astype(float),
            knot_wavelengths.astype(float),
            jnp.asarray(distinct),
        )
        remainder = draw["noise"] @ factor.T
        departure = values[..., old.size :] - mean + remainder.astype(dtype)
        return spectrum_around(name, draw["level"][..., None], draw["amplitude"], departure, bounds)

    flat = (-1, *level.shape[2:])
    count = level.shape[0] * level.shape[1]
    draws = {
        "weights": weights.reshape(*flat, weights.shape[-1]),
        "level": level.to_numpy().reshape(flat),
        "amplitude": posterior[f"{name}_amplitude"].transpose("chain", "draw").to_numpy().ravel(),
        "noise": np.random.default_rng(seed).normal(size=(count, *flat[1:], distinct.size)),
    }
    if process.fits_length:
        draws["length"] = posterior[f"{name}_length"].transpose("chain", "draw").to_numpy().ravel()
    with jax.enable_x64(True):
        found = compiled(lambda all_draws: jax.lax.map(one, all_draws, batch_size=64))(draws)
    spectra = np.asarray(found, dtype)[..., again]
    return _label(spectra.reshape(*level.shape, new.size), level, new)


def _label(values: np.ndarray, draws: xr.DataArray, new: np.ndarray) -> xr.DataArray:
    return xr.DataArray(
        values,
        coords={**{dim: draws[dim] for dim in draws.dims}, "wavelength": new},
        dims=(*draws.dims, "wavelength"),
    )
