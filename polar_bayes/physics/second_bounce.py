r"""Light that is reflected by two facets of a rough surface, one after the other.

The first bounce loses what other facets hide (Smith's shadowing). Here such light meets one more
facet. Seen from the viewer, facet m mirrors the ray v into r, and facet h mirrors the ray -r into
the light l. From a point source

$$ S = \frac{1}{\cos\theta_v} \int \frac{D(m)}{4} \frac{D(h)}{4} \frac{G_{vrl}}{|\cos\theta_r|}
   M_m M_h [1, 0, 0]\, dr, \qquad m = \frac{v + r}{|v + r|}, \; h = \frac{l - r}{|l - r|} $$

with the Mueller matrices M of both mirrors between their frames, and the share G of the pairs of
facets that viewer, light and each other see (`AbstractShadowing.twice`). Light may take the same
path backwards. Each ray is hidden or not, and a second bounce that is hidden is lost: nothing is
made.

The integrand peaks where m or h is the mean plane: around the ray of a mirror at v, and of one at
l. Each peak has its own nodes, whose weights share out every ray in proportion to the densities of
both (the balance heuristic); upward and downward rays are integrated apart, since G over the cosine
has a corner at the horizon. A sky is a sum over points.

Source:
    Heitz, Hanika, d'Eon & Dachsbacher 2016, Multiple-scattering microfacet BSDFs with the Smith
    model, ACM Trans. Graph. 35, 58: the second order. Veach & Guibas 1995, Optimally combining
    sampling techniques for Monte Carlo rendering, SIGGRAPH: the balance heuristic.
"""

import dataclasses
from typing import NamedTuple, override

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polar_bayes.errors import SceneError
from polar_bayes.physics.facets import Microsurface
from polar_bayes.physics.geometry import Geometry, cos_degrees, double_angle, per_facet, sin_degrees
from polar_bayes.physics.illumination import PointSource, UniformSky
from polar_bayes.physics.microfacet import (
    SMOOTHEST,
    AbstractShadowing,
    HeightCorrelatedShadowing,
    NoShadowing,
    SlopeEllipse,
)
from polar_bayes.physics.part import Parameters, Part, at_least, like, quotient, unit_rule
from polar_bayes.physics.stack import Stack
from polar_bayes.physics.stokes import Light
from polar_bayes.physics.surface import RoughSurface

# Below this cosine or squared length a direction counts as grazing, or two as one.
LEAST = 1e-6

# Largest width of a lobe of rays in height, radian, and the least in azimuth.
WIDEST, NARROWEST = 1.5, 1e-5

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

    def length(self) -> Array:
        """Length, with a finite slope at zero."""
        return jnp.sqrt(jnp.maximum(self.dot(self), LEAST**2))

    def cross(self, other: "Vector") -> "Vector":
        """Vector product."""
        return Vector(
            self.y * other.z - self.z * other.y,
            self.z * other.x - self.x * other.z,
            self.x * other.y - self.y * other.x,
        )

    def across(self, other: "Vector") -> "Vector":
        """Unit vector perpendicular to both; any unit vector if both are parallel."""
        product = self.cross(other)
        return product.times(1.0 / jnp.sqrt(product.dot(product) + LEAST**2))

    def times(self, factor: Array) -> "Vector":
        """Product with a number."""
        return Vector(self.x * factor, self.y * factor, self.z * factor)


class _Rays(NamedTuple):
    """Directions by height above the horizon and azimuth, radian, and their solid angles."""

    height: Array
    azimuth: Array
    solid_angle: Array

    @property
    def direction(self) -> Vector:
        """Unit vectors of the directions."""
        around = jnp.cos(self.height)
        x, y = around * jnp.cos(self.azimuth), around * jnp.sin(self.azimuth)
        return Vector(x, y, jnp.sin(self.height))


