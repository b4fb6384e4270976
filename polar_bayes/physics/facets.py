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

Grooves have their own frame (`Axes`): there it runs over both signs of the gentle slopes, and for
each over the steep ones from border to border. In the frame of the viewer a border would cut
through the narrow ridge of slopes between two nodes.
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
from polar_bayes.physics.microfacet import AbstractMicrofacet, AbstractShadowing, Axes, SlopeEllipse
from polar_bayes.physics.part import Part, quotient, unit_rule
from polar_bayes.physics.stokes import Light

# Facets steeper than this are not met by any distribution in use.
STEEPEST = 1e6

# How much denser the nodes stand at the borders, 0 (not) to 1: by trial, flat around the best.
CROWDING_ALONG, CROWDING_ACROSS = 0.4, 0.85


@dataclasses.dataclass(frozen=True)
class FacetQuadrature(Part):
    """Number of facets in the quadrature, which trades accuracy for time.

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

    Grooves are sampled in their own frame: for each of `across` gentle slopes of either sign,
    `along + across` steep ones, 110 facets by default. That is within .001 for Beckmann and within
    .003 for GGX up to a slope ratio of 20 seen from any side (docs/facets.md); at roughness 1 seen
    at 85 degrees along the gentle slopes the way out of GGX is off by .009.

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
                what = f"{name}={nodes!r} is no number of nodes"
                hint = "give a whole number from 1 to 64"
                raise SceneError(what, where="FacetQuadrature", hint=hint)

    @override
    def simpler(self) -> tuple[Part | None, ...]:
        fewer = (FacetQuadrature(), FacetQuadrature(along=5, across=4))
        nodes = self.along * self.across
        return tuple(rule for rule in fewer if rule.along * rule.across < nodes)

    def rule_along(self) -> tuple[np.ndarray, np.ndarray]:
        """Nodes and weights on (0, 1), denser at both ends."""
        node, weight = _crowded_gauss_legendre(self.along, CROWDING_ALONG)
        return 0.5 * (1.0 + node), 0.5 * weight

    def rule_across(self) -> tuple[np.ndarray, np.ndarray]:
        """Nodes and weights on (0, 1), denser at the limit, where chords vanish.

        Slopes of both signs are alike: half of a rule over both is exact to twice the order.
        """
        node, weight = _crowded_gauss_legendre(2 * self.across, CROWDING_ACROSS)
        return node[self.across :], weight[self.across :]

    def rule_gentle(self) -> tuple[np.ndarray, np.ndarray]:
        """Nodes and weights on (0, 1) for one sign of gentle slopes of grooves."""
        return unit_rule(self.across)

    def rule_steep(self) -> tuple[np.ndarray, np.ndarray]:
        """Nodes and weights on (0, 1) for the steep slopes, denser at both ends."""
        return FacetQuadrature(min(self.along + self.across, 64), 1).rule_along()


class Window(NamedTuple):
    """Boundary of the facets that contribute, in slope coordinates."""

    limit: Array
    """Largest slope across the plane of the viewer, (..., view), or () if equal for all views."""
    edges: Callable[[Array], tuple[Array, Array]]
    """Function from a slope across to the smallest and largest slope in the plane."""
    turned: "Callable[[Axes], TurnedWindow]"
    """Function that returns the same boundary in the frame of grooves."""


class TurnedWindow(NamedTuple):
    """The boundary in the gentle slopes s along grooves and the steep slopes t across."""

    behind: Array
    """Minus the smallest s, (..., view)."""
    ahead: Array
    """The largest s, (..., view)."""
    edges: Callable[[Array], tuple[Array, Array]]
    """Function from s to the smallest and largest t."""


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
    """Boundary of all facets that face the viewer."""

    def edges(across: Array) -> tuple[Array, Array]:
        del across
        lower = -cos_view / jnp.maximum(sin_view, cos_view / STEEPEST)
        upper = cos_view / jnp.maximum(-sin_view, cos_view / STEEPEST)
        return lower, upper

    def turned(axes: Axes) -> TurnedWindow:
        # cos + sin x > 0 where x = s cos(turn) - t sin(turn)
        forwards, sideways = sin_view * axes.cos, sin_view * axes.sin
        least, far = cos_view / STEEPEST, jnp.full_like(cos_view * axes.cos, STEEPEST)
        near = cos_view / jnp.maximum(jnp.abs(forwards), least)
        straight = jnp.abs(sideways) <= least
        open_end = jnp.where(straight, near, far)

        def edges(gentle: Array) -> tuple[Array, Array]:
            end = (cos_view + forwards * gentle) / jnp.maximum(jnp.abs(sideways), least)
            end = jnp.clip(end, -STEEPEST, STEEPEST)
            leftwards = sideways < 0.0
            return jnp.where(leftwards, -end, -STEEPEST), jnp.where(leftwards, STEEPEST, end)

        return TurnedWindow(
            jnp.where(forwards >= 0.0, open_end, far),
            jnp.where(forwards >= 0.0, far, open_end),
            edges,
        )

    return Window(jnp.asarray(STEEPEST, cos_view.dtype), edges, turned)


def above_horizon(sin_view: Array, cos_view: Array) -> Window:
    """Boundary of facets that mirror the viewer's ray into the sky: a circle of slopes."""

    def edges(across: Array) -> tuple[Array, Array]:
        forwards = sin_view >= 0.0
        center = jnp.where(forwards, sin_view, -sin_view) / cos_view
        chord = jnp.sqrt(jnp.maximum(1.0 / cos_view**2 - across**2, 1e-12))
        far = center + chord
        # The product of the two edges is across^2 - 1: the near one is found without cancellation.
        near = (across**2 - 1.0) / far
        return jnp.where(forwards, near, -far), jnp.where(forwards, far, -near)

    def turned(axes: Axes) -> TurnedWindow:
        tangent, radius = sin_view / cos_view, 1.0 / cos_view
        s, t = tangent * axes.cos, -tangent * axes.sin
        far = radius + jnp.abs(s)
        near = (1.0 + t**2) / far

        def edges(gentle: Array) -> tuple[Array, Array]:
            chord = jnp.sqrt(jnp.maximum(radius**2 - (gentle - s) ** 2, 1e-12))
            upwards = t >= 0.0
            far = jnp.where(upwards, t, -t) + chord
            near = (gentle * (gentle - 2.0 * s) - 1.0) / far
            return jnp.where(upwards, near, -far), jnp.where(upwards, far, -near)

        return TurnedWindow(jnp.where(s >= 0.0, near, far), jnp.where(s >= 0.0, far, near), edges)

    return Window(1.0 / cos_view, edges, turned)


