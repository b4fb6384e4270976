"""The contract of methods beside `Point`, `Laplace` and `Nuts`: a capture in, draws out."""

import abc
import dataclasses
from typing import Any

import numpy as np

from polar_bayes.cards import Carded


@dataclasses.dataclass(frozen=True, eq=False)
class Answer:
    """What a method says of one posterior.

    Args:
        kind: How the draws were made: "nuts", "laplace", "point", "importance", "tempered",
            "variational", or a word of one's own. Verdict and report follow it: "nuts" is judged by
            R-hat, "laplace" and "variational" by the statistic `log_weight`.
        z: Unconstrained draws of the model, all worth the same, (chain, draw, size).
        stats: Statistics of the draws, each (chain, draw).
        problems: What makes them unusable.
        weighted: The draws and weights that `z` was chosen from, (draw, size) and (draw,); None
            where there are none.
        r_hat: Largest of all coordinates; NaN where there are no chains.
        k_hat: Pareto k-hat of the importance weights; NaN where there are none.
        effective_draws: How many independent draws these are worth, the least of all coordinates.
        gradients: Evaluations of the log density with its gradient; NaN where nobody counts.
        densities: Evaluations of the log density alone, likewise.
        said: What else belongs into the provenance; JSON must hold it.
        beside: Settings that fit the comparisons beside this answer, where a method has chosen
            another; None where they are its own.
        deadline: Of `time.perf_counter`, s; comparisons that are not done by then are abandoned.
    """

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
class AbstractMethod(Carded, abc.ABC):
    """How draws of a posterior are made; a small frozen dataclass of settings."""

    @abc.abstractmethod
    def draw(self, bench: Any) -> Answer:
        """Draw from the posterior of one capture.

        Args:
            bench: The capture, ready to be fitted; a `polar_bayes.inference.bench.Bench`.

        Returns:
            The draws, and how far they can be trusted.

        Raises:
            FitError: The method does not suit the capture, or found nothing to draw from.
        """
