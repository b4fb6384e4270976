from . import plots as plots
from .comparison import comparison_of_fits_sentences as comparison_of_fits_sentences
from .report import report as report
from .show import show as show
