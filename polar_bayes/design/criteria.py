"""What makes one expected posterior better than another: the criteria of optimal design."""

import abc
import dataclasses
from collections.abc import Sequence
from typing import override

import numpy as np
from jaxtyping import Float

from polar_bayes.errors import FitError

LEAST = 1e-14
"""Variances below it, in squared prior sds, are rounding: one parameter follows from others."""


@dataclasses.dataclass(frozen=True)
class AbstractCriterion(abc.ABC):
    """One number for an expected covariance: the smaller, the better."""

    @abc.abstractmethod
    def loss(
        self, covariance: Float[np.ndarray, "... parameter parameter"], parameters: Sequence[str]
    ) -> Float[np.ndarray, "..."]:
        """The number that a choice of views makes small.

        Args:
            covariance: Expected covariance of the material's parameters, in their prior sds.
            parameters: Their labels, such as `refractive_index[550]`.

        Returns:
            One number for each matrix.

        Raises:
            FitError: The criterion asks for a parameter that is not there.
        """


@dataclasses.dataclass(frozen=True)
class DOptimal(AbstractCriterion):
    r"""The volume of the joint credible region: $\tfrac12 \log\det$ of the covariance.

    It does not depend on units, and counts what parameters share.

    Source:
        Atkinson, Donev & Tobias (2007), Optimum Experimental Designs, chapter 10.
    """

    @override
    def loss(
        self, covariance: Float[np.ndarray, "... parameter parameter"], parameters: Sequence[str]
    ) -> Float[np.ndarray, "..."]:
        values = np.linalg.eigvalsh(covariance)
        return 0.5 * np.sum(np.log(np.maximum(values, LEAST)), axis=-1)


@dataclasses.dataclass(frozen=True)
class AOptimal(AbstractCriterion):
    """The sum of the variances of all parameters, each in squared prior sds.

    Source:
        Atkinson, Donev & Tobias (2007), Optimum Experimental Designs, chapter 10.
    """

    @override
    def loss(
        self, covariance: Float[np.ndarray, "... parameter parameter"], parameters: Sequence[str]
    ) -> Float[np.ndarray, "..."]:
        return np.trace(covariance, axis1=-2, axis2=-1)


@dataclasses.dataclass(frozen=True)
class SingleParameter(AbstractCriterion):
    """The variance of one parameter, in squared prior sds; all others are nuisance.

    Args:
        name: Such as "refractive_index" (summed over wavelengths or patches where it has several
            values), or one of them, "refractive_index[550]".
    """

    name: str

    @override
    def loss(
        self, covariance: Float[np.ndarray, "... parameter parameter"], parameters: Sequence[str]
    ) -> Float[np.ndarray, "..."]:
        rows = [
            i for i, label in enumerate(parameters) if self.name in (label, label.split("[")[0])
        ]
        if not rows:
            raise FitError(
                "no parameter of the material has that name",
                where=f"SingleParameter({self.name!r})",
                hint=f"give one of {', '.join(parameters)}",
            )
        return np.sum(np.diagonal(covariance, axis1=-2, axis2=-1)[..., rows], axis=-1)
