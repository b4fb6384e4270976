"""Microfacet distributions: slopes, shadowing, and nodes for quadrature.

Write a new distribution by giving the four methods of `AbstractMicrofacet`; every rough surface
then works with it. `density` and `shadowing` serve a point source, `across` and `along` (the two
slopes of a facet, one after the other) serve extended sources and the way out of the body.
"""

import abc
import dataclasses
from typing import Annotated, ClassVar, NamedTuple, override

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polar_bayes.physics.geometry import Geometry, cos_degrees, sin_degrees
from polar_bayes.physics.part import Parameters, Part, Range, Setting, at_least, value_of

# A roughness below this is taken as this: the width of a highlight is then 0.001 degree, which no
# instrument resolves, and its peak brightness stays within single precision.
SMOOTHEST = 1e-5

# Beckmann slopes are sampled from a Gaussian of this many times their variance: the weight that
# is left, exp(-1.5 x^2), is smooth where the sampling alone has logarithmic ends.
BROADENING = 2.5

# Beyond this many widths an error function is 1 in double precision.
TAIL = 6.0


@dataclasses.dataclass(frozen=True)
class AbstractMicrofacet(Part):
    """A distribution of facet slopes, isotropic around the surface normal."""

    defines: ClassVar[tuple[str, ...]] = ("roughness", "roughness_across")

    @abc.abstractmethod
    def density(self, tan_squared: Array, roughness: Array) -> Array:
        """Facet area per steradian around a tilt, D.

        Args:
            tan_squared: Squared slope of the facet. Any shape, 1, >= 0.
            roughness: Slope parameter alpha. Broadcasts, 1, >= 0.

        Returns:
            D. Broadcast shape, 1/sr, > 0.
        """

    @abc.abstractmethod
    def shadowing(self, tan_squared: Array, roughness: Array) -> Array:
        """Share of facets that are not hidden in one direction, Smith's G1.

        Args:
            tan_squared: Squared tangent of the direction's zenith. Any shape, 1, >= 0.
            roughness: Slope parameter alpha. Broadcasts, 1, >= 0.

        Returns:
            G1. Broadcast shape, 1, in (0, 1].
        """

    @abc.abstractmethod
    def across(self, limit: Array, roughness: Array, share: Array) -> tuple[Array, Array]:
        """Nodes and weights of slopes across the plane of the viewer, from 0 to a limit.

        Args:
            limit: Largest slope. Any shape, 1, > 0.
            roughness: Slope parameter alpha. Broadcasts, 1, >= 0.
            share: How far along the way to the limit. Broadcasts, 1, in (0, 1).

        Returns:
            `(slope, weight)`: the mean over facets of `f(|slope|)` up to the limit is the
            integral of weight * f(slope) over share from 0 to 1.
        """

    @abc.abstractmethod
    def along(
        self, lower: Array, upper: Array, across: Array, roughness: Array, share: Array
    ) -> tuple[Array, Array]:
        """Nodes and weights of slopes in the viewer's plane, given a slope across it.

        Args:
            lower: Smallest slope. Any shape, 1.
            upper: Largest slope. Same shape, 1.
            across: Slope across the plane. Broadcasts, 1.
            roughness: Slope parameter alpha. Broadcasts, 1, >= 0.
            share: How far from lower to upper. Broadcasts, 1, in (0, 1).

        Returns:
            `(slope, weight)` of the conditional distribution, as in `across`.
        """

    def along_whole(
        self, lower: Array, upper: Array, across: Array, roughness: Array
    ) -> Array | None:
        """Exact sum of the weights of `along`; None where few nodes are accurate enough.

        Args:
            lower: As in `along`, and so are the others.
            upper: Largest slope.
            across: Slope across the plane.
            roughness: Slope parameter alpha.

        Returns:
            Share of the facets with that slope across that are between the limits. Broadcast
            shape, 1, in [0, 1].
        """
        del lower, upper, across, roughness
        return None