def inside_disc(sin_view: Array, cos_view: Array, sin_half: float) -> Window:
    """Boundary of facets that mirror the viewer's ray into a disc around the mirror direction."""
    sky = above_horizon(sin_view, cos_view)
    spare = (cos_view - sin_half) * (cos_view + sin_half)
    limit = sin_half / jnp.sqrt(jnp.maximum(spare, (sin_half * cos_view) ** 2))

    def edges(across: Array) -> tuple[Array, Array]:
        square = jnp.maximum(sin_half**2 - across**2 * spare, 1e-6 * sin_half**2)
        half = jnp.sqrt(square / ((1.0 - sin_half) * (1.0 + sin_half)))
        lower, upper = sky.edges(across)
        lower = jnp.maximum(lower, -half)
        return lower, jnp.maximum(jnp.minimum(upper, half), lower)

    def turned(axes: Axes) -> TurnedWindow:
        above, rest = sky.turned(axes), (1.0 - sin_half) * (1.0 + sin_half)
        square = jnp.maximum(rest * axes.sin**2 + spare * axes.cos**2, 1e-6)
        shift = (rest - spare) * axes.sin * axes.cos / square
        product = rest * jnp.maximum(spare, (sin_half * cos_view) ** 2)
        end = sin_half * jnp.sqrt(square / product)

        def edges(gentle: Array) -> tuple[Array, Array]:
            chord = sin_half**2 * square - gentle**2 * rest * spare
            half = jnp.sqrt(jnp.maximum(chord, 1e-6 * sin_half**2 * square)) / square
            lower, upper = above.edges(gentle)
            lower = jnp.maximum(lower, shift * gentle - half)
            return lower, jnp.maximum(jnp.minimum(upper, shift * gentle + half), lower)

        return TurnedWindow(jnp.minimum(above.behind, end), jnp.minimum(above.ahead, end), edges)

    return Window(jnp.minimum(limit, sky.limit), edges, turned)


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
    ellipse: SlopeEllipse

    def per_facet(self) -> "Microsurface":
        """Add an axis for facets in front of the views."""
        return dataclasses.replace(self, ellipse=per_facet(self.ellipse))

    def density(self, geometry: Geometry, tan_squared: Array) -> Array:
        """Facet area per steradian around the facet that mirrors the light to the viewer."""
        ellipse = self.ellipse
        if ellipse.shear is None:
            return self.distribution.density(tan_squared, ellipse.across)
        return self.density_of(*mirror_slopes(geometry))

    def density_of(self, x: Array, y: Array) -> Array:
        """Facet area per steradian around slopes towards the viewer and across."""
        ellipse = self.ellipse
        if ellipse.shear is None:
            return self.distribution.density(x**2 + y**2, ellipse.across)
        # The slopes of an isotropic surface with the same peak that are met as often as these.
        w = y / ellipse.across
        u = (x - ellipse.shear * w) / ellipse.along
        peak = ellipse.across * ellipse.along
        alike = peak * (u**2 + w**2)
        stretch = (1.0 + x**2 + y**2) / (1.0 + alike)
        return self.distribution.density(alike, jnp.sqrt(peak)) * stretch**2

    def visible(self, x: Array, y: Array) -> Array:
        """Share of facets that see one direction, G1."""
        ellipse = self.ellipse
        if ellipse.shear is None:
            return self.distribution.shadowing(x**2 + y**2, ellipse.across)
        peak = ellipse.across * ellipse.along
        steepness = (ellipse.along * x) ** 2 + (ellipse.shear * x + ellipse.across * y) ** 2
        return self.distribution.shadowing(steepness / peak, jnp.sqrt(peak))

    def sample(self, geometry: Geometry, border: Border) -> Facets:
        r"""Facets inside a border, weighted by the area that they show to the viewer.

        $$ \sum_i w_i f_i \approx \int f \, \frac{v\cdot m}{\cos m} D \cos m \, dm, \qquad
           \frac{v\cdot m}{\cos m} = c_v + s_v x $$
        """
        sin_view, cos_view = sin_degrees(geometry.view_zenith), cos_degrees(geometry.view_zenith)
        ellipse, rule = self.ellipse, self.quadrature
        dtype = jnp.result_type(float, ellipse.across, cos_view)
        if ellipse.axes is None:
            across, along = rule.rule_across(), rule.rule_along()
        else:
            node, weight = rule.rule_gentle()
            across, along = (np.tile(node, 2), np.tile(weight, 2)), rule.rule_steep()
        # Axes (..., across, along, view): what one of the two does not touch is found once for all
        # of it, and the views, the longest axis, are the innermost loop.
        share_across, weight_across = (jnp.asarray(row[:, None, None], dtype) for row in across)
        share_along, weight_along = (jnp.asarray(row[:, None], dtype) for row in along)
        sin_view, cos_view = sin_view[..., None, None, :], cos_view[..., None, None, :]
        ellipse = per_facet(per_facet(ellipse))

        window = border(sin_view, cos_view)
        if ellipse.axes is None:
            y, density_y = self.distribution.across(window.limit, ellipse.across, share_across)
            lower, upper = window.edges(y)
            line = lower, upper, y, ellipse.across
            x, density_x = self.distribution.along(*line, share_along)
        else:
            # Both signs of the gentle slopes, and for each the steep ones, stretched to be alike.
            axes, turned = ellipse.axes, window.turned(ellipse.axes)
            ahead = np.repeat([True, False], rule.across)[:, None, None]
            limit = jnp.where(ahead, turned.ahead, turned.behind)
            s, density_y = self.distribution.across(limit, axes.gentle, share_across)
            density_y, s = 0.5 * density_y, jnp.where(ahead, s, -s)
            lower, upper = turned.edges(s)
            stretch = axes.gentle / axes.steep
            line = lower * stretch, upper * stretch, s, axes.gentle
            t, density_x = self.distribution.along(*line, share_along)
            t = t / stretch
            x, y = axes.cos * s - axes.sin * t, axes.sin * s + axes.cos * t
        whole = self.distribution.along_whole(*line)
        if whole is not None:
            total = jnp.sum(weight_along * density_x, axis=-2, keepdims=True)
            density_x = density_x * quotient(whole, jnp.maximum(total, jnp.finfo(dtype).tiny))
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
    """Sum the light of all facets."""
    total = jnp.sum(weight * power.mean, axis=-2)
    if least is not None:
        total = jnp.maximum(total, least)
    polarized = weight * power.contrast
    q = quotient(jnp.sum(polarized * sample.along_s, axis=-2), total)
    if sample.across_s is None:
        return Light(total, q, jnp.zeros_like(q))
    return Light(total, q, -quotient(jnp.sum(polarized * sample.across_s, axis=-2), total))
