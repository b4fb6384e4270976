r"""Light that meets two facets of a rough surface, one after the other.

The first bounce loses what other facets hide (Smith's shadowing). Here such light meets one more
facet: seen from the viewer, a ray v that facet m mirrors into r is hidden with probability 1 -
G1(r), and then meets facets h as a viewer at -r sees them. With their area sigma towards -r,

$$ (1 - G_1(r)) / \sigma(-r) = G_1(r) / |\cos\theta_r|, $$

whether r goes up or down (Smith's projected areas), so for a point source

$$ S = \frac{G_1(v)}{\cos\theta_v} \sum_m w_m \frac{G_1(r)}{|\cos\theta_r|}
   \frac{D(h) G_1(l)}{4} M_m M_h [1, 0, 0], \qquad h = \frac{l - r}{|l - r|} $$

with the Mueller matrices M of both mirrors between their frames. Each ray is hidden or not, and a
second bounce that is hidden is lost: nothing is made.

Source:
    Heitz, Hanika, d'Eon & Dachsbacher 2016, Multiple-scattering microfacet BSDFs with the Smith
    model, ACM Trans. Graph. 35, 58: the second order, with heights taken as independent.
"""

import dataclasses
from typing import NamedTuple, override

import jax
import jax.numpy as jnp
from jaxtyping import Array

from polar_bayes.errors import SceneError
from polar_bayes.physics.facets import Facets, Microsurface, seen
from polar_bayes.physics.geometry import Geometry, cos_degrees, double_angle, per_facet, sin_degrees
from polar_bayes.physics.illumination import PointSource, UniformSky
from polar_bayes.physics.part import Parameters, Part, at_least, quotient
from polar_bayes.physics.stack import Stack
from polar_bayes.physics.stokes import Light
from polar_bayes.physics.surface import RoughSurface

# Below this cosine or squared length a direction counts as grazing, or two as one.
LEAST = 1e-6

# A facet that is met closer to grazing reflects as at this cosine: it shows next to no area, and
# derivatives of two such mirrors together would leave single precision.
GRAZING = 1e-3


class Vector(NamedTuple):
    """A direction in the frame of the viewer: towards it, across, and along the normal."""

    x: Array
    y: Array
    z: Array

    def dot(self, other: "Vector") -> Array:
        """Scalar product."""
        return self.x * other.x + self.y * other.y + self.z * other.z

    def cross(self, other: "Vector") -> "Vector":
        """Vector product."""
        return Vector(
            self.y * other.z - self.z * other.y,
            self.z * other.x - self.x * other.z,
            self.x * other.y - self.y * other.x,
        )

    def across(self, other: "Vector") -> "Vector":
        """Unit vector across both; any one where both are the same direction."""
        product = self.cross(other)
        return product.times(1.0 / jnp.sqrt(product.dot(product) + LEAST**2))

    def times(self, factor: Array) -> "Vector":
        """A multiple."""
        return Vector(self.x * factor, self.y * factor, self.z * factor)


