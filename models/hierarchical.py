"""Many patches, or many materials, that resemble each other: pooling (the paper's section 2).

What one patch cannot tell about its index, the others can: each index is drawn from a population
whose mean and spread are inferred with it. A spread near zero pools completely, a large one not
at all; the data decide.
"""

import dataclasses
from collections.abc import Mapping

from numpyro import distributions as dist
from polar_bayes.models.axes import draw_own, material_parameters, unchanging
from polar_bayes.models.population import check_members, check_pooled, draw_pooled
from polar_bayes.models.readings import declare_readings

from polar_bayes.cards import Carded
from polar_bayes.errors import FitError
from polar_bayes.observation.data import Observations
from polar_bayes.observation.links import AbstractLink
from polar_bayes.physics.scene import Scene


@dataclasses.dataclass(frozen=True)
class Hierarchical(Carded):
    """Parameters of all patches drawn from common populations.

    Args:
        pooled: The parameters that have a population; the others are each patch's own.

    Raises:
        FitError: A name is no parameter of a material, or there is none.
    """

    pooled: tuple[str, ...] = ("refractive_index",)

    def __post_init__(self) -> None:
        check_pooled(self.pooled, where="Hierarchical")
        if not self.pooled:
            raise FitError(
                "nothing is pooled",
                where="Hierarchical",
                mend="name a parameter, or use model='per_material'",
            )

    def __call__(
        self,
        data: Observations,
        scene: Scene,
        priors: Mapping[str, dist.Distribution],
        links: Mapping[str, AbstractLink],
    ) -> None:
        """Declare the story of a capture with a leading axis (patch or material)."""
        check_members(self.pooled, data, scene)
        parameters = {}
        for name in material_parameters(scene):
            if name in self.pooled:
                parameters[name] = draw_pooled(name, data, priors, without=unchanging(name))
            else:
                parameters[name] = draw_own(name, data, priors)

        declare_readings(parameters, data, scene, priors, links)
