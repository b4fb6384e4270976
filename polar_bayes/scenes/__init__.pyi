from . import stacking as stacking
from .candidates import (
    SceneLibrary as SceneLibrary,
    scene_library as scene_library,
)
from .comparison import compare_scenes as compare_scenes
from .fitting import fit as fit
from .sentences import (
    SceneComparison as SceneComparison,
    scene_sentences as scene_sentences,
    scene_table as scene_table,
)
