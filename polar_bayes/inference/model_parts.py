"""A model with all that it reads but its data: what programs are compiled from, and their key."""

import dataclasses
from collections.abc import Callable, Mapping

import jax
from numpyro import distributions as dist

from polar_bayes.numerics.fingerprint import fingerprint, uses_own_code
from polar_bayes.observation.data import Observations
from polar_bayes.observation.links import AbstractLink
from polar_bayes.physics.scene import Scene
from polar_bayes.priors import NormalCoordinate, cast_prior


@dataclasses.dataclass(frozen=True)
class ModelParts:
    """A model, and the scene, priors and links that it is called with."""

    model: Callable
    scene: Scene
    priors: Mapping[str, dist.Distribution]
    links: Mapping[str, AbstractLink]

    def bind(self) -> Callable[[Observations], None]:
        """The model with everything but its data in place, in the precision that is switched on."""
        own = {name: cast_prior(prior) for name, prior in self.priors.items()}
        return ModelParts(self.model, self.scene, own, self.links)._run

    def _run(self, data: Observations) -> None:
        """The model, with priors from other pixels in the place of those that they replace."""
        shared = {
            name: NormalCoordinate(mean, sd, self.priors[name].support)
            for name, (mean, sd) in data.shared.items()
        }
        self.model(data, scene=self.scene, priors={**self.priors, **shared}, links=self.links)

    def key(self, *further: object) -> str:
        """A text that is equal for parts whose compiled programs are the same."""
        stated = {name: _stated(prior) for name, prior in self.priors.items()}
        model, scene, links, *_ = code = self._code
        return fingerprint(model, scene, stated, links, *further, code=code)

    @property
    def _code(self) -> tuple[object, ...]:
        """Return what may be the user's own; the scene is without its ledger."""
        scene = dataclasses.replace(self.scene)
        return self.model, scene, self.links, *map(type, self.priors.values())

    @property
    def has_own_code(self) -> bool:
        """Whether a function or class of the user's own is among the parts."""
        return uses_own_code(*self._code)

    @property
    def is_padded(self) -> bool:
        """Whether captures with other numbers of views may share the programs of the model."""
        # Code of the user's own need not mask what is not valid, so it is given no padding.
        return not uses_own_code(self.model, self.scene, self.links)


def _stated(value: object) -> object:
    """A prior as its own arguments, in one order; not what it has computed and stored since."""
    if not isinstance(value, dist.Distribution):
        return jax.tree.leaves(value), str(jax.tree.structure(value))
    names = sorted({*value.gather_pytree_data_fields(), *value.gather_pytree_aux_fields()})
    return type(value), [(name, _stated(vars(value).get(name))) for name in names]


def layout_of(data: Observations) -> tuple[str, ...]:
    """What programs depend on in a capture: variables, axes, lengths and types, not readings."""
    return (str(jax.tree.structure(data)), *(f"{x.dtype}{x.shape}" for x in jax.tree.leaves(data)))