class _Lobe(NamedTuple):
    """Directions around a mirror ray, any shape; y counts from the horizon, unit radian.

    Args:
        end: Largest y.
        center: Of the mirror ray, which may be on the other side of the horizon.
        azimuth: Of the mirror ray.
        width: Of a Cauchy distribution in y.
        across: Roughness that sets the width of a Poisson kernel in azimuth.
    """

    end: Array
    center: Array
    azimuth: Array
    width: Array
    across: Array

    @property
    def angle(self) -> Array:
        """Angle of the Cauchy distribution from the horizon to the end."""
        square = self.width**2 + self.center * (self.center - self.end)
        return jnp.arctan2(self.end * self.width, square)

    def narrowed(self, y: Array) -> Array:
        """Tangent of the half angle in azimuth that contains half the directions at one y."""
        slope = (self.across * (jnp.sin(y) + jnp.sin(self.center))) ** 2
        half_sum, half_difference = 0.5 * (y + self.center), 0.5 * (y - self.center)
        apart = (2.0 * jnp.sin(half_sum) * jnp.sin(half_difference)) ** 2
        wide = slope + (jnp.cos(y) + jnp.cos(self.center)) ** 2
        return jnp.sqrt((slope + apart) / wide + NARROWEST**2)

    def everywhere(self) -> "_Lobe":
        """Return a uniform lobe, for facets of all tilts."""
        flat = jnp.full_like(self.width, WIDEST)
        return self._replace(width=flat, across=1e3 * flat)

    def nodes(self, share: Array, turn: Array) -> tuple[Array, Array]:
        """Return elevations and azimuths at quantiles of the directions."""
        sin, cos = jnp.sin(self.angle * share), jnp.cos(self.angle * share)
        y = (self.width**2 + self.center**2) * sin / (self.width * cos + self.center * sin)
        half = jnp.arctan2(self.narrowed(y) * jnp.sin(0.5 * turn), jnp.cos(0.5 * turn))
        return y, self.azimuth + 2.0 * half

    def density(self, y: Array, azimuth: Array) -> Array:
        """Return the density of directions in y and azimuth."""
        half, narrowed = 0.5 * (azimuth - self.azimuth), self.narrowed(y)
        around = narrowed / ((narrowed * jnp.cos(half)) ** 2 + jnp.sin(half) ** 2)
        return around * self.width / (self.width**2 + (y - self.center) ** 2) / self.angle


