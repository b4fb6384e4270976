from . import methods as methods
from .auto import auto_sentences as auto_sentences
from .files import (
    load_result as load_result,
    save_result as save_result,
)
from .fitting import fit as fit
from .spectrum import predict_spectrum as predict_spectrum
