from . import methods as methods
from .files import auto_sentences as auto_sentences, choice_sentences as choice_sentences
from .scene_file import (
    load_scene as load_scene,
    save_scene as save_scene,
    scene_text as scene_text,
)
from .spectrum import predict_spectrum as predict_spectrum