@dataclasses.dataclass(frozen=True)
class TwoBounceSurface(RoughSurface):
    """A rough surface whose facets light each other once.

    Fields are those of `RoughSurface`, but shadowing correlates heights by default: two bounces are
    then those of a walk in Smith's model, and make no light (docs/scenes.md). A point source takes
    8 `along` `across` rays between two facets, 240 by default, and a sky 2 `along` `across` points.
    Only the reflected light has a second bounce: light passes into the body and out of it as by
    `RoughSurface`.

    Raises:
        SceneError: A part is of the wrong kind, the light is neither an unpolarized point source
            nor a uniform sky, or no facet hides another.
    """

    shadowing: AbstractShadowing = dataclasses.field(default_factory=HeightCorrelatedShadowing)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.illumination not in (PointSource(), UniformSky()):
            what = f"{self.illumination!r} has no second bounce"
            hint = "give PointSource() or UniformSky(), or use RoughSurface"
            raise SceneError(what, where="TwoBounceSurface: illumination", hint=hint)
        if self.shadowing == NoShadowing():
            what = "where no facet hides another, light meets one facet only"
            hint = "give HeightCorrelatedShadowing() or SeparableShadowing(), or use RoughSurface"
            raise SceneError(what, where="TwoBounceSurface: shadowing", hint=hint)

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
        """Components S0, S1 and S2 of the second bounce."""
        if isinstance(self.illumination, PointSource):
            return self._from_point(parameters, geometry, stack)
        # A sky is many points: (light, ..., view).
        height = jnp.deg2rad(90.0 - jnp.abs(geometry.view_zenith))
        ellipse = self.slopes.ellipse(parameters, geometry)
        end = jnp.full_like(height, 0.5 * jnp.pi)
        lobe = _lobe(ellipse, end, height, _behind(geometry))
        lights = _nodes(self.quadrature.along, self.quadrature.across, (lobe, lobe.everywhere()))
        view_zenith, view_azimuth, light_zenith, light_azimuth = jnp.broadcast_arrays(
            geometry.view_zenith,
            geometry.view_azimuth,
            90.0 - jnp.rad2deg(lights.height),
            geometry.view_azimuth + jnp.rad2deg(lights.azimuth),
        )
        geometry = Geometry(view_zenith, view_azimuth, light_zenith, light_azimuth)
        each = self._from_point(parameters, geometry, stack)
        return Vector(*(jnp.sum(lights.solid_angle * x, axis=0) for x in each))

    def _from_point(self, parameters: Parameters, geometry: Geometry, stack: Stack) -> Vector:
        """Second bounce of a point source of unit irradiance."""
        facets, stack = self.facets(parameters, geometry).per_facet(), per_facet(stack)
        turn = geometry.light_azimuth - geometry.view_azimuth
        view = per_facet(_towards(geometry.view_zenith, jnp.zeros_like(turn)))
        light = per_facet(_towards(geometry.light_zenith, turn))
        rays = self._rays(parameters, geometry)
        ray = rays.direction
        back = jax.tree.map(jnp.negative, ray)
        first, aside = (jax.tree.map(f, view, ray) for f in (jnp.add, jnp.subtract))
        second = jax.tree.map(jnp.add, light, back)
        g_view, g_ray, g_light = (_seen_share(facets, each) for each in (view, ray, light))
        open_share = self.shadowing.twice(g_view, g_ray, g_light, ray.z > 0.0)
        share = _density(facets, first) * _density(facets, second) / 16.0 * open_share
        share = share * rays.solid_angle / jnp.maximum(jnp.abs(ray.z), LEAST) / view.z
        axis = view.across(back)
        arriving = _mirrored(stack, second, back, light, axis)

        # The mirror of the first facet, from its frame to the viewer's.
        cosine = jnp.maximum(0.5 * first.length(), GRAZING)
        power = stack.reflection(cosine, 0.25 * aside.dot(aside))
        contrast = power.contrast * power.sin_squared
        intensity = power.mean * arriving.x + contrast * arriving.y
        q = contrast * arriving.x + power.mean * arriving.y
        cos, sin = double_angle(axis.y, view.z * -axis.x + view.x * axis.z)
        u = -power.cross * arriving.z
        stokes = (intensity, q * cos - u * sin, q * sin + u * cos)
        return Vector(*(jnp.sum(share * each, axis=-2) for each in stokes))

    def _rays(self, parameters: Parameters, geometry: Geometry) -> _Rays:
        """Rays from the first facet to the second, (..., ray, view)."""
        back = geometry.reversed()
        height, of_light = (
            jnp.deg2rad(90.0 - jnp.abs(each.view_zenith)) for each in (geometry, back)
        )
        # Above the horizon until the second facet would hang over, below until the first would.
        end = _sides(of_light, height)
        turn = jnp.deg2rad(geometry.light_azimuth - geometry.view_azimuth)
        of_view, of_back = (self.slopes.ellipse(parameters, each) for each in (geometry, back))
        lobes = (
            _lobe(of_view, end, _sides(height, -height), _behind(geometry)),
            _lobe(of_back, end, _sides(-of_light, of_light), turn - jnp.pi + _behind(back)),
        )
        rays = _nodes(self.quadrature.along, 2 * self.quadrature.across, lobes)
        rays = rays._replace(height=jnp.stack([rays.height[:, 0], -rays.height[:, 1]], axis=1))
        # Both sides on the axis of rays, which goes in front of the views.
        return jax.tree.map(lambda x: jnp.moveaxis(x.reshape(-1, *x.shape[2:]), 0, -2), rays)


