from .accuracy import (
    accuracy as accuracy,
    holds_accuracy as holds_accuracy,
    load_accuracy as load_accuracy,
)
from .advice import (
    accuracy_advice as accuracy_advice,
    accuracy_table as accuracy_table,
)
from .reference import Reference as Reference
from .run import (
    DrawsDial as DrawsDial,
    EffectsDial as EffectsDial,
    FacetsDial as FacetsDial,
    PrecisionDial as PrecisionDial,
)
