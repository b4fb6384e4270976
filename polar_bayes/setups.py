"""Named measurement set-ups: scene, links and view limit.

`scene="goniometer"` in a fit selects one of these; every part of it can be replaced.
"""

import dataclasses
import math
from collections.abc import Mapping
from numbers import Real
from types import MappingProxyType

import jax
import numpy as np
import pandas as pd
import xarray as xr
from numpyro import distributions as dist

from polar_bayes.capture.plausibility import at_mirror
from polar_bayes.errors import FitError, SceneError
from polar_bayes.frames import PrintedFrame
from polar_bayes.observation.links import AbstractLink, BetaLink, StokesLink, StudentTLink
from polar_bayes.physics.illumination import PointSource
from polar_bayes.physics.input_quantities import (
    AbstractInputQuantity,
    AmbientLight,
    AnalyzerRoll,
    IncidenceAngle,
    LightAzimuth,
    LightZenith,
    PolarizationLoss,
    ToneCurve,
    ViewZenithScale,
    quantity_of,
)
from polar_bayes.physics.instrument import (
    Analyzer,
    AngleZero,
    ChannelGain,
    Discrepancy,
    Instrument,
)
from polar_bayes.physics.part import notation, parameters_of
from polar_bayes.physics.scene import SCENES, Scene
from polar_bayes.physics.stokes import LinearPolarization
from polar_bayes.physics.surface import SmoothSurface
from polar_bayes.priors import (
    ANGLE_ZERO,
    PRIORS,
    UNCHECKED_GAIN,
    Beta,
    describe_prior,
    resolve_priors,
)
from polar_bayes.repr_html import HTMLRepr

__all__ = ["SETUPS", "Setup", "prior_table"]


@dataclasses.dataclass(frozen=True)
class Setup(HTMLRepr):
    """A measurement set-up.

    Args:
        scene: The optics.
        links: Likelihood link of each variable that such a capture may hold.
        largest_view_zenith: Views beyond it are set aside and counted. Unit degree.
        priors: Distributions that replace those of `polar_bayes.PRIORS` in this set-up.
        shared: Instrument parameters that the pixels of an image share by default.
        known: Input quantities that every scene of this set-up has beside its own instrument;
            the widths of their priors are their standard uncertainties.
        sampled: Names of those that every pixel of an image samples, since their effect is not
            linear; the others move all pixels alike (`polar_bayes.fit_pixels`).
    """

    scene: Scene
    links: Mapping[str, AbstractLink]
    largest_view_zenith: float = 90.0
    priors: Mapping[str, dist.Distribution] = dataclasses.field(default_factory=dict)
    shared: tuple[str, ...] = ()
    known: tuple[AbstractInputQuantity, ...] = ()
    sampled: tuple[str, ...] = ()


# A bare surface is as common as any body, and where it is one, the index must not follow a fraction
# that its prior keeps away from zero: half of this one is below .031, a quarter below .001.
MAYBE_BARE = {"subsurface_fraction": Beta(0.2, 1.0)}

UNSTATED = "polarimeter"
"""Set-up of a capture that names none."""

SETUPS: Mapping[str, Setup] = MappingProxyType(
    {
        "paper": Setup(
            SCENES["paper"], {"dop": BetaLink(), "intensity": StudentTLink()}, priors=MAYBE_BARE
        ),
        # Measured degrees of polarization: the paper's optics, and a set-up known to what is usual.
        "polarimeter": Setup(
            SCENES["polarimeter"],
            {"dop": BetaLink(), "intensity": StudentTLink()},
            priors=MAYBE_BARE,
            known=(
                LightZenith(),
                LightAzimuth(),
                ViewZenithScale(),
                PolarizationLoss(),
                AmbientLight(),
                ToneCurve(),
            ),
            sampled=("ambient_light",),  # in a bare pixel it is all of the light beside the lobe
        ),
        "camera": Setup(
            SCENES["camera"],
            {"q": StokesLink(), "u": StokesLink(), "intensity": StudentTLink()},
            # One polarizer took the image, by one lamp, whose direction moves the means of many
            # pixels further than they are known to.
            shared=("dolp_gain", "light_zenith_offset"),
            known=(  # the gain of polarization is in `dolp_gain`
                LightZenith(),
                LightAzimuth(),
                ViewZenithScale(),
                AnalyzerRoll(),
                AmbientLight(),
                ToneCurve(),
            ),
        ),
        # The irradiance of a pixel is unknown, so brightness carries no information; the noise of
        # every pixel is known.
        "picture": Setup(
            SCENES["picture"],
            {"q": StokesLink(stated_errors=True), "u": StokesLink(stated_errors=True)},
            # A fraction of .009 dilutes the polarization of a mirror by a fifth already.
            priors=MAYBE_BARE,
            known=(AnalyzerRoll(), PolarizationLoss(), ToneCurve()),
            sampled=("polarization_loss",),  # of a bare mirror, it looks like a little body
        ),
        # A laser beam grows longer than the sample towards grazing, each channel losing its own
        # share: beyond 78 degrees a plate's readings say more about its size than its index.
        "goniometer": Setup(
            SCENES["goniometer"],
            {"q": StokesLink(degrees_of_freedom=4.0, stated_errors=True)},
            largest_view_zenith=78.0,
            # A plate with an opaque back sends nothing from below: zero must not be an outlier.
            priors={"subsurface_fraction": Beta(1.0, 3.0)},
        ),
    }
)


