"""Microfacet surfaces: quadrature over the facets that a viewer sees, and their light.

A point source requires the one facet that mirrors it (`Microsurface.density`); an extended source
and the exit from the body require a sample of the visible facets (`Microsurface.sample`).

In slope coordinates (x towards the viewer, y across) all borders are simple curves:

    facet seen                    x > -cot(theta_v)                              a straight line
    reflected ray above horizon   (x - tan theta_v)^2 + y^2 < sec^2 theta_v      a circle
    reflected ray inside a disc of half width w around the mirror direction, s = sin(w/2)
                                  (1 - s^2) x^2 + (cos^2 theta_v - s^2) y^2 < s^2   a conic

So the average runs over y from 0 to its limit (both signs are alike), and for each y over x from
border to border: the horizon, which costs a plain rule most of its accuracy, is met exactly.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple, override

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polar_bayes.errors import SceneError
from polar_bayes.physics.boundary import Diattenuation
from polar_bayes.physics.geometry import (
    Geometry,
    cos_degrees,
    mirror_slopes,
    per_facet,
    sin_degrees,
)
from polar_bayes.physics.microfacet import AbstractMicrofacet, AbstractShadowing, SlopeEllipse
from polar_bayes.physics.part import Part, quotient
from polar_bayes.physics.stokes import Light

# Facets steeper than this are not met by any distribution in use.
STEEPEST = 1e6

# How much denser the nodes stand at the borders, 0 (not) to 1: by trial, flat around the best.
CROWDING_ALONG, CROWDING_ACROSS = 0.4, 0.85


@dataclasses.dataclass(frozen=True)
class FacetQuadrature(Part):
    """How many facets stand for all: one dial of what accuracy costs in time.

    Largest error of the degree of polarization for roughness .01 to .3, index 1.2 to 2, and zenith
    angles up to 89 degrees, against 64 x 64 facets (benchmarks/facet_quadrature.py):

        along x across        4x4     5x4     5x5     6x5     8x6    10x8   16x16
        Beckmann, sky       .0034   .0004   .0004   .0002  .00007  .00003  .00001
        Beckmann, exit      .0008  .00005  .00004  .00002  .00001       -       -
        Beckmann, Disc(15)  .0004  .00007  .00007  .00005  .00002  .00001       -
        GGX, sky            .0100   .0009   .0010   .0008   .0003   .0001  .00002
        GGX, exit           .0028   .0012   .0007   .0004   .0001  .00001       -
        GGX, Disc(15)       .0015   .0014   .0005   .0004   .0001  .00008  .00001

    Narrower discs have smaller errors. From roughness .003 to .8 the default stays within .001, or
    .002 for GGX and discs that the horizon cuts. It may be off by .003 at 1; at 1.5 by .008, or by
    .04 for such discs.

    Args:
        along: Number of slopes in the plane of the viewer, 1 to 64.
        across: Number of slopes across it, 1 to 64.

    Raises:
        SceneError: A number of nodes is not in 1 to 64.
    """

    along: int = 6
    across: int = 5

    def __post_init__(self) -> None:
        for name in ("along", "across"):
            nodes = getattr(self, name)
            if not (isinstance(nodes, int) and 1 <= nodes <= 64):
                raise SceneError(
                    f"{name}={nodes!r} is no number of nodes",
                    where="FacetQuadrature",
                    hint="give a whole number from 1 to 64",
                )

    @override
    def simpler(self) -> tuple[Part | None, ...]:
        fewer = (FacetQuadrature(), FacetQuadrature(along=5, across=4))
        nodes = self.along * self.across
        return tuple(rule for rule in fewer if rule.along * rule.across < nodes)

    def rule_along(self) -> tuple[np.ndarray, np.ndarray]:
        """Nodes and weights on (0, 1), denser at both borders."""
        node, weight = _crowded_gauss_legendre(self.along, CROWDING_ALONG)
        return 0.5 * (1.0 + node), 0.5 * weight

    def rule_across(self) -> tuple[np.ndarray, np.ndarray]:
        """Nodes and weights on (0, 1), denser at the limit, where chords shrink to nothing.

        Slopes of both signs are alike: half of a rule over both is exact to twice the order.
        """
        node, weight = _crowded_gauss_legendre(2 * self.across, CROWDING_ACROSS)
        return node[self.across :], weight[self.across :]


class Window(NamedTuple):
    """Border of the facets that matter, in slope coordinates."""

    limit: Array
    """Largest slope across the plane of the viewer, (..., view), or () for all alike."""
    edges: Callable[[Array], tuple[Array, Array]]
    """From that slope to the smallest and largest slope in the plane."""


class Facets(NamedTuple):
    """Sampled facets on an axis before the views: shape (..., facet, view).

    Args:
        weight: Share of the facet in the seen area, times cos(theta_v) / G1(v).
        cos_incidence: Cosine between facet and viewer.
        sin_squared: Its squared sine.
        along_s: Squared sine times cos(2 psi), psi turning the facet's s axis to the viewer's.
        across_s: Squared sine times sin(2 psi); None where both sides of the plane are alike and
            only one was sampled, so that it sums to zero.
        cos_light: Cosine of the zenith of the mirrored ray.
        light_in_plane: Sine of that zenith, projected onto the plane of the viewer.
        light_out_of_plane: The same across it.
    """

    weight: Array
    cos_incidence: Array
    sin_squared: Array
    along_s: Array
    across_s: Array | None
    cos_light: Array
    light_in_plane: Array
    light_out_of_plane: Array


def seen(sin_view: Array, cos_view: Array) -> Window:
    """Border of all facets that face the viewer."""

    def edges(across: Array) -> tuple[Array, Array]:
        del across
        lower = -cos_view / jnp.maximum(sin_view, cos_view / STEEPEST)
        upper = cos_view / jnp.maximum(-sin_view, cos_view / STEEPEST)
        return lower, upper

    return Window(jnp.asarray(STEEPEST, cos_view.dtype), edges)


def above_horizon(sin_view: Array, cos_view: Array) -> Window:
    """Border of the facets that mirror the viewer's ray into the sky: a circle of slopes."""

    def edges(across: Array) -> tuple[Array, Array]:
        forwards = sin_view >= 0.0
        center = jnp.where(forwards, sin_view, -sin_view) / cos_view
        chord = jnp.sqrt(jnp.maximum(1.0 / cos_view**2 - across**2, 1e-12))
        far = center + chord
        # The product of the two edges is across^2 - 1: the near one is found without cancellation.
        near = (across**2 - 1.0) / far
        return jnp.where(forwards, near, -far), jnp.where(forwards, far, -near)

    return Window(1.0 / cos_view, edges)