@dataclasses.dataclass(frozen=True)
class Beckmann(AbstractMicrofacet):
    r"""Gaussian slopes.

    $$ D = \frac{e^{-t^2/\alpha^2}}{\pi\alpha^2\cos^4\theta}, \qquad
       G_1 = \frac{3.535 y + 2.181}{y^2 + 2.276 y + 2.577}
       \text{ where } y = \alpha\tan\theta > 0.625, \text{ else } 1 $$

    G1 is the rational fit that renderers and the reference tables use; it is within 0.6 % of the
    exact form with error functions.

    Source:
        Walter et al. 2007, Microfacet models for refraction through rough surfaces.
    """

    @override
    def alternatives(self) -> tuple[Part, ...]:
        return (GGX(),)

    @override
    def density(self, tan_squared: Array, roughness: Array) -> Array:
        alpha = at_least(roughness, SMOOTHEST)
        # Far from the mirror direction the exponential would underflow and take the derivatives
        # with it; it stops just above the smallest number instead.
        darkest = -0.9 * np.log(np.finfo(jnp.result_type(tan_squared, alpha)).tiny).item()
        # Single precision holds a Hessian only if the width is divided out step by step, and only
        # where there is light; for the same reason the square is taken last.
        exponent = jnp.minimum(tan_squared, darkest * alpha**2) / alpha / alpha
        return (jnp.exp(-0.5 * exponent) * (1.0 + tan_squared) / alpha) ** 2 / jnp.pi

    @override
    def shadowing(self, tan_squared: Array, roughness: Array) -> Array:
        steepness = at_least(roughness, SMOOTHEST) ** 2 * tan_squared
        shadowed = steepness > 0.625**2
        y = jnp.sqrt(jnp.where(shadowed, steepness, 1.0))
        return jnp.where(shadowed, (3.535 * y + 2.181) / (y**2 + 2.276 * y + 2.577), 1.0)

    @override
    def across(self, limit: Array, roughness: Array, share: Array) -> tuple[Array, Array]:
        width = at_least(roughness, SMOOTHEST) * BROADENING**0.5
        end = jax.lax.erf(jnp.minimum(limit / width, TAIL))
        x = jax.lax.erf_inv(end * share)
        return width * x, end * BROADENING**0.5 * jnp.exp(-(BROADENING - 1.0) * x**2)

    @override
    def along(
        self, lower: Array, upper: Array, across: Array, roughness: Array, share: Array
    ) -> tuple[Array, Array]:
        width = at_least(roughness, SMOOTHEST) * BROADENING**0.5
        start = jax.lax.erf(jnp.clip(lower / width, -TAIL, TAIL))
        extent = jax.lax.erf(jnp.clip(upper / width, -TAIL, TAIL)) - start
        # Where both limits lie far out on one side nothing has weight, but all must be finite.
        furthest = 1.0 - jnp.finfo(extent.dtype).eps
        x = jax.lax.erf_inv(jnp.clip(start + extent * share, -furthest, furthest))
        weight = 0.5 * extent * BROADENING**0.5 * jnp.exp(-(BROADENING - 1.0) * x**2)
        return width * x, weight


@dataclasses.dataclass(frozen=True)
class GGX(AbstractMicrofacet):
    r"""Slopes with a long tail, also called Trowbridge-Reitz.

    $$ D = \frac{\alpha^2}{\pi}\left(\frac{1+t^2}{\alpha^2+t^2}\right)^2, \qquad
       G_1 = \frac{2}{1+\sqrt{1+\alpha^2\tan^2\theta}} $$

    Source:
        Walter et al. 2007, Microfacet models for refraction through rough surfaces.
    """

    @override
    def alternatives(self) -> tuple[Part, ...]:
        return (Beckmann(),)

    @override
    def density(self, tan_squared: Array, roughness: Array) -> Array:
        alpha = at_least(roughness, SMOOTHEST)
        # Two small steps in place of a large one: a Hessian would leave single precision.
        width = jnp.sqrt(alpha**2 + tan_squared)
        return (alpha / width * ((1.0 + tan_squared) / width)) ** 2 / jnp.pi

    @override
    def shadowing(self, tan_squared: Array, roughness: Array) -> Array:
        alpha = at_least(roughness, SMOOTHEST)
        return 2.0 / (1.0 + jnp.sqrt(1.0 + alpha**2 * tan_squared))

    @override
    def across(self, limit: Array, roughness: Array, share: Array) -> tuple[Array, Array]:
        alpha = at_least(roughness, SMOOTHEST)
        end = _quarter(limit, alpha)
        tangent, widening = _fourfold(end * share)
        return alpha * tangent, end * widening / jnp.sqrt(1.0 + tangent**2)

    @override
    def along(
        self, lower: Array, upper: Array, across: Array, roughness: Array, share: Array
    ) -> tuple[Array, Array]:
        width = jnp.sqrt(at_least(roughness, SMOOTHEST) ** 2 + across**2)
        start = _quarter(lower, width)
        extent = _quarter(upper, width) - start
        tangent, widening = _fourfold(start + extent * share)
        return width * tangent, extent * (2.0 / jnp.pi) * widening / (1.0 + tangent**2)

    @override
    def along_whole(
        self, lower: Array, upper: Array, across: Array, roughness: Array
    ) -> Array | None:
        # (d + sin d cos e)/pi, d and e difference and sum of the angles whose tangents are the
        # limits over the width.
        width = jnp.sqrt(at_least(roughness, SMOOTHEST) ** 2 + across**2)
        low, high = jnp.sqrt(width**2 + lower**2), jnp.sqrt(width**2 + upper**2)
        square, product = width / low * (width / high), lower / low * (upper / high)
        sine = width / low * ((upper - lower) / high)
        return (jnp.arctan2(sine, square + product) + sine * (square - product)) / jnp.pi


