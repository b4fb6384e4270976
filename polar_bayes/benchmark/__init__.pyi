from .accuracy import (
    accuracy as accuracy,
)
from .advice import (
    accuracy_sentences as accuracy_sentences,
)
from .reference import Reference as Reference
from .run import (
    DrawsOverride as DrawsOverride,
    EffectsOverride as EffectsOverride,
    FacetsOverride as FacetsOverride,
    PrecisionOverride as PrecisionOverride,
)