def find_setup(name: str | Setup) -> Setup:
    """Return the set-up of a name; a user's set-up is returned unchanged."""
    if isinstance(name, Setup):
        return name
    if not isinstance(name, str) or name not in SETUPS:
        hint = f"give one of {', '.join(SETUPS)}, or a polar_bayes.Scene"
        raise SceneError("no such scene", where=f"scene={name!r}", hint=hint)
    return SETUPS[name]


def as_read(setup: Setup, capture: xr.Dataset) -> Setup:
    """The set-up as a capture was read: at mirror angles, by one channel, by polarized light."""
    is_usual = any(setup.known == own.known for own in SETUPS.values())
    if is_usual and is_mirrored(capture):
        setup = _at_mirror_angles(setup)
    if "light_angle" in capture.get("u", xr.DataArray()).attrs:
        return _by_polarized_light(setup, float(capture["u"].attrs["light_angle"]))
    if {"dop", "q", "u"} & set(capture.data_vars) or "intensity" not in capture:
        return setup
    return _of_one_channel(setup, capture)


def is_mirrored(capture: xr.Dataset) -> bool:
    """Whether every view is in the mirror direction of the light."""
    return bool(at_mirror(capture, within=0.5).all())


def _at_mirror_angles(setup: Setup) -> Setup:
    """One angle sets lamp and viewer, so that they share its error."""
    # Where no view leaves the highlight, readings do not tell a lamp's direction from a roughness.
    directions = (LightZenith, LightAzimuth, ViewZenithScale)
    others = tuple(each for each in setup.known if not isinstance(each, directions))
    if len(others) == len(setup.known):
        return setup
    one = () if setup.scene.has(AngleZero) else (IncidenceAngle(),)  # two would be the same error
    return dataclasses.replace(setup, known=(*one, *others))


def _by_polarized_light(setup: Setup, angle: float) -> Setup:
    """Add an ellipsometer's polarized light, by which u depends on the phase of s and p."""
    surface = setup.scene.surface
    if not isinstance(surface, SmoothSurface) or "q" not in setup.links:
        return setup
    beam = PointSource(LinearPolarization(angle=angle))
    scene = dataclasses.replace(setup.scene, surface=dataclasses.replace(surface, beam=beam))
    links = {"u": setup.links["q"], **setup.links}
    return dataclasses.replace(setup, scene=scene, links=links)


def _of_one_channel(setup: Setup, capture: xr.Dataset) -> Setup:
    """The analyzer of a channel is part of the scene, its gain is part of the exposure."""
    scene, channel = setup.scene, str(capture["intensity"].attrs.get("channel"))
    angle = {"s": 0.0, "p": 90.0}.get(channel)
    scene = scene.without(ChannelGain) if scene.has(ChannelGain) else scene
    if angle is not None and not scene.has(Analyzer):
        scene = dataclasses.replace(scene, instrument=Instrument((*scene.terms, Analyzer(angle))))
    stated = "intensity_error" in capture
    link = setup.links.get("intensity", StudentTLink(stated_errors=stated))
    return dataclasses.replace(setup, scene=scene, links={**setup.links, "intensity": link})


def setup_name(setup: Setup) -> str:
    """Return the name of the set-up that has this scene, or "custom"."""
    scene = setup.scene.perfectly_known
    names = [name for name, own in SETUPS.items() if own.scene == scene]
    return next(
        (name for name in names if SETUPS[name].known == setup.known), (*names, "custom")[0]
    )


def default_priors(
    setup: Setup, capture: xr.Dataset, known: Mapping[str, float] | None = None
) -> dict[str, dist.Distribution]:
    """Return priors of a set-up, adapted to how the capture was made.

    The caller may say what the set-up is known to: standard uncertainties by input quantity.
    """
    attrs = capture.attrs
    angle = ANGLE_ZERO[attrs.get("angle_set_by", "hand")]
    priors: dict[str, dist.Distribution] = {"angle_zero": angle, "incidence_angle_offset": angle}
    if attrs.get("incident_levels") == "not given":
        priors["channel_gain_ratio"] = UNCHECKED_GAIN
    for term in setup.scene.terms:
        if isinstance(term, Discrepancy):  # as many weights as it has basis functions
            priors["discrepancy_weights"] = dist.Normal(0.0, 1.0).expand([term.basis]).to_event(1)
    priors |= setup.priors
    priors = {name: prior for name, prior in priors.items() if name in setup.scene.parameters}
    return priors | _priors_known_to(known or {}, capture, setup, priors)


