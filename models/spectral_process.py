"""Sparse Gaussian process over wavelength (deterministic training conditional)."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float
from tinygp import kernels

from polar_bayes.errors import FitError
from polar_bayes.models.sites import SoftClip
from polar_bayes.observation.data import Observations
from polar_bayes.physics.scene import Scene
from polar_bayes.repr_html import HTMLRepr

Knots = Float[Array, " knots"]
Wavelengths = Float[Array, " wavelength"]

KERNELS = ("Exp", "ExpSquared", "Matern32", "Matern52")
"""Decaying kernels of tinygp whose only parameter is a length."""

LEAST_NUGGET = 1e-10

# What the knots leave is a difference: its rounding is that of the factor (1e-16) over the square
# root of the nugget, times the number of knots, at most.
NUGGET_OF_REMAINDER = 1e-8


@dataclasses.dataclass(frozen=True)
class SpectralProcess(HTMLRepr):
    r"""A Gaussian process over wavelength, of unit amplitude.

    $$ f(\lambda) = k(\lambda, U)\, V L^{-T} w, \qquad L L^T = V^T [k(U, U) + \nu I] V, \qquad
       w \sim Normal(0, I) $$

    The knots U are the measured wavelengths where these are no more than `knots`: f is then the
    process itself. Beyond that, U lies evenly over their span, and any number of wavelengths
    costs `knots` parameters; what this leaves out is small where knots lie closer than a length.
    Equal wavelengths have equal values. V turns values at the knots into orthogonal polynomials:
    slope, bend, finer waves, and the mean last. It changes no probability, but which weights the
    readings know: the first ones, whatever the length is.

    The nugget $\nu$ keeps the Cholesky factor finite for equal wavelengths and endless lengths.
    For m knots and rounding $\epsilon$ of the precision in use it is
    $\max(10^{-10}, m (3 m + 5) \epsilon / 2)$ of the kernel's largest variance: what the kernel's
    rounding, the turn and the factorization can take off the smallest eigenvalue. With 20 knots
    that is 1e-10 in double and 8e-5 in single precision.

    Args:
        kernel: Name of a stationary kernel of tinygp, whose length is fitted; or a function that
            makes a kernel from a length in nm, such as
            `lambda length: kernels.RationalQuadratic(scale=length, alpha=1.0)`; or a tinygp kernel
            over nm, which is used as it is: its length is not fitted.
        knots: Number of knots beyond which a process is thinned out, at least 2.

    Raises:
        FitError: There is no such kernel, or fewer than two knots.

    Source:
        Quinonero-Candela and Rasmussen 2005, A unifying view of sparse approximate Gaussian
        process regression (deterministic training conditional); Higham 2002, Accuracy and
        Stability of Numerical Algorithms, theorem 10.7 (when a Cholesky factorization succeeds).
    """

    kernel: str | kernels.Kernel | Callable[[Array], kernels.Kernel] = "ExpSquared"
    knots: int = 20

    def __post_init__(self) -> None:
        if isinstance(self.kernel, str) and self.kernel not in KERNELS:
            what = f"there is no stationary kernel {self.kernel!r}"
            hint = f"give one of {', '.join(KERNELS)}, a tinygp kernel, or a function of length"
            raise FitError(what, where="SpectralProcess: kernel", hint=hint)
        if not isinstance(self.kernel, str) and not callable(self.kernel):
            what = f"a {type(self.kernel).__name__} is no kernel"
            hint = f"give one of {', '.join(KERNELS)}, a tinygp kernel, or a function of length"
            raise FitError(what, where="SpectralProcess: kernel", hint=hint)
        if not isinstance(self.knots, int) or isinstance(self.knots, bool) or self.knots < 2:
            what = f"knots={self.knots!r} cannot span wavelengths"
            hint = "give a whole number from 2 on; 20 is the default"
            raise FitError(what, where="SpectralProcess", hint=hint)

    @property
    def fits_length(self) -> bool:
        """True if the length is fitted; False if the kernel is an object with its own length."""
        return not isinstance(self.kernel, kernels.Kernel)

    def knot_wavelengths(self, wavelength: Wavelengths) -> Knots:
        """Return the knots of measured wavelengths in ascending order, nm."""
        if wavelength.size <= self.knots:
            return jnp.sort(wavelength)
        return jnp.linspace(jnp.min(wavelength), jnp.max(wavelength), self.knots)

    def scales(self, length: Array | None, knot_wavelengths: Knots) -> Knots:
        """Return the conditional sd of the values at the knots by each weight. 1, > 0."""
        return jnp.diag(self._factor(length, knot_wavelengths))

    def values(
        self,
        weights: Float[Array, "... knots"],
        length: Array | None,
        knot_wavelengths: Knots,
        wavelength: Wavelengths,
    ) -> Float[Array, "... wavelength"]:
        """Return the process at any wavelengths, as far as its knots determine it.

        Args:
            weights: w, standard normal. (..., knots), 1.
            length: Length of the kernel, or None where it is an object. nm, > 0.
            knot_wavelengths: The knots, from `knot_wavelengths`. nm.
            wavelength: Where to evaluate. nm.

        Returns:
            f. (..., wavelength), 1.
        """
        return weights @ self._across(length, knot_wavelengths, wavelength)

    def remainder(
        self, length: Array | None, knot_wavelengths: Knots, wavelength: Wavelengths
    ) -> Float[Array, "wavelength wavelength"]:
        """Return the lower Cholesky factor of the covariance that the knots leave undetermined.

        Args:
            length: Length of the kernel, or None where it is an object. nm, > 0.
            knot_wavelengths: The knots, from `knot_wavelengths`. nm.
            wavelength: New wavelengths. nm.

        Returns:
            A factor that standard normal numbers turn into what `values` lacks. (wavelength,
            wavelength), 1; near zero at a knot, the kernel's own far away from all. Give double
            precision: single has no digits left for it.
        """
        across = self._across(length, knot_wavelengths, wavelength)
        prior = self._matrix(length, wavelength, wavelength)
        left = prior - across.T @ across
        return jnp.linalg.cholesky(left + self._nugget(prior, NUGGET_OF_REMAINDER))

    def _across(self, length: Array | None, knot_wavelengths: Array, wavelength: Array) -> Array:
        """Return the effect of each weight on the values at wavelengths, (knots, wavelength)."""
        across = self._matrix(length, knot_wavelengths, wavelength)
        turned = _polynomials(knot_wavelengths).T @ across
        return solve_triangular(self._factor(length, knot_wavelengths), turned, lower=True)

    def _factor(self, length: Array | None, knot_wavelengths: Array) -> Array:
        covariance = self._matrix(length, knot_wavelengths, knot_wavelengths)
        turn = _polynomials(knot_wavelengths)
        return jnp.linalg.cholesky(turn.T @ (covariance + self._nugget(covariance)) @ turn)

    def _matrix(self, length: Array | None, first: Array, second: Array) -> Array:
        """Return the kernel matrix of two lists of wavelengths, in their precision."""
        if isinstance(self.kernel, str):
            kernel = getattr(kernels, self.kernel)(scale=length)
        else:
            kernel = self.kernel if length is None else self.kernel(length)
        return kernel(first, second).astype(jnp.result_type(float, first))

    def _nugget(self, covariance: Array, least: float = LEAST_NUGGET) -> Array:
        count = len(covariance)
        rounding = float(jnp.finfo(covariance.dtype).eps)
        share = max(least, 0.5 * count * (3 * count + 5) * rounding)
        return share * jnp.max(jnp.diag(covariance)) * np.eye(count, dtype=covariance.dtype)


def _polynomials(knots: Array) -> Array:
    """Return orthonormal polynomials over the knots as columns, the constant last."""
    # Householder's turn is orthogonal even where equal knots leave fewer polynomials.
    span = jnp.maximum(knots[-1] - knots[0], jnp.finfo(knots.dtype).tiny)
    inside = jnp.clip(2.0 * (knots - knots[0]) / span - 1.0, -1.0, 1.0)
    chebyshev = jnp.cos(jnp.arccos(inside)[:, None] * np.arange(len(knots), dtype=knots.dtype))
    return jax.lax.stop_gradient(jnp.roll(jnp.linalg.qr(chebyshev)[0], -1, axis=1))


# --- Spectra of a material ------------------------------------------------------------------------


SPECTRA = ("refractive_index", "absorption")

TYPICAL_ERROR = {"refractive_index": 0.003, "absorption": 0.1}
"""Typical posterior sd of n and log a at one wavelength; only sampling efficiency depends on it."""


def spectrum_around(
    name: str, level: Array, amplitude: Array, departure: Array, bounds: tuple[float, float]
) -> Array:
    r"""Return a spectrum from its level and its process.

    $$ n(\lambda) = T[l + A (f(\lambda) - \bar f)], \qquad
       a(\lambda) = l \exp(A (f(\lambda) - \bar f)) $$

    with the mean of f over the measured wavelengths taken off, so that the level is the mean over
    them (of a, the geometric mean), which readings determine; one wavelength alone is its level.
    T is `SoftClip`, which bends values near the ends of the range of the index. It does not depend
    on the amplitude, with which it would be correlated.
    """
    if name == "absorption":
        return level * jnp.exp(amplitude * departure)
    return SoftClip(*bounds)(level + amplitude * departure)


def weight_scale(name: str, scales: Knots) -> Knots:
    r"""Return the factors by which weights are widened before they are sampled.

    $$ \sqrt{1 + (s_j/\sigma)^2}, \quad \text{and 1 for the last} $$

    A weight times its scale s is a wave of the spectrum. Where readings know that wave to
    $\sigma \ll s$, the sampled number is the wave itself, whatever amplitude and length are; where
    they do not, it is the standard normal weight. So neither case has a funnel. The last weight is
    the mean of f, which no reading knows apart from the level. The posterior does not depend on
    $\sigma$.

    Source:
        Papaspiliopoulos, Roberts and Skold 2007, A general framework for the parametrization of
        hierarchical models (partially non-centered forms).
    """
    return jnp.sqrt(1.0 + (scales / TYPICAL_ERROR[name]) ** 2).at[-1].set(1.0)


def wavelengths_of(data: Observations) -> Wavelengths:
    """Return the wavelengths of a capture, nm."""
    wavelength = data.geometry.wavelength
    assert wavelength is not None  # `check_capture` has seen the axis
    return jnp.ravel(wavelength)


def check_spectra(coupled: object) -> None:
    """Refuse a value that is not a choice of spectra."""
    if not (
        isinstance(coupled, tuple) and 0 < len(coupled) == len(set(coupled).intersection(SPECTRA))
    ):
        hint = f"give a tuple of one or both of {', '.join(SPECTRA)}"
        raise FitError(f"coupled={coupled!r} names no spectra", where="GpSpectral", hint=hint)


def check_processes(coupled: tuple[str, ...], process: object) -> None:
    """Refuse processes that do not pair with their spectra."""
    given = process if isinstance(process, tuple) else (process,) * len(coupled)
    if len(given) != len(coupled) or not all(isinstance(p, SpectralProcess) for p in given):
        what = f"process={process!r} does not say what {' and '.join(coupled)} follow"
        hint = "give one SpectralProcess(), or a tuple with one for each"
        raise FitError(what, where="GpSpectral", hint=hint)


def check_capture(coupled: tuple[str, ...], data: Observations, scene: Scene) -> None:
    """Refuse a capture without colors, and a scene without spectra."""
    if "wavelength" not in dict(data.dims):
        what = "the capture has no axis wavelength to couple"
        hint = "fit it with model='per_material', or give it the axis and a coordinate in nm"
        raise FitError(what, where="gp_spectral", hint=hint)
    if scene.dispersion is None and not set(coupled) & set(scene.parameters):
        what = f"the scene reads no {' and no '.join(coupled)}"
        hint = f"couple one of {', '.join(n for n in SPECTRA if n in scene.parameters)}"
        raise FitError(what, where="gp_spectral", hint=hint)