def _quarter(slope: Array, width: Array) -> Array:
    """Tangent of a quarter of the angle whose tangent is slope / width."""
    # Nearly proportional to the angle, and a gradient costs a third of what arctan and tan take.
    half = slope / (width + jnp.sqrt(width**2 + slope**2))
    return half / (1.0 + jnp.sqrt(1.0 + half**2))


def _fourfold(quarter: Array) -> tuple[Array, Array]:
    """Tangent of four times an angle with this tangent, and the angle's derivative by it."""
    half = 2.0 * quarter / (1.0 - quarter**2)
    # Slopes far out on one side have no weight, but must be finite: rounding may reach 90 degrees.
    furthest = 1.0 - jnp.finfo(half.dtype).eps
    half = jnp.clip(half, -furthest, furthest)
    return 2.0 * half / ((1.0 - half) * (1.0 + half)), 4.0 / (1.0 + quarter**2)


# --- How steep facets are in which direction: alike all around, or along and across grooves -------


class Axes(NamedTuple):
    """Axes of an ellipse of slopes: along grooves, whose slopes across are steep.

    Args:
        gentle: Roughness of slopes along the axis of the gentler slopes. Shape (..., view), 1.
        steep: Roughness along the other axis, which is the first turned by 90 degrees.
        cos: Cosine of the angle from the direction of the viewer to the gentle axis.
        sin: Its sine.
    """

    gentle: Array
    steep: Array
    cos: Array
    sin: Array


class SlopeEllipse(NamedTuple):
    """Slopes in the frame of one viewer: x towards it, y across.

    With u and w isotropic of roughness 1: y = across w and x = along u + shear w.

    Args:
        across: Roughness of y. Shape (..., view), 1.
        along: Roughness of x for a given y. Same shape, 1.
        shear: How far x follows y; None where the surface is the same on both sides of the plane
            of the viewer, so that one side need not be sampled.
        axes: The frame in which such slopes are sampled.
    """

    across: Array
    along: Array
    shear: Array | None
    axes: Axes | None = None


@dataclasses.dataclass(frozen=True)
class AbstractSlopes(Part):
    """Roughness of a surface as a function of direction.

    Args:
        turned: Whether it changes with azimuth.
    """

    turned: ClassVar[bool] = True

    @abc.abstractmethod
    def ellipse(self, parameters: Parameters, geometry: Geometry) -> SlopeEllipse:
        """Slopes in the frame of each viewer.

        Args:
            parameters: Material parameters by name. Each broadcasts with (..., view).
            geometry: Directions. Shape (..., view), degree.
        """


@dataclasses.dataclass(frozen=True)
class IsotropicSlopes(AbstractSlopes):
    """Equal roughness in all directions."""

    parameters: ClassVar[tuple[str, ...]] = ("roughness",)
    turned: ClassVar[bool] = False

    @override
    def ellipse(self, parameters: Parameters, geometry: Geometry) -> SlopeEllipse:
        # Of every view, so that its many uses sum their derivatives over the views in one loop.
        roughness, _ = jnp.broadcast_arrays(parameters["roughness"], geometry.view_zenith)
        return SlopeEllipse(roughness, roughness, None)


