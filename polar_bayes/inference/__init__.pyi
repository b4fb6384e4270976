from . import methods as methods
from .files import auto_sentences as auto_sentences
from .spectrum import predict_spectrum as predict_spectrum
