from .candidates import (
    SceneLibrary as SceneLibrary,
    scene_library as scene_library,
)
from .comparison import (
    compare_scenes as compare_scenes,
    SceneComparison as SceneComparison,
    Setting as Setting,
)
from .fitting import fit as fit
from .sentences import (
    scene_sentences as scene_sentences,
    scene_table as scene_table,
)
from .stacking import fit_best_scenes as fit_best_scenes
