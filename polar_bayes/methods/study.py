"""Methods of an accuracy study, in a file of their own since it loads all of them."""

from collections.abc import Mapping
from types import MappingProxyType

from polar_bayes.methods.method import AbstractMethod, make_method
from polar_bayes.methods.nuts import Nuts
from polar_bayes.methods.registry import method_names

STUDY_METHODS: Mapping[str, AbstractMethod] = MappingProxyType(
    {
        **{n: make_method(n) for n in method_names(one=True) if n not in ("nuts", "auto")},
        "nuts short": Nuts(warmup=100, draws=100, most_draws=100),
        "nuts": Nuts(),
        "nuts long": Nuts(warmup=1000, draws=4000, most_draws=4000),
    }
)
"""Methods that `polar_bayes.accuracy` compares by default, from cheap to exact. To add one, pass
`{**STUDY_METHODS, "mine": Mine()}`."""
