from .accuracy import (
    accuracy as accuracy,
    holds_accuracy as holds_accuracy,
    load_accuracy as load_accuracy,
)
from .advice import (
    accuracy_sentences as accuracy_sentences,
    accuracy_table as accuracy_table,
)
from .reference import Reference as Reference
from .run import (
    DrawsOverride as DrawsOverride,
    EffectsOverride as EffectsOverride,
    FacetsOverride as FacetsOverride,
    PrecisionOverride as PrecisionOverride,
)
