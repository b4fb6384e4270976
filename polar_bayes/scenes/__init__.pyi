from . import stacking as stacking
from .comparison import compare_scenes as compare_scenes
from .effects import (
    ChosenScene as ChosenScene,
    choose_effects as choose_effects,
    ledger_summary as ledger_summary,
)
from .fitting import fit as fit
from .library import (
    SceneLibrary as SceneLibrary,
    scene_library as scene_library,
)
from .scene_file import (
    load_scene as load_scene,
    save_scene as save_scene,
    scene_text as scene_text,
)
from .sentences import (
    SceneComparison as SceneComparison,
    scene_sentences as scene_sentences,
    scene_table as scene_table,
)
