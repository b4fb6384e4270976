"""Methods by name."""

from collections.abc import Mapping
from types import MappingProxyType

from polar_bayes.errors import FitError
from polar_bayes.inference.auto import Auto
from polar_bayes.inference.batch_laplace import PixelLaplace
from polar_bayes.inference.batch_nuts import PixelNuts
from polar_bayes.inference.method import AbstractMethod
from polar_bayes.inference.mode_methods import Laplace, Nuts, Point
from polar_bayes.inference.smc import PixelSMC
from polar_bayes.inference.variational import FlowGuide, NormalGuide
from polar_bayes.inference.weighted import Importance, Tempered

METHODS: dict[str, AbstractMethod] = {
    "nuts": Nuts(),
    "laplace": Laplace(),
    "point": Point(),
    "importance": Importance(),
    "tempered": Tempered(),
    "auto": Auto(),
}
"""Methods that `polar_bayes.fit` knows by name."""

STUDY_METHODS: Mapping[str, AbstractMethod] = MappingProxyType(
    {
        **{name: METHODS[name] for name in ("point", "laplace", "importance", "tempered")},
        "normal guide": NormalGuide(),
        "flow guide": FlowGuide(),
        "nuts short": Nuts(warmup=100, draws=100, most_draws=100),
        "nuts": METHODS["nuts"],
        "nuts long": Nuts(warmup=1000, draws=4000, most_draws=4000),
    }
)
"""Methods that `polar_bayes.accuracy` compares, from cheap to exact. One more is one more value:
`{**STUDY_METHODS, "mine": Mine()}`."""


def find_method(
    method: str | AbstractMethod, tolerance: float | None, seconds: float | None
) -> AbstractMethod:
    """The settings that a caller asks for, by name or as they are."""
    limits = {"tolerance": tolerance, "seconds": seconds}
    given = {name: value for name, value in limits.items() if value is not None}
    if given and method != "auto":
        raise FitError(
            f"{' and '.join(given)} needs method='auto'",
            where=f"fit: method={method!r}",
            hint="leave it out, or give method='auto'",
        )
    if given:
        return Auto(**given)
    if isinstance(method, AbstractMethod):
        return method
    if not isinstance(method, str) or method not in METHODS:
        raise FitError(
            "no such method",
            where=f"method={method!r}",
            hint=f"give one of {', '.join(METHODS)}, or settings such as Nuts(draws=2000)",
        )
    return METHODS[method]


__all__ = [
    "STUDY_METHODS",
    "Auto",
    "FlowGuide",
    "Importance",
    "Laplace",
    "NormalGuide",
    "Nuts",
    "PixelLaplace",
    "PixelNuts",
    "PixelSMC",
    "Point",
    "Tempered",
]
