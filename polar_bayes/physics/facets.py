r"""Averages over the facets that a viewer sees: where to look, and how much each look counts.

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
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polar_bayes.errors import SceneError
from polar_bayes.physics.microfacet import AbstractMicrofacet

# Facets steeper than this are not met by any distribution in use.
STEEPEST = 1e6

# How much denser the nodes stand at the borders: found by trial, flat around the best values.
EDGES, CROWDING = 0.4, 1.75


@dataclasses.dataclass(frozen=True)
class FacetQuadrature:
    """How many facets stand for all: one dial of what accuracy costs in time.

    Largest error of the degree of polarization for roughness .01 to .3, index 1.2 to 2, and zenith
    angles up to 89 degrees, against 64 x 64 facets:

        along x across     4x4    5x4    6x5    8x6   10x8   16x16
        Beckmann, sky     .012  .0018  .0002 .00006 .00003 .000006
        Beckmann, exit    .003  .0004 .00003      -      -       -
        GGX, sky          .013  .0036  .0011  .0004  .0001  .00002
        GGX, exit         .006  .0057  .0019  .0011  .0003  .00001

    The errors of GGX belong to the smallest roughness, whose tail is the longest against its
    peak: from .02 on, and for an index up to 1.5, 6x5 leaves .0007. Rougher surfaces cost more:
    Beckmann under a sky has .0003 at .5, .0013 at .8 and .004 at 1.5 (6x5).

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
                    mend="give a whole number from 1 to 64",
                )

    def rule_along(self) -> tuple[np.ndarray, np.ndarray]:
        """Nodes and weights on (0, 1), somewhat denser at both borders."""
        node, weight = _gauss_legendre(self.along)
        return (
            (1.0 - EDGES) * node + EDGES * node**2 * (3.0 - 2.0 * node),
            weight * ((1.0 - EDGES) + EDGES * 6.0 * node * (1.0 - node)),
        )

    def rule_across(self) -> tuple[np.ndarray, np.ndarray]:
        """Nodes and weights on (0, 1), denser at the limit, where chords shrink to nothing."""
        node, weight = _gauss_legendre(self.across)
        rest = 1.0 - node
        return 1.0 - rest**CROWDING, weight * CROWDING * rest ** (CROWDING - 1.0)


class Window(NamedTuple):
    """Border of the facets that matter, in slope coordinates.

    Args:
        limit: Largest slope across the plane of the viewer. Shape (..., view).
        edges: Function from that slope to the smallest and largest slope in the plane.
    """

    limit: Array
    edges: Callable[[Array], tuple[Array, Array]]


class Facets(NamedTuple):
    """Sampled facets on a new last axis: shape (..., view, facet).

    Args:
        weight: Share of the facet in the seen area, times cos(theta_v) / G1(v).
        cos_incidence: Cosine between facet and viewer.
        sin_squared: Its squared sine.
        along_s: Squared sine times cos(2 psi), psi turning the facet's s axis to the viewer's.
        cos_light: Cosine of the zenith of the mirrored ray.
    """

    weight: Array
    cos_incidence: Array
    sin_squared: Array
    along_s: Array
    cos_light: Array


def seen(sin_view: Array, cos_view: Array) -> Window:
    """Border of all facets that face the viewer.

    Args:
        sin_view: Sine of the view zenith; its sign says which side. Shape (..., view), 1.
        cos_view: Its cosine. Same shape, 1, > 0.

    Returns:
        Window whose edges are the same for every slope across.

    Raises:
        Nothing.
    """

    def edges(across: Array) -> tuple[Array, Array]:
        del across
        lower = -cos_view / jnp.maximum(sin_view, cos_view / STEEPEST)
        upper = cos_view / jnp.maximum(-sin_view, cos_view / STEEPEST)
        return lower, upper

    return Window(jnp.full_like(cos_view, STEEPEST), edges)


def above_horizon(sin_view: Array, cos_view: Array) -> Window:
    """Border of the facets that mirror the viewer's ray into the sky: a circle of slopes.

    Args:
        sin_view: Sine of the view zenith; its sign says which side. Shape (..., view), 1.
        cos_view: Its cosine. Same shape, 1, > 0.

    Returns:
        Window.

    Raises:
        Nothing.
    """

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
    """Border of the facets that mirror the viewer's ray into a disc around the mirror direction.

    Args:
        sin_view: Sine of the view zenith; its sign says which side. Shape (..., view), 1.
        cos_view: Its cosine. Same shape, 1, > 0.
        sin_half: Sine of half the disc's half width, 1, in (0, 1).

    Returns:
        Window, cut at the horizon where the disc reaches below it.

    Raises:
        Nothing.
    """
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


def sample_facets(
    distribution: AbstractMicrofacet,
    quadrature: FacetQuadrature,
    roughness: Array,
    sin_view: Array,
    cos_view: Array,
    border: Callable[[Array, Array], Window],
) -> Facets:
    r"""Facets inside a border, weighted by the area that they show to the viewer.

    $$ \sum_i w_i f_i \approx \int f \, \frac{v\cdot m}{\cos m} D \cos m \, dm, \qquad
       \frac{v\cdot m}{\cos m} = c_v + s_v x $$

    Args:
        distribution: How facets tilt.
        quadrature: How many facets.
        roughness: Slope parameter. Broadcasts with (..., view), 1.
        sin_view: Sine of the view zenith. Shape (..., view), 1.
        cos_view: Its cosine. Same shape, 1, > 0.
        border: Window of a view, from its sine and cosine.

    Returns:
        Facets of shape (..., view, along * across).

    Raises:
        Nothing.
    """
    dtype = jnp.result_type(float, roughness, cos_view)
    share_across, weight_across = (
        jnp.asarray(np.repeat(row, quadrature.along), dtype) for row in quadrature.rule_across()
    )
    share_along, weight_along = (
        jnp.asarray(np.tile(row, quadrature.across), dtype) for row in quadrature.rule_along()
    )
    sin_view, cos_view, roughness = sin_view[..., None], cos_view[..., None], roughness[..., None]

    window = border(sin_view, cos_view)
    y, density_y = distribution.across(window.limit, roughness, share_across)
    lower, upper = window.edges(y)
    x, density_x = distribution.along(lower, upper, y, roughness, share_along)

    shown = jnp.maximum(cos_view + sin_view * x, 0.0)
    cos_tilt = 1.0 / jnp.sqrt(1.0 + x**2 + y**2)
    cos_incidence = jnp.maximum(cos_tilt * shown, 1e-6)
    in_plane = (cos_tilt * (sin_view - x * cos_view)) ** 2
    out_of_plane = (cos_tilt * y) ** 2
    return Facets(
        weight=weight_across * density_y * weight_along * density_x * shown,
        cos_incidence=cos_incidence,
        sin_squared=in_plane + out_of_plane,
        along_s=in_plane - out_of_plane,
        cos_light=2.0 * cos_incidence * cos_tilt - cos_view,
    )


def _gauss_legendre(nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Legendre nodes and weights on (0, 1)."""
    node, weight = np.polynomial.legendre.leggauss(nodes)
    return 0.5 * (node + 1.0), 0.5 * weight
