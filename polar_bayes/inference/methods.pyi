from .auto import (
    STUDY_METHODS as STUDY_METHODS,
    Auto as Auto,
)
from .batch_importance import PixelImportance as PixelImportance
from .batch_laplace import PixelLaplace as PixelLaplace
from .batch_nuts import PixelNuts as PixelNuts
from .batch_one_by_one import PixelByPixel as PixelByPixel
from .laplace import (
    Importance as Importance,
    Laplace as Laplace,
)
from .least_squares import Point as Point
from .nuts import Nuts as Nuts
from .smc import (
    PixelSMC as PixelSMC,
    Tempered as Tempered,
)
from .variational import (
    FlowGuide as FlowGuide,
    NormalGuide as NormalGuide,
)