@dataclasses.dataclass(frozen=True)
class TwoBounceSurface(RoughSurface):
    """A rough surface whose facets light each other once.

    Fields are those of `RoughSurface`. Every facet of the quadrature is paired with the light of a
    point source, or with every other facet under a sky. Only the reflected light has a second
    bounce: light passes into the body and out of it as without.

    Raises:
        SceneError: A part is of the wrong kind, or the light is neither an unpolarized point source
            nor a uniform sky.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.illumination not in (PointSource(), UniformSky()):
            what = f"{self.illumination!r} has no second bounce"
            hint = "give PointSource() or UniformSky(), or use RoughSurface"
            raise SceneError(what, where="TwoBounceSurface: illumination", hint=hint)

    @override
    def simpler(self) -> tuple[Part | None, ...]:
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return (RoughSurface(**fields),)

    @override
    def light(self, parameters: Parameters, geometry: Geometry, stack: Stack) -> Light:
        once = super().light(parameters, geometry, stack)
        twice = self._twice(parameters, geometry, stack)
        # A trace, far below any reading: a body like air reflects nothing, twice or once.
        first = at_least(once.intensity, float(jnp.finfo(once.intensity.dtype).eps) ** 1.75)
        total = first + twice.x
        q, u = first * once.q + twice.y, first * once.u + twice.z
        return Light(once.intensity + twice.x, quotient(q, total), quotient(u, total))

    def _twice(self, parameters: Parameters, geometry: Geometry, stack: Stack) -> Vector:
        """S0, S1 and S2 of the second bounce."""
        facets = self.facets(parameters, geometry)
        first = both_sides(facets.sample(geometry, seen))
        sin_view, cos_view = sin_degrees(geometry.view_zenith), cos_degrees(geometry.view_zenith)
        zero = jnp.zeros_like(sin_view)
        ray = Vector(first.light_in_plane, first.light_out_of_plane, first.cos_light)
        hidden = first.weight * _open(facets.per_facet(), ray)
        share = hidden * _open(facets, Vector(sin_view, zero, cos_view))[..., None, :]

        back = jax.tree.map(jnp.negative, ray)
        view = Vector(*(x[..., None, :] for x in (sin_view, zero, cos_view)))
        axis = view.across(back)
        if isinstance(self.illumination, PointSource):
            arriving = self._from_point(facets.per_facet(), stack, geometry, back, axis)
        else:
            arriving = self._from_sky(parameters, stack, geometry, back, axis)

        # The mirror of the first facet, from its frame to the viewer's.
        cosine = jnp.maximum(first.cos_incidence, GRAZING)
        power = per_facet(stack).reflection(cosine, first.sin_squared)
        contrast = power.contrast * power.sin_squared
        intensity = power.mean * arriving.x + contrast * arriving.y
        q = contrast * arriving.x + power.mean * arriving.y
        cos, sin = double_angle(axis.y, view.z * -axis.x + view.x * axis.z)
        u = -power.cross * arriving.z
        stokes = (intensity, q * cos - u * sin, q * sin + u * cos)
        return Vector(*(jnp.sum(share * each, axis=-2) for each in stokes))

    def _from_point(
        self, facets: Microsurface, stack: Stack, geometry: Geometry, back: Vector, axis: Vector
    ) -> Vector:
        """Stokes vector that arrives at each first facet, in its frame, over the share hidden."""
        turn = (geometry.light_azimuth - geometry.view_azimuth)[..., None, :]
        sin, cos = (f(geometry.light_zenith)[..., None, :] for f in (sin_degrees, cos_degrees))
        light = Vector(sin * cos_degrees(turn), sin * sin_degrees(turn), cos)
        middle = jax.tree.map(jnp.add, back, light)
        length = jnp.sqrt(jnp.maximum(middle.dot(middle), LEAST))
        normal = middle.times(1.0 / length)
        upright = jnp.maximum(normal.z, LEAST)
        density = facets.density_of(normal.x / upright, normal.y / upright)
        density = jnp.where(normal.z > LEAST, density, 0.0)
        lit = 0.25 * density * _open(facets, light) * light.z
        return _mirrored(per_facet(stack), lit, 0.5 * length, back, light, axis)

    def _from_sky(
        self, parameters: Parameters, stack: Stack, geometry: Geometry, back: Vector, axis: Vector
    ) -> Vector:
        """The same from a sky of unit radiance: every facet, as the plane's own area shows it."""
        above = geometry._replace(view_zenith=jnp.zeros_like(geometry.view_zenith))
        facets = self.facets(parameters, above)
        second = both_sides(facets.sample(above, seen))
        # An axis in front of that of the first facets: (..., second, 1, view).
        second = jax.tree.map(lambda values: values[..., :, None, :], second)
        normal = Vector(
            second.light_in_plane, second.light_out_of_plane, 1.0 + second.cos_light
        ).times(0.5 / second.cos_incidence)
        back, axis = (Vector(*(x[..., None, :, :] for x in each)) for each in (back, axis))
        cosine = jnp.maximum(back.dot(normal), 0.0)
        light = Vector(*(2.0 * cosine * m - b for m, b in zip(normal, back, strict=True)))
        free = _open(facets.per_facet().per_facet(), light) * jnp.maximum(light.z, 0.0)
        lit = second.weight * cosine / second.cos_incidence * free
        arriving = _mirrored(per_facet(per_facet(stack)), lit, cosine, back, light, axis)
        return Vector(*(jnp.sum(each, axis=-3) for each in arriving))


def _open(facets: Microsurface, ray: Vector) -> Array:
    """G1 over the cosine of a ray that goes up or down."""
    cosine = jnp.maximum(jnp.abs(ray.z), LEAST)
    return facets.visible(ray.x / cosine, ray.y / cosine) / cosine


def _mirrored(
    stack: Stack, lit: Array, cosine: Array, back: Vector, light: Vector, axis: Vector
) -> Vector:
    """Stokes vector of light that facets mirror, in the frame of another one's axis."""
    cosine = jnp.clip(cosine, GRAZING, 1.0)
    power = stack.reflection(cosine, (1.0 - cosine) * (1.0 + cosine))
    own = back.across(light)
    cos, sin = double_angle(own.dot(axis), own.dot(back.cross(axis)))
    polarized = lit * power.contrast * power.sin_squared
    return Vector(lit * power.mean, polarized * cos, polarized * sin)


def both_sides(sample: Facets) -> Facets:
    """Facets on both sides of the plane of the viewer, where only one was sampled."""
    if sample.across_s is not None:
        return sample

    both = jax.tree.map(lambda values: jnp.concatenate([values, values], axis=-2), sample)
    out_of_plane = sample.light_out_of_plane
    return both._replace(
        weight=0.5 * both.weight,
        light_out_of_plane=jnp.concatenate([out_of_plane, -out_of_plane], axis=-2),
    )
