from .candidates import (
    SceneLibrary as SceneLibrary,
    scene_library as scene_library,
)
from .comparison import (
    compare_scenes as compare_scenes,
    FitArguments as FitArguments,
)
from .fitting import fit as fit
from .sentences import (
    SceneComparison as SceneComparison,
    scene_sentences as scene_sentences,
    scene_table as scene_table,
)
from .stacking import fit_best_scenes as fit_best_scenes
