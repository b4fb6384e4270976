from .fit_map import fit_pixels as fit_pixels
from .lazy import (
    count_criticism as count_criticism,
    count_pixels as count_pixels,
    criticism_sentences as criticism_sentences,
    open_capture as open_capture,
    open_map as open_map,
    setup_sentences as setup_sentences,
    setup_shares as setup_shares,
    shared_cautions as shared_cautions,
    shared_parameters as shared_parameters,
    start_sentences as start_sentences,
)
from .regions import (
    load_labels as load_labels,
    region_means as region_means,
    region_table as region_table,
)
from .smoothing import smooth as smooth
from .store import map_file as map_file
