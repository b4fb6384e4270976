from .fit_map import fit_pixels as fit_pixels
from .lazy import (
    count_pixels as count_pixels,
    open_capture as open_capture,
    open_map as open_map,
)
from .store import map_file as map_file
