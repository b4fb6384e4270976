from .files import auto_sentences as auto_sentences, choice_sentences as choice_sentences
from .spectrum import predict_spectrum as predict_spectrum
