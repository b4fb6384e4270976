from . import plots as plots
from .explore import Explorer as Explorer
from .explore import explore as explore
from .report import report as report
from .report import show as show
from .text import comparison_of_fits_sentences as comparison_of_fits_sentences