def _priors_known_to(
    known: Mapping[str, float],
    capture: xr.Dataset,
    setup: Setup,
    own: Mapping[str, dist.Distribution],
) -> dict[str, dist.Distribution]:
    """Return priors of input quantities that the caller or the capture states."""
    every = {**PRIORS, **own}
    own_terms = parameters_of(*setup.scene.terms)
    usual = {name: every[name] for name in own_terms if name in every}
    names = {quantity_of(name): name for name in usual if _is_error(usual[name])}
    stated = {name: capture.attrs.get(f"{name}_uncertainty") for name in names}
    stated = {name: u for name, u in stated.items() if u is not None} | dict(known)
    found = {}
    for name, u in stated.items():
        where = f"known: {name}" if name in known else f"capture: {name}_uncertainty"
        if name not in names:
            hint = f"give some of {', '.join(names)}" if names else "a scene's terms state them"
            if name in names.values():
                hint = f"give it as {quantity_of(name)}"
            elif name in usual:  # no error around zero
                hint = f"state its prior, by priors={{{name!r}: ...}}"
            raise FitError("no input quantity of this scene", where=where, hint=hint)
        check_uncertainty(u, where)
        kind = type(usual[names[name]])
        # Of what only adds, the scale of the prior is not its standard deviation.
        over_scale = math.sqrt(1.0 - 2.0 / math.pi) if issubclass(kind, dist.HalfNormal) else 1.0
        found[names[name]] = kind(scale=float(u) / over_scale)
    return found


def check_known(known: object) -> Mapping[str, float]:
    """Return standard uncertainties by name; raise FitError unless that is what is given."""
    if not isinstance(known, Mapping | None):
        what, hint = f"it is {known!r}", "give a mapping such as {'light_zenith': 0.2}"
        raise FitError(what, where="known", hint=hint)
    return known or {}


def check_uncertainty(u: object, where: str) -> None:
    """Raise FitError unless a value is a standard uncertainty."""
    if not isinstance(u, Real) or isinstance(u, bool) or not 0.0 < float(u) < math.inf:
        raise FitError(f"it is {u!r}", where=where, hint="give a number above 0")


def _is_error(prior: dist.Distribution) -> bool:
    """Return whether a prior is that of an error, which is zero in a perfect set-up."""
    is_centered = isinstance(prior, dist.Normal) and np.ndim(prior.loc) == 0 and prior.loc == 0.0
    return is_centered or isinstance(prior, dist.HalfNormal)


def prior_table(
    scene: str | Scene | Setup | None = None,
    *,
    priors: Mapping[str, dist.Distribution] | None = None,
) -> pd.DataFrame:
    """Return the priors as a table.

    Args:
        scene: A set-up or its name, whose links' noise is listed too, or a scene; by default every
            parameter that has a prior.
        priors: Distributions that replace or extend `polar_bayes.PRIORS`, as for `polar_bayes.fit`.

    Returns:
        A row for each parameter: symbol, meaning, unit, prior (as text), and its quantiles q2.5,
        q50 and q97.5 (unit of the parameter), of 10,000 draws with a fixed seed.

    Raises:
        SceneError: No such set-up.
        FitError: A prior cannot be used, or belongs to no parameter of the scene.
    """
    rows = {}
    own = find_setup(scene).priors if isinstance(scene, str | Setup) else {}
    for name, prior in resolve_priors(_names(scene, priors), {**own, **(priors or {})}).items():
        draws = np.asarray(prior.sample(jax.random.key(0), (10_000,)))
        levels = np.quantile(draws, (0.025, 0.5, 0.975)).tolist()
        rows[name] = [*notation(name), describe_prior(prior), *levels]
    columns = ["symbol", "meaning", "unit", "prior", "q2.5", "q50", "q97.5"]
    return PrintedFrame.from_dict(rows, orient="index", columns=columns)


def _names(
    scene: str | Scene | Setup | None, priors: Mapping[str, dist.Distribution] | None
) -> tuple[str, ...]:
    if scene is None:
        return tuple({**PRIORS, **(priors or {})})
    if isinstance(scene, Scene):
        return scene.parameters
    setup = find_setup(scene)
    noise = (name for link in setup.links.values() for name in link.parameters)
    return tuple(dict.fromkeys((*setup.scene.parameters, *noise)))
