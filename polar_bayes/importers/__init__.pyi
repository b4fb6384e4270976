from .camera_geometry import (
    Direction as Direction,
    Highlight as Highlight,
    Position as Position,
    Surroundings as Surroundings,
)
from .detector import Detector as Detector
from .ellipsometer import from_ellipsometer as from_ellipsometer
from .goniometer import from_goniometer as from_goniometer
from .images import from_mosaic as from_mosaic, from_polarizer as from_polarizer
from .normals import (
    fit_sphere as fit_sphere,
    NormalMap as NormalMap,
    Sphere as Sphere,
    Spheres as Spheres,
)
from .table import from_table as from_table
