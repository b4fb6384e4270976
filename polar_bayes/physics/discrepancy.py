"""What the optics does not know: a smooth unknown factor between the channels, over angle."""

import dataclasses
import math
from collections.abc import Mapping
from typing import ClassVar, override

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polar_bayes.errors import SceneError
from polar_bayes.physics.geometry import Geometry
from polar_bayes.physics.instrument import AbstractInstrumentTerm, diattenuate
from polar_bayes.physics.stokes import Light

# View angles run over 0 to 90 degrees; the basis vanishes at the ends of a domain this much wider.
MIDDLE, HALF_WIDTH, WIDER = 45.0, 45.0, 1.3


@dataclasses.dataclass(frozen=True)
class Discrepancy(AbstractInstrumentTerm):
    r"""A smooth factor exp(f) on the ratio of channels s and p, over the view zenith.

    $$ f(\theta) = \text{amplitude} \sum_j w_j \sqrt{S(\omega_j)}\,
       \sin\!\Big(\frac{j\pi(x+L)}{2L}\Big), \qquad
       q' = \frac{q+t}{1+qt}, \quad t = \tanh(f/2) $$

    A Gaussian process with squared-exponential kernel, in its Hilbert-space approximation. With
    standard normal weights the amplitude is the root mean square of f over 0 to 90 degrees.

    Parameters are `discrepancy_amplitude` (...) and `discrepancy_weights` (..., basis).

    Args:
        basis: Number of basis functions, at least 1.
        length: Length scale, degree, > 0.

    Raises:
        SceneError: The number or the length is not positive.

    Source:
        Solin and Sarkka 2020, Hilbert space methods for reduced-rank Gaussian process regression.
    """

    basis: int = 4
    length: float = 25.0

    parameters: ClassVar[tuple[str, ...]] = ("discrepancy_amplitude", "discrepancy_weights")

    def __post_init__(self) -> None:
        if not (isinstance(self.basis, int) and self.basis >= 1 and self.length > 0.0):
            raise SceneError(
                f"basis={self.basis!r} and length={self.length!r} make no smooth function",
                where="Discrepancy",
                hint="give a whole number of functions from 1 on and a length above 0 degrees",
            )

    @override
    def record(self, parameters: Mapping[str, Array], geometry: Geometry, light: Light) -> Light:
        # Weights come as (..., basis, 1): the scene's view axis stands last, as in the functions.
        weights = parameters["discrepancy_weights"]
        smooth = jnp.sum(weights * self.functions(geometry.view_zenith), axis=-2)
        half_log_ratio = 0.5 * parameters["discrepancy_amplitude"] * smooth
        return diattenuate(light, jnp.tanh(half_log_ratio), 1.0 / jnp.cosh(half_log_ratio))

    def functions(self, view_zenith: Array) -> Array:
        """Basis functions, scaled by the spectrum: (..., view) -> (..., basis, view)."""
        frequency, scale = self._spectrum()
        phase = view_zenith[..., None, :] + (HALF_WIDTH * WIDER - MIDDLE)
        dtype = jnp.result_type(float, view_zenith)
        return jnp.asarray(scale[:, None], dtype) * jnp.sin(
            jnp.asarray(frequency[:, None], dtype) * phase
        )

    def _spectrum(self) -> tuple[np.ndarray, np.ndarray]:
        """Frequencies, and amplitudes that make the mean variance over 0 to 90 degrees one."""
        span = 2.0 * HALF_WIDTH * WIDER
        frequency = math.pi * np.arange(1, self.basis + 1) / span
        amplitude = np.exp(-((self.length * frequency) ** 2) / 4.0)
        angle = np.linspace(0.0, 90.0, 181)[:, None] + (HALF_WIDTH * WIDER - MIDDLE)
        variance = np.mean(np.sum((amplitude * np.sin(frequency * angle)) ** 2, axis=1))
        return frequency, amplitude / math.sqrt(variance)
