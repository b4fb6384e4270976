"""The contract of methods beside `Point`, `Laplace` and `Nuts`: a capture in, draws out."""

import abc
import dataclasses
from typing import Any

import numpy as np

from polar_bayes.repr_html import HTMLRepr


@dataclasses.dataclass(frozen=True, eq=False)
class PosteriorDraws:
    """What a method says of one posterior."""

    kind: str
    z: np.ndarray
    stats: dict[str, np.ndarray]
    problems: list[str] = dataclasses.field(default_factory=list)
    weighted: tuple[np.ndarray, np.ndarray] | None = None
    r_hat: float = np.nan
    k_hat: float = np.nan
    effective_draws: float = np.nan
    gradients: float = np.nan
    densities: float = np.nan
    said: dict[str, Any] = dataclasses.field(default_factory=dict)
    beside: Any = None
    deadline: float = np.inf


@dataclasses.dataclass(frozen=True)
class AbstractMethod(HTMLRepr, abc.ABC):
    """How draws of a posterior are made; a small frozen dataclass of settings."""

    @abc.abstractmethod
    def draw(self, problem: Any) -> PosteriorDraws:
        """Draw from the posterior of one capture.

        Args:
            bench: The capture, ready to be fitted; a `polar_bayes.inference.problem.Bench`.

        Returns:
            The draws, and how far they can be trusted.

        Raises:
            FitError: The method does not suit the capture, or found nothing to draw from.
        """
