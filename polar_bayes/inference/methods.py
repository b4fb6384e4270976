"""The ladder that `polar_bayes.accuracy` climbs: every method from cheap to exact, by name."""

from collections.abc import Mapping
from types import MappingProxyType

from polar_bayes.inference.auto import Auto
from polar_bayes.inference.batch_fit import PixelLaplace
from polar_bayes.inference.batch_nuts import PixelNuts
from polar_bayes.inference.laplace import Laplace, Point
from polar_bayes.inference.nuts import Nuts
from polar_bayes.inference.request import Method
from polar_bayes.inference.smc import PixelTempering
from polar_bayes.inference.variational import FlowGuide, NormalGuide
from polar_bayes.inference.weighted import Importance, Tempered

LADDER: Mapping[str, Method] = MappingProxyType(
    {
        "point": Point(),
        "laplace": Laplace(),
        "importance": Importance(),
        "tempered": Tempered(),
        "normal guide": NormalGuide(),
        "flow guide": FlowGuide(),
        "nuts short": Nuts(warmup=100, draws=100, most_draws=100),
        "nuts": Nuts(),
        "nuts long": Nuts(warmup=1000, draws=4000, most_draws=4000),
    }
)
"""Rungs by name. One more is one more value: `{**LADDER, "mine": Mine()}`."""

__all__ = [
    "LADDER",
    "Auto",
    "FlowGuide",
    "Importance",
    "Laplace",
    "NormalGuide",
    "Nuts",
    "PixelLaplace",
    "PixelNuts",
    "PixelTempering",
    "Point",
    "Tempered",
]
