from . import input_quantities as input_quantities
from . import instrument as instrument
from .coat import (
    AbstractCoat as AbstractCoat,
    BackFace as BackFace,
    ClearCoat as ClearCoat,
    CoatStack as CoatStack,
    ThinFilm as ThinFilm,
)
from .dispersion import (
    AbstractDispersion as AbstractDispersion,
    Cauchy as Cauchy,
    Sellmeier as Sellmeier,
)
from .facets import FacetQuadrature as FacetQuadrature
from .geometry import Geometry as Geometry
from .illumination import (
    AbstractIllumination as AbstractIllumination,
    Disc as Disc,
    PointSource as PointSource,
    SunAndSky as SunAndSky,
    UniformSky as UniformSky,
)
from .microfacet import (
    AbstractMicrofacet as AbstractMicrofacet,
    AbstractShadowing as AbstractShadowing,
    AbstractSlopes as AbstractSlopes,
    AnisotropicSlopes as AnisotropicSlopes,
    Beckmann as Beckmann,
    GGX as GGX,
    HeightCorrelatedShadowing as HeightCorrelatedShadowing,
    IsotropicSlopes as IsotropicSlopes,
    NoShadowing as NoShadowing,
    SeparableShadowing as SeparableShadowing,
)
from .mixing import (
    AbstractMixing as AbstractMixing,
    DopMixing as DopMixing,
    StokesMixing as StokesMixing,
)
from .part import Part as Part
from .phase_function import (
    AbstractPhaseFunction as AbstractPhaseFunction,
    HenyeyGreenstein as HenyeyGreenstein,
    Isotropic as Isotropic,
)
from .scene import Scene as Scene
from .second_bounce import TwoBounceSurface as TwoBounceSurface
from .second_passage import TwoFacetPassage as TwoFacetPassage
from .stokes import LinearPolarization as LinearPolarization
from .subsurface import (
    AbstractSubsurface as AbstractSubsurface,
    Depolarizer as Depolarizer,
    Lambertian as Lambertian,
    TurbidMedium as TurbidMedium,
    Unpolarized as Unpolarized,
)
from .surface import (
    AbstractExit as AbstractExit,
    AbstractSurface as AbstractSurface,
    InternalReflection as InternalReflection,
    RoughExit as RoughExit,
    RoughPassage as RoughPassage,
    RoughSurface as RoughSurface,
    SmoothExit as SmoothExit,
    SmoothSurface as SmoothSurface,
)
