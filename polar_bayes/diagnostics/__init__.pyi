from .alternatives import alternatives as alternatives
from .compare import (
    compare_fits as compare_fits,
    FitComparison as FitComparison,
    stack_readings as stack_readings,
)
from .convergence import json_summary as json_summary
from .coverage import map_coverage as map_coverage
from .criticism import criticize as criticize
from .population import population_summary as population_summary
