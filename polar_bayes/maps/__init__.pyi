from .fit_map import count_pixels as count_pixels, fit_pixels as fit_pixels
from .lazy import open_capture as open_capture, open_map as open_map
from .store import map_file as map_file
