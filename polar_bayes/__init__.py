"""Calibrated posteriors of layered dielectrics from polarization captures.

The verbs, `Scene`, `Geometry`, common parts and errors are here; everything else is in the package
of its layer: `physics`, `instrument`, `links`, `methods`, `models`, `importers`, `calibration`,
`design`, `benchmark`, `plots` and others. Names are loaded when they are first used:
`import polar_bayes` starts no array library, and reading a capture does not load a sampler.
"""

import importlib

from polar_bayes.namespace import attach, force_numpyro_import

load_name, __dir__, __all__ = attach(__name__, __file__)


def __getattr__(name: str) -> object:
    if name != "__version__":
        return load_name(name)
    metadata = importlib.import_module("importlib.metadata")  # as slow as all of this module
    return metadata.version("polar_bayes")


force_numpyro_import()
