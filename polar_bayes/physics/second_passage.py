r"""Light that one facet of a rough surface reflects, and that passes into the body at the next.

Light that facet i mirrors into the ray r_i escapes with the probability f_i of a walk in Smith's
model; the rest meets a next facet, and passes there. The ray runs about as flat as v does, so that
the next facet counts as the mean of all facets that v sees, which have the shares w_i. With
B = sin^2 theta, and T, R and K of `polar_bayes.physics.boundary`, the mean facet passes E of
unpolarized light and polarizes it by C:

$$ E = \sum_i w_i T_i, \qquad C = \frac{\sum_i w_i K_i B_i \cos 2\psi_i}{\sum_i w_i B_i}, \qquad
   f = \frac{1 + \Lambda_v}{1 + \Lambda_v + \Lambda_r} \text{ for rays that rise, else } 0 $$

A mirror polarizes the other way round than a boundary that light passes:

$$ E_0 = \sum_i w_i [T_i + (1 - f_i) (E R_i - C K_i B_i^2)], \qquad
   E_1 = -\sum_i w_i [K_i - (1 - f_i) (E K_i - C R_i)] B_i \cos 2\psi_i $$

Source:
    Heitz, Hanika, d'Eon & Dachsbacher 2016, Multiple-scattering microfacet BSDFs with the Smith
    model, ACM Trans. Graph. 35, 58: which rays escape. The mean facet as the next one is an
    approximation of ours, measured by a walk and by a height field (docs/scenes.md).
"""

import dataclasses
from typing import override

import jax.numpy as jnp

from polar_bayes.physics.boundary import Diattenuation
from polar_bayes.physics.facets import Facets, Microsurface
from polar_bayes.physics.geometry import Geometry, cos_degrees, per_facet, sin_degrees
from polar_bayes.physics.microfacet import HeightCorrelatedShadowing
from polar_bayes.physics.part import Part, quotient
from polar_bayes.physics.stack import Stack
from polar_bayes.physics.surface import RoughExit, RoughPassage, SmoothExit


@dataclasses.dataclass(frozen=True)
class TwoFacetPassage(RoughPassage):
    """`RoughPassage`, where light that one facet reflects passes at the next one.

    Where `RoughPassage` lets up to 6% too little into the body, this is within 1.3% of a walk
    (docs/scenes.md). Viewer and light may change places. What passes at the next facet is part of
    what the first bounce hides, so that a white body gives back at most 1.0007 of the light. The
    second bounce of `TwoBounceSurface` reflects part of the same light: there it is up to 1.0083
    (Beckmann slopes, roughness .2 to .8, light to 80 degrees).

    Which rays escape follows a walk in Smith's model whatever `shadowing` the surface has.
    """

    @override
    def simpler(self) -> tuple[Part | None, ...]:
        return (RoughPassage(), RoughExit(), SmoothExit())

    @override
    def passing(
        self, facets: Microsurface, sample: Facets, stack: Stack, geometry: Geometry
    ) -> Diattenuation:
        at_once = super().passing(facets, sample, stack, geometry)
        mirrored = per_facet(stack).reflection(sample.cos_incidence, sample.sin_squared)
        area = jnp.sum(sample.weight, axis=-2)
        mean = quotient(jnp.sum(sample.weight * at_once.mean, axis=-2), area)
        polarized = jnp.sum(sample.weight * at_once.contrast * sample.along_s, axis=-2)
        contrast = quotient(polarized, jnp.sum(sample.weight * sample.sin_squared, axis=-2))
        next_one = Diattenuation(
            per_facet(mean), per_facet(contrast), 0.0 * at_once.mean, sample.sin_squared
        )

        to_viewer = sin_degrees(geometry.view_zenith) / cos_degrees(geometry.view_zenith)
        seen = per_facet(facets.visible(to_viewer, jnp.zeros_like(to_viewer)))
        rises = sample.cos_light > 0.0
        cosine = jnp.maximum(jnp.where(rises, sample.cos_light, 1.0), 1e-6)
        clear = facets.per_facet().visible(
            sample.light_in_plane / cosine, sample.light_out_of_plane / cosine
        )
        free = jnp.where(rises, HeightCorrelatedShadowing().both(seen, clear) / seen, 0.0)
        return at_once.plus(mirrored.times(next_one).scaled(1.0 - free))