@dataclasses.dataclass(frozen=True)
class AnisotropicSlopes(AbstractSlopes):
    r"""Two roughnesses: `roughness` along an azimuth, `roughness_across` at right angles to it.

    $$ \sigma_{xx} = \alpha^2\cos^2\delta + \alpha_\perp^2\sin^2\delta, \quad
       \sigma_{yy} = \alpha^2\sin^2\delta + \alpha_\perp^2\cos^2\delta, \quad
       \sigma_{xy} = (\alpha^2-\alpha_\perp^2)\sin\delta\cos\delta $$

    with delta the azimuth of `roughness` against the viewer's. Brushed metal, wood and veins.

    Args:
        azimuth: Direction of `roughness`, degree, -360 to 360; a name fits it.

    Raises:
        SceneError: The azimuth is neither a number in its range nor a name.
    """

    azimuth: Annotated[Setting, Range(-360.0, 360.0)] = 0.0

    @property
    @override
    def parameters(self) -> tuple[str, ...]:
        return ("roughness", "roughness_across", *super().parameters)

    @override
    def simpler(self) -> tuple[Part | None, ...]:
        return (IsotropicSlopes(),)

    @override
    def ellipse(self, parameters: Parameters, geometry: Geometry) -> SlopeEllipse:
        first = at_least(parameters["roughness"], SMOOTHEST)
        second = at_least(parameters["roughness_across"], SMOOTHEST)
        turn = value_of(self.azimuth, parameters) - geometry.view_azimuth
        sin, cos = sin_degrees(turn), cos_degrees(turn)
        across = jnp.sqrt((first * sin) ** 2 + (second * cos) ** 2)
        shear = (first - second) * (first + second) * sin * cos / across
        # Nodes follow the steep slopes line by line, so that a border that cuts through them is met
        # exactly. Where both roughnesses are equal the axes change places.
        given = first < second
        axes = Axes(
            jnp.where(given, first, second),
            jnp.where(given, second, first),
            jnp.where(given, cos, -sin),
            jnp.where(given, sin, cos),
        )
        return SlopeEllipse(across, first * second / across, shear, axes)


# --- Which facets see the viewer, the light, or both: Smith's shadowing and masking ---------------


@dataclasses.dataclass(frozen=True)
class AbstractShadowing(Part):
    """Joint visibility of two directions, given the share G1 of facets that see each."""

    @abc.abstractmethod
    def both(self, view: Array, light: Array) -> Array:
        """Share of facets that see both viewer and light.

        Args:
            view: G1 of the viewer. Any shape, 1, in (0, 1].
            light: G1 of the light. Broadcasts, 1, in (0, 1].

        Returns:
            G. Broadcast shape, 1, in (0, 1].
        """

    def twice(self, view: Array, ray: Array, light: Array, rises: Array) -> Array:
        """Share of pairs of facets that see each other, one the viewer, one the light.

        Args:
            view: G1 of the viewer. Any shape, 1, in (0, 1].
            ray: G1 of the ray from the viewer's facet to the light's, up or down. Broadcasts.
            light: G1 of the light. Broadcasts, 1, in (0, 1].
            rises: Whether the ray goes up. Broadcasts.

        Returns:
            G over the area that facets show to the ray, per its cosine. Broadcast shape, 1, in
            (0, 1]. As if all were independent, unless a part says otherwise.
        """
        del rises
        return view * ray * light


@dataclasses.dataclass(frozen=True)
class SeparableShadowing(AbstractShadowing):
    """Independent visibility of viewer and light: G = G1(v) G1(l).

    Source:
        Walter et al. 2007, Microfacet models for refraction through rough surfaces.
    """

    @override
    def both(self, view: Array, light: Array) -> Array:
        return view * light


@dataclasses.dataclass(frozen=True)
class HeightCorrelatedShadowing(AbstractShadowing):
    r"""Visibility correlated by height: high facets see both, deep facets neither.

    $$ G = \frac{1}{1 + \Lambda_v + \Lambda_l}, \qquad \Lambda = 1/G_1 - 1 $$

    Of two facets one after the other, the lower one's ray has to pass those above it as well: with
    x the viewer for a ray r that rises, and the light for one that falls,

    $$ G = \frac{1}{(1 + \Lambda_v + \Lambda_l) (1 + \Lambda_x + \Lambda_r)} $$

    which is the second order of a walk in Smith's model exactly.

    Source:
        Heitz 2014, Understanding the masking-shadowing function in microfacet-based BRDFs.
    """

    @override
    def both(self, view: Array, light: Array) -> Array:
        return view * light / (view + light - view * light)

    @override
    def twice(self, view: Array, ray: Array, light: Array, rises: Array) -> Array:
        return self.both(view, light) * self.both(ray, jnp.where(rises, view, light))

    @override
    def simpler(self) -> tuple[Part | None, ...]:
        return (SeparableShadowing(),)


@dataclasses.dataclass(frozen=True)
class NoShadowing(AbstractShadowing):
    """No shadowing: brighter towards grazing than any real surface."""

    @override
    def both(self, view: Array, light: Array) -> Array:
        return jnp.ones_like(view)
