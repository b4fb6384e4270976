from .auto import Auto as Auto
from .corrected_laplace import CorrectedLaplace as CorrectedLaplace
from .importance import Importance as Importance
from .laplace import Laplace as Laplace
from .least_squares import Point as Point
from .nuts import Nuts as Nuts
from .registry import METHODS as METHODS
from .study import STUDY_METHODS as STUDY_METHODS
