r"""Stokes parameters from readings behind a linear polarizer, with their noise.

A polarizer at angle $\chi$ lets pass $I(\chi) = (S_0 + S_1 \cos 2\chi + S_2 \sin 2\chi)/2$. Three
angles or more determine S by least squares, $S = (A^T A)^{-1} A^T I = P I$, with the covariance
$P\,\mathrm{diag}(\sigma^2) P^T$. Weights would take the noise from the noisy readings themselves,
so that dark ones would count too much and bias S; with four angles there is little to gain.

The noise of $q = S_1/S_0$ and $u = S_2/S_0$ follows to first order, their correlation with it. A
degree of polarization $p = \sqrt{q^2 + u^2}$ is never negative, so noise alone makes it positive.
The modified asymptotic estimator takes that off:

$$ \hat p = p - b^2 \frac{1 - e^{-p^2/b^2}}{2p}, \qquad
   b^2 = d_\perp^T C d_\perp, \qquad \sigma_p^2 = d^T C d, \qquad d = (q, u)/p $$

It is never negative and continuous, and without bias where p is well above its noise. Unpolarized
light still reads 0.99 of its noise (p itself: 1.25), since nothing that is never negative can read
zero on average: fits should read q and u, which carry their sign.

Source:
    Plaszczynski, Montier, Levrier and Tristram 2014, A novel estimator of the polarization
    amplitude from normally distributed Stokes parameters, MNRAS 439, 4048 (arXiv:1312.0437).
"""

import dataclasses

import numpy as np

from polar_bayes.capture.schema import as_numbers
from polar_bayes.errors import CaptureError


@dataclasses.dataclass(frozen=True, eq=False)
class StokesImage:
    """Normalized Stokes parameters with their noise, each of shape (row, column)."""

    intensity: np.ndarray
    q: np.ndarray
    u: np.ndarray
    intensity_variance: np.ndarray
    q_variance: np.ndarray
    u_variance: np.ndarray
    covariance: np.ndarray
    misfit: np.ndarray | None

    def rotated(self, cos: np.ndarray, sin: np.ndarray) -> "StokesImage":
        """Return the Stokes parameters in axes rotated counterclockwise, as the camera sees it."""
        q_variance, u_variance, between = self.q_variance, self.u_variance, self.covariance
        mixed = 2.0 * cos * sin * between
        return dataclasses.replace(
            self,
            q=self.q * cos + self.u * sin,
            u=self.u * cos - self.q * sin,
            q_variance=cos**2 * q_variance + sin**2 * u_variance + mixed,
            u_variance=sin**2 * q_variance + cos**2 * u_variance - mixed,
            covariance=(cos**2 - sin**2) * between + cos * sin * (u_variance - q_variance),
        )

    @property
    def correlation(self) -> np.ndarray:
        """Correlation of the errors of q and u, (row, column)."""
        return self.covariance / np.sqrt(self.q_variance * self.u_variance)


def fit_stokes(light: np.ndarray, variance: np.ndarray, angles: object) -> StokesImage:
    """Estimate Stokes parameters by least squares."""
    design = polarizer_design(check_angles(angles))
    solve = np.linalg.pinv(design)
    S = np.einsum("sa,ayx->syx", solve, light)
    C = np.einsum("sa,ta,ayx->styx", solve, solve, variance)
    with np.errstate(divide="ignore", invalid="ignore"):
        q, u = S[1] / S[0], S[2] / S[0]
        brightness = S[0] ** 2
        q_variance = (C[1, 1] - 2.0 * q * C[0, 1] + q**2 * C[0, 0]) / brightness
        u_variance = (C[2, 2] - 2.0 * u * C[0, 2] + u**2 * C[0, 0]) / brightness
        covariance = (C[1, 2] - q * C[0, 2] - u * C[0, 1] + q * u * C[0, 0]) / brightness
    return StokesImage(
        intensity=0.5 * S[0],
        q=q,
        u=u,
        intensity_variance=0.25 * C[0, 0],
        q_variance=q_variance,
        u_variance=u_variance,
        covariance=covariance,
        misfit=_misfit(light, variance, design, solve),
    )


def unbiased_dop(image: StokesImage) -> tuple[np.ndarray, np.ndarray]:
    """Return the degree of polarization, corrected for the bias by noise, and its error."""
    p = np.hypot(image.q, image.u)
    with np.errstate(divide="ignore", invalid="ignore"):
        along_q = np.where(p > 0.0, image.q / p, 1.0)
        along_u = np.where(p > 0.0, image.u / p, 0.0)
        mixed = 2.0 * along_q * along_u * image.covariance
        error = along_q**2 * image.q_variance + along_u**2 * image.u_variance + mixed
        bias = along_u**2 * image.q_variance + along_q**2 * image.u_variance - mixed
        ratio = p / np.sqrt(bias)
        # (1 - exp(-r^2))/(2 r) without a quotient of two zeros at r = 0.
        taken = np.sqrt(bias) * np.where(ratio > 0.0, -np.expm1(-(ratio**2)) / (2.0 * ratio), 0.0)
    return p - taken, np.sqrt(error)


def check_angles(angles: object) -> np.ndarray:
    """Refuse polarizer angles unless they determine all three Stokes parameters."""
    degrees = as_numbers(angles)
    if degrees.ndim != 1 or not (np.abs(degrees) <= 360.0).all():
        hint = "give one number from -360 to 360 for each frame"
        raise CaptureError(f"{angles!r} are no angles", where="angles", hint=hint)
    different = np.unique(np.round(degrees % 180.0, 6) % 180.0)
    listed = ", ".join(f"{angle:g}" for angle in degrees)
    if different.size < 3:
        what = f"the polarizer stood at {different.size} different angles ({listed})"
        raise CaptureError(what, where="angles", hint="give three or more; 0 and 180 are the same")
    condition = float(np.linalg.cond(polarizer_design(degrees)))
    if condition > 100.0:
        what = f"{listed} are so close that noise grows {condition:.0f}-fold"
        hint = "spread them over 180 degrees, such as 0, 60 and 120"
        raise CaptureError(what, where="angles", hint=hint)
    return degrees


def polarizer_design(degrees: np.ndarray) -> np.ndarray:
    """Return the sensitivity of each angle to S0, S1 and S2, (angle, 3)."""
    twice = np.deg2rad(2.0 * degrees)
    return 0.5 * np.stack([np.ones_like(twice), np.cos(twice), np.sin(twice)], axis=-1)


def _misfit(
    light: np.ndarray, variance: np.ndarray, design: np.ndarray, solve: np.ndarray
) -> np.ndarray | None:
    """Return the mean squared residual over its variance; None for three angles."""
    beyond = np.linalg.svd(design)[0].T[design.shape[1] :]
    if not len(beyond):
        return None
    rest = np.einsum("ka,ayx->kyx", beyond, light)
    spread = np.einsum("ka,ka,ayx->kyx", beyond, beyond, variance)
    return np.mean(rest**2 / spread, axis=0)
