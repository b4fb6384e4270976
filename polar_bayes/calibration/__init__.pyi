from .calibrate import calibrate as calibrate
from .files import (
    holds_calibration as holds_calibration,
    load_calibration as load_calibration,
)
from .replicates import (
    proxy_coverage as proxy_coverage,
    proxy_scores as proxy_scores,
    retest as retest,
)
from .scores import is_calibrated as is_calibrated
from .verdict import (
    calibration_readings as calibration_readings,
    calibration_table as calibration_table,
    calibration_verdict as calibration_verdict,
    compare_calibrations as compare_calibrations,
    comparison_sentences as comparison_sentences,
)