def inside_disc(sin_view: Array, cos_view: Array, sin_half: float) -> Window:
    """Border of the facets that mirror the viewer's ray into a disc around the mirror direction."""
    sky = above_horizon(sin_view, cos_view)
    spare = (cos_view - sin_half) * (cos_view + sin_half)
    limit = sin_half / jnp.sqrt(jnp.maximum(spare, (sin_half * cos_view) ** 2))

    def edges(across: Array) -> tuple[Array, Array]:
        square = jnp.maximum(sin_half**2 - across**2 * spare, 1e-6 * sin_half**2)
        half = jnp.sqrt(square / ((1.0 - sin_half) * (1.0 + sin_half)))
        lower, upper = sky.edges(across)
        lower = jnp.maximum(lower, -half)
        return lower, jnp.maximum(jnp.minimum(upper, half), lower)

    return Window(jnp.minimum(limit, sky.limit), edges)


def _crowded_gauss_legendre(nodes: int, crowding: float) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Legendre nodes and weights on (-1, 1), moved outwards by an odd cubic."""
    node, weight = np.polynomial.legendre.leggauss(nodes)
    moved = node * (1.0 + 0.5 * crowding * (1.0 - node**2))
    return moved, weight * (1.0 + 0.5 * crowding * (1.0 - 3.0 * node**2))


Border = Callable[[Array, Array], Window]


@dataclasses.dataclass(frozen=True)
class Microsurface:
    """The surface as a population of facets."""

    distribution: AbstractMicrofacet
    shadowing: AbstractShadowing
    quadrature: FacetQuadrature

    def density(self, ellipse: SlopeEllipse, geometry: Geometry, tan_squared: Array) -> Array:
        """Facet area per steradian around the facet that mirrors the light to the viewer."""
        if ellipse.shear is None:
            return self.distribution.density(tan_squared, ellipse.across)
        # The slopes of an isotropic surface with the same peak that are met as often as these.
        in_plane, out_of_plane = mirror_slopes(geometry)
        w = out_of_plane / ellipse.across
        u = (in_plane - ellipse.shear * w) / ellipse.along
        peak = ellipse.across * ellipse.along
        alike = peak * (u**2 + w**2)
        stretch = (1.0 + tan_squared) / (1.0 + alike)
        return self.distribution.density(alike, jnp.sqrt(peak)) * stretch**2

    def visible(self, ellipse: SlopeEllipse, x: Array, y: Array) -> Array:
        """G1, the share of facets that see one direction."""
        if ellipse.shear is None:
            return self.distribution.shadowing(x**2 + y**2, ellipse.across)
        peak = ellipse.across * ellipse.along
        steepness = (ellipse.along * x) ** 2 + (ellipse.shear * x + ellipse.across * y) ** 2
        return self.distribution.shadowing(steepness / peak, jnp.sqrt(peak))

    def sample(self, ellipse: SlopeEllipse, geometry: Geometry, border: Border) -> Facets:
        r"""Facets inside a border, weighted by the area that they show to the viewer.

        $$ \sum_i w_i f_i \approx \int f \, \frac{v\cdot m}{\cos m} D \cos m \, dm, \qquad
           \frac{v\cdot m}{\cos m} = c_v + s_v x $$
        """
        sin_view, cos_view = sin_degrees(geometry.view_zenith), cos_degrees(geometry.view_zenith)
        dtype = jnp.result_type(float, ellipse.across, cos_view)
        # Axes (..., across, along, view): what one of the two does not touch is found once for all
        # of it, and the views, the longest axis, are the innermost loop.
        sides = 1 if ellipse.shear is None else 2
        rule = self.quadrature
        share_across, weight_across = (
            jnp.asarray(np.tile(row, sides)[:, None, None], dtype) for row in rule.rule_across()
        )
        share_along, weight_along = (jnp.asarray(row[:, None], dtype) for row in rule.rule_along())
        sin_view, cos_view = sin_view[..., None, None, :], cos_view[..., None, None, :]
        ellipse = per_facet(per_facet(ellipse))

        window = border(sin_view, cos_view)
        y, density_y = self.distribution.across(window.limit, ellipse.across, share_across)
        lower, upper = window.edges(y)
        if ellipse.shear is None:
            x, density_x = self.distribution.along(lower, upper, y, ellipse.across, share_along)
        else:
            # Both sides of the plane, in slopes stretched and sheared to an isotropic pair.
            side = jnp.asarray(np.repeat([1.0, -1.0], rule.across)[:, None, None], dtype)
            density_y, y = 0.5 * density_y, side * y
            stretch = ellipse.across / ellipse.along
            shift = ellipse.shear / ellipse.across * y
            x, density_x = self.distribution.along(
                (lower - shift) * stretch, (upper - shift) * stretch, y, ellipse.across, share_along
            )
            x = x / stretch + shift
        # Without a barrier XLA's CPU compiler fuses the slopes into each of their many readers and
        # finds them anew for each: derivatives then take several times as long.
        x, y, density_x, density_y = jax.lax.optimization_barrier((x, y, density_x, density_y))

        shown = jnp.maximum(cos_view + sin_view * x, 0.0)
        cos_tilt = 1.0 / jnp.sqrt(1.0 + x**2 + y**2)
        cos_incidence = jnp.maximum(cos_tilt * shown, 1e-6)
        in_plane = cos_tilt * (sin_view - x * cos_view)
        out_of_plane = cos_tilt * y
        facets = Facets(
            weight=weight_across * density_y * weight_along * density_x * shown,
            cos_incidence=cos_incidence,
            sin_squared=in_plane**2 + out_of_plane**2,
            along_s=in_plane**2 - out_of_plane**2,
            across_s=None if ellipse.shear is None else 2.0 * in_plane * out_of_plane,
            cos_light=2.0 * cos_incidence * cos_tilt - cos_view,
            light_in_plane=2.0 * cos_incidence * cos_tilt * x - sin_view,
            light_out_of_plane=2.0 * cos_incidence * cos_tilt * y,
        )
        shape = jnp.broadcast_shapes(*(jnp.shape(field) for field in (x, y, cos_view, share_along)))
        return jax.tree.map(
            lambda field: jnp.broadcast_to(field, shape).reshape(*shape[:-3], -1, shape[-1]), facets
        )


def sum_facets(
    sample: Facets, weight: Array, power: Diattenuation, *, least: float | None = None
) -> Light:
    """Light of all facets together."""
    total = jnp.sum(weight * power.mean, axis=-2)
    if least is not None:
        total = jnp.maximum(total, least)
    polarized = weight * power.contrast
    q = quotient(jnp.sum(polarized * sample.along_s, axis=-2), total)
    if sample.across_s is None:
        return Light(total, q, jnp.zeros_like(q))
    return Light(total, q, -quotient(jnp.sum(polarized * sample.across_s, axis=-2), total))
