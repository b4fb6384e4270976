"""Spectra of a material: which there are, and how a process around a level makes one."""

import jax.numpy as jnp
from jaxtyping import Array, Float
from polar_bayes.models.bounds import Bent
from polar_bayes.models.spectral_process import SpectralProcess

from polar_bayes.errors import FitError
from polar_bayes.observation.data import Observations
from polar_bayes.physics.scene import Scene

SPECTRA = ("refractive_index", "absorption")

TYPICAL_ERROR = {"refractive_index": 0.003, "absorption": 0.1}
"""How well a fair capture tells n and log a of one color; only the ease of sampling leans on it."""


def around(
    name: str, level: Array, amplitude: Array, departure: Array, bounds: tuple[float, float]
) -> Array:
    r"""A spectrum from its level and its process.

    $$ n(\lambda) = T[l + A (f(\lambda) - \bar f)], \qquad
       a(\lambda) = l \exp(A (f(\lambda) - \bar f)) $$

    with the mean of f over the measured wavelengths taken off, so that the level is the mean over
    them (of a, the geometric mean), which readings determine; one wavelength alone is its level.
    T is `Bent`: it bends what comes near the ends of the range of the index. It does not depend on
    the amplitude, which would tie the two together.

    Args:
        name: refractive_index or absorption.
        level: l. (..., 1) or (), unit of the parameter.
        amplitude: A; of the index in its unit, of the absorption in units of log a. ().
        departure: f less its mean over the measured wavelengths. (..., wavelength).
        bounds: The range of the index.

    Returns:
        The spectrum. (..., wavelength).

    Raises:
        Nothing.
    """
    if name == "absorption":
        return level * jnp.exp(amplitude * departure)
    return Bent(*bounds)(level + amplitude * departure)


def widening_of(name: str, scales: Float[Array, " knots"]) -> Float[Array, " knots"]:
    r"""By how much weights are widened before they are sampled.

    $$ \sqrt{1 + (s_j/\sigma)^2}, \quad \text{and 1 for the last} $$

    A weight times its scale s is a wave of the spectrum. Where readings know that wave to
    $\sigma \ll s$, the sampled number is the wave itself, whatever amplitude and length are; where
    they do not, it is the standard normal weight. So neither case has a funnel. The last weight is
    the mean of f, which no reading knows apart from the level. The posterior does not depend on
    $\sigma$.

    Args:
        name: refractive_index or absorption.
        scales: s, amplitude included. (knots,).

    Returns:
        (knots,), 1, at least 1.

    Raises:
        Nothing.

    Source:
        Papaspiliopoulos, Roberts and Skold 2007, A general framework for the parametrization of
        hierarchical models (partially non-centered forms).
    """
    return jnp.sqrt(1.0 + (scales / TYPICAL_ERROR[name]) ** 2).at[-1].set(1.0)


def wavelengths_of(data: Observations) -> Float[Array, " wavelength"]:
    """The wavelengths of a capture, nm."""
    wavelength = data.geometry.wavelength
    assert wavelength is not None  # `check_capture` has seen the axis
    return jnp.ravel(wavelength)


def check_spectra(coupled: object) -> None:
    """Refuse what is no choice of spectra."""
    if (
        not isinstance(coupled, tuple)
        or not coupled
        or len(set(coupled)) != len(coupled)
        or not set(coupled) <= set(SPECTRA)
    ):
        raise FitError(
            f"coupled={coupled!r} names no spectra",
            where="GpSpectral",
            mend=f"give a tuple of one or both of {', '.join(SPECTRA)}",
        )


def check_processes(coupled: tuple[str, ...], process: object) -> None:
    """Refuse processes that do not pair with their spectra."""
    given = process if isinstance(process, tuple) else (process,) * len(coupled)
    if len(given) != len(coupled) or not all(isinstance(p, SpectralProcess) for p in given):
        raise FitError(
            f"process={process!r} does not say what {' and '.join(coupled)} follow",
            where="GpSpectral",
            mend="give one SpectralProcess(), or a tuple with one for each",
        )


def check_capture(coupled: tuple[str, ...], data: Observations, scene: Scene) -> None:
    """Refuse a capture without colors, and a scene without spectra."""
    if "wavelength" not in dict(data.dims):
        raise FitError(
            "the capture has no axis wavelength to couple",
            where="gp_spectral",
            mend="fit it with model='per_material', or give it the axis and a coordinate in nm",
        )
    if scene.dispersion is None and not set(coupled) & set(scene.parameters):
        raise FitError(
            f"the scene reads no {' and no '.join(coupled)}",
            where="gp_spectral",
            mend=f"couple one of {', '.join(n for n in SPECTRA if n in scene.parameters)}",
        )
