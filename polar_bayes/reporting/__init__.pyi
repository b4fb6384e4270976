from . import plots as plots
from .report import report as report
from .report import show as show
from .text import comparison_of_fits_sentences as comparison_of_fits_sentences
