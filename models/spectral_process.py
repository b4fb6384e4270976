"""Smooth functions of wavelength: a Gaussian process through standard normal weights."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float
from tinygp import kernels

from polar_bayes.cards import Carded
from polar_bayes.errors import FitError

KERNELS = ("Exp", "ExpSquared", "Matern32", "Matern52")
"""The decaying kernels of tinygp that a length says all of."""

LEAST_NUGGET = 1e-10

# What the knots leave is a difference: its rounding is that of the factor (1e-16) over the square
# root of the nugget, times the number of knots, at most.
NUGGET_OF_REMAINDER = 1e-8


@dataclasses.dataclass(frozen=True)
class SpectralProcess(Carded):
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
            raise FitError(
                f"there is no stationary kernel {self.kernel!r}",
                where="SpectralProcess: kernel",
                mend=f"give one of {', '.join(KERNELS)}, a tinygp kernel, or a function of length",
            )
        if not isinstance(self.kernel, str) and not callable(self.kernel):
            raise FitError(
                f"a {type(self.kernel).__name__} is no kernel",
                where="SpectralProcess: kernel",
                mend=f"give one of {', '.join(KERNELS)}, a tinygp kernel, or a function of length",
            )
        if not isinstance(self.knots, int) or isinstance(self.knots, bool) or self.knots < 2:
            raise FitError(
                f"knots={self.knots!r} cannot span wavelengths",
                where="SpectralProcess",
                mend="give a whole number from 2 on; 20 is the default",
            )

    @property
    def fits_length(self) -> bool:
        """False where the kernel is an object, which has a length of its own."""
        return not isinstance(self.kernel, kernels.Kernel)

    def size(self, wavelengths: int) -> int:
        """How many weights a process over so many wavelengths has."""
        return min(wavelengths, self.knots)

    def places(self, wavelength: Float[Array, " wavelength"]) -> Float[Array, " knots"]:
        """The knots of these measured wavelengths in ascending order, nm."""
        if wavelength.size <= self.knots:
            return jnp.sort(wavelength)
        return jnp.linspace(jnp.min(wavelength), jnp.max(wavelength), self.knots)

    def scales(
        self, length: Float[Array, ""] | None, places: Float[Array, " knots"]
    ) -> Float[Array, " knots"]:
        """How much each weight moves the values at the knots, given those before it. 1, > 0."""
        return jnp.diag(self._factor(length, places))

    def values(
        self,
        weights: Float[Array, "... knots"],
        length: Float[Array, ""] | None,
        places: Float[Array, " knots"],
        wavelength: Float[Array, " wavelength"],
    ) -> Float[Array, "... wavelength"]:
        """The process at any wavelengths, as far as its knots determine it.

        Args:
            weights: w, standard normal. (..., knots), 1.
            length: Length of the kernel, or None where it is an object. nm, > 0.
            places: The knots, from `places`. nm.
            wavelength: Where to evaluate. nm.

        Returns:
            f. (..., wavelength), 1.

        Raises:
            Nothing.
        """
        return weights @ self._across(length, places, wavelength)

    def remainder(
        self,
        length: Float[Array, ""] | None,
        places: Float[Array, " knots"],
        wavelength: Float[Array, " wavelength"],
    ) -> Float[Array, "wavelength wavelength"]:
        """Lower Cholesky factor of the covariance that the knots leave undetermined.

        Args:
            length: Length of the kernel, or None where it is an object. nm, > 0.
            places: The knots, from `places`. nm.
            wavelength: New wavelengths. nm.

        Returns:
            A factor that standard normal numbers turn into what `values` lacks. (wavelength,
            wavelength), 1; near zero at a knot, the kernel's own far away from all. Give double
            precision: single has no digits left for it.

        Raises:
            Nothing.
        """
        across = self._across(length, places, wavelength)
        prior = self._matrix(length, wavelength, wavelength)
        left = prior - across.T @ across
        return jnp.linalg.cholesky(left + self._nugget(prior, NUGGET_OF_REMAINDER))

    def _across(self, length: Array | None, places: Array, wavelength: Array) -> Array:
        """What each weight does to the values at these wavelengths: (knots, wavelength)."""
        turned = _polynomials(places).T @ self._matrix(length, places, wavelength)
        return solve_triangular(self._factor(length, places), turned, lower=True)

    def _factor(self, length: Array | None, places: Array) -> Array:
        covariance = self._matrix(length, places, places)
        turn = _polynomials(places)
        return jnp.linalg.cholesky(turn.T @ (covariance + self._nugget(covariance)) @ turn)

    def _matrix(self, length: Array | None, first: Array, second: Array) -> Array:
        """The kernel between two lists of wavelengths, in their precision."""
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


def _polynomials(places: Array) -> Array:
    """Orthonormal polynomials over the knots, one a column, the constant last."""
    # Householder's turn is orthogonal even where equal knots leave fewer polynomials.
    span = jnp.maximum(places[-1] - places[0], jnp.finfo(places.dtype).tiny)
    inside = jnp.clip(2.0 * (places - places[0]) / span - 1.0, -1.0, 1.0)
    chebyshev = jnp.cos(jnp.arccos(inside)[:, None] * np.arange(len(places), dtype=places.dtype))
    return jax.lax.stop_gradient(jnp.roll(jnp.linalg.qr(chebyshev)[0], -1, axis=1))
