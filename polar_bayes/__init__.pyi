"""The names of `polar_bayes`; each is loaded when it is first used."""

from . import benchmark as benchmark
from . import calibration as calibration
from . import capture as capture
from . import design as design
from . import diagnostics as diagnostics
from . import importers as importers
from . import inference as inference
from . import maps as maps
from . import methods as methods
from . import models as models  # type: ignore[attr-defined]
from . import physics as physics
from . import reporting as reporting
from . import scenes as scenes
from . import setups as setups
from . import simulation as simulation
from .benchmark.accuracy import accuracy as accuracy
from .calibration.calibrate import calibrate as calibrate
from .capture.files import (
    load_capture as load_capture,
    save_capture as save_capture,
)
from .design.identify import identify as identify
from .design.next_views import next_views as next_views
from .design.profile import profile as profile
from .diagnostics.budget import budget as budget
from .errors import (
    CaptureError as CaptureError,
    FitError as FitError,
    OutputError as OutputError,
    PolarBayesError as PolarBayesError,
    SceneError as SceneError,
)
from .importers.ellipsometer import from_ellipsometer as from_ellipsometer
from .importers.goniometer import from_goniometer as from_goniometer
from .importers.images import (
    from_mosaic as from_mosaic,
    from_polarizer as from_polarizer,
)
from .importers.table import from_table as from_table
from .maps.fit_map import fit_pixels as fit_pixels
from .observation import links as links
from .physics import input_quantities as input_quantities
from .physics import instrument as instrument
from .physics.coat import (
    ClearCoat as ClearCoat,
    ThinFilm as ThinFilm,
)
from .physics.geometry import Geometry as Geometry
from .physics.illumination import (
    Disc as Disc,
    PointSource as PointSource,
    UniformSky as UniformSky,
)
from .physics.microfacet import (
    Beckmann as Beckmann,
    GGX as GGX,
)
from .physics.mixing import (
    DopMixing as DopMixing,
    StokesMixing as StokesMixing,
)
from .physics.scene import Scene as Scene
from .physics.subsurface import (
    Depolarizer as Depolarizer,
    Lambertian as Lambertian,
    TurbidMedium as TurbidMedium,
    Unpolarized as Unpolarized,
)
from .physics.surface import (
    RoughSurface as RoughSurface,
    SmoothSurface as SmoothSurface,
)
from .priors import PRIORS as PRIORS
from .reporting import plots as plots
from .reporting.explore import explore as explore
from .reporting.plots import plot as plot
from .reporting.report import report as report
from .reporting.report import show as show
from .results import (
    load as load,
    save as save,
    summary as summary,
    verdict as verdict,
)
from .scenes.comparison import compare_scenes as compare_scenes
from .scenes.effects import choose_effects as choose_effects
from .scenes.fitting import fit as fit
from .scenes.scene_file import (
    load_scene as load_scene,
    save_scene as save_scene,
)
from .simulation import simulate as simulate

__version__: str