def _towards(zenith: Array, azimuth: Array) -> Vector:
    """Directions in the frame of the viewer, from angles in degrees."""
    sin, cos = sin_degrees(zenith), cos_degrees(zenith)
    return Vector(sin * cos_degrees(azimuth), sin * sin_degrees(azimuth), cos)


def _behind(geometry: Geometry) -> Array:
    """Azimuth of the mirror ray from that of the viewer, radian."""
    return jnp.where(geometry.view_zenith < 0.0, 0.0, jnp.pi)


def _seen_share(facets: Microsurface, ray: Vector) -> Array:
    """G1 of a ray, upwards or downwards."""
    cosine = jnp.maximum(jnp.abs(ray.z), LEAST)
    return facets.visible(ray.x / cosine, ray.y / cosine)


def _density(facets: Microsurface, normal: Vector) -> Array:
    """Facet area per steradian around a vector of any length; zero for overhanging facets."""
    upright = jnp.maximum(normal.z, LEAST)
    density = facets.density_of(normal.x / upright, normal.y / upright)
    return jnp.where(normal.z > LEAST, density, 0.0)


def _mirrored(stack: Stack, facet: Vector, back: Vector, light: Vector, axis: Vector) -> Vector:
    """Stokes vector of light that facets mirror, in the frame of another facet's axis."""
    cosine = jnp.clip(0.5 * facet.length(), GRAZING, 1.0)
    power = stack.reflection(cosine, (1.0 - cosine) * (1.0 + cosine))
    own = back.across(light)
    cos, sin = double_angle(own.dot(axis), own.dot(back.cross(axis)))
    polarized = power.contrast * power.sin_squared
    return Vector(power.mean, polarized * cos, polarized * sin)


# --- Where rays and lights are sampled: around the mirror ray of a level facet --------------------


def _lobe(ellipse: SlopeEllipse, end: Array, center: Array, azimuth: Array) -> _Lobe:
    """Directions into which facets of these slopes mirror one ray."""
    along = ellipse.along
    if ellipse.shear is not None:
        along = jnp.sqrt(along**2 + ellipse.shear**2)
    width = jnp.clip(2.0 * along, 2.0 * SMOOTHEST, WIDEST)
    across = at_least(ellipse.across, SMOOTHEST)
    return _Lobe(*jnp.broadcast_arrays(end, center, azimuth, width, across))


def _sides(up: Array, down: Array) -> Array:
    """Stack values for directions above and below the horizon on a new leading axis."""
    return jnp.stack(jnp.broadcast_arrays(up, down))


def _nodes(along: int, around: int, lobes: tuple[_Lobe, _Lobe]) -> _Rays:
    """Directions on a new leading axis; heights are measured from the horizon."""
    node, weight = unit_rule(along)
    turn = 2.0 * np.pi * (np.arange(around) + 0.5) / around
    grid = (*np.meshgrid(node, turn, indexing="ij"), np.repeat(weight, turn.size) / turn.size)
    end = lobes[0].end
    share, turns, weights = (like(x, end).reshape(-1, *(end.ndim * (1,))) for x in grid)
    each = (lobe.nodes(share, turns) for lobe in lobes)
    y, azimuth = (jnp.concatenate(both) for both in zip(*each, strict=True))
    # The densities of both add up, and so a node of one counts less near those of the other.
    density = lobes[0].density(y, azimuth) + lobes[1].density(y, azimuth)
    measure = 2.0 * jnp.pi * jnp.concatenate([weights, weights]) / density
    # Derivatives are those of the integrand at nodes that keep their place between the borders:
    # where the nodes are does not change the integral. The barrier keeps them from being found anew
    # for each of their readers.
    fixed = jax.lax.stop_gradient((y / end, azimuth, measure / end))
    share, azimuth, measure = jax.lax.optimization_barrier(fixed)
    return _Rays(end * share, azimuth, end * measure * jnp.cos(end * share))
