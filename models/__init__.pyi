from .gp_spectral import (
    gp_spectral as gp_spectral,
    GpSpectral as GpSpectral,
)
from .hierarchical import Hierarchical as Hierarchical
from .per_material import per_material as per_material
from .spectral_process import SpectralProcess as SpectralProcess
