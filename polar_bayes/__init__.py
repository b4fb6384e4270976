"""Calibrated posteriors of layered dielectrics from polarization captures.

Names are loaded when they are first used: `import polar_bayes` starts no array library, and
reading a capture does not load a sampler.
"""

import contextlib
import importlib
import random
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

_HOMES = {
    "benchmark.accuracy": ("accuracy", "holds_accuracy", "load_accuracy"),
    "benchmark.advice": ("accuracy_advice", "accuracy_table"),
    "benchmark.reference": ("Reference",),
    "benchmark.run": ("DrawsDial", "EffectsDial", "FacetsDial", "PrecisionDial"),
    "calibration.calibrate": ("calibrate",),
    "calibration.files": ("holds_calibration", "load_calibration"),
    "calibration.predictive": ("calibration_readings",),
    "calibration.replicates": ("proxy_coverage", "proxy_scores", "retest"),
    "calibration.scores": ("is_calibrated",),
    "calibration.verdict": (
        "calibration_table",
        "calibration_verdict",
        "compare_calibrations",
        "comparison_sentences",
    ),
    "capture.combine": ("combine",),
    "capture.files": ("load_capture", "save_capture"),
    "capture.schema": ("count", "validate"),
    "design.candidates": ("Rig",),
    "design.criteria": ("AOptimal", "DOptimal", "SingleParameter"),
    "design.identify": ("identifiability_sentences", "identifiability_table", "identify"),
    "design.next_views": ("next_views", "next_views_sentences", "next_views_table"),
    "design.profile": ("profile", "profile_sentences", "profile_table"),
    "diagnostics.compare": ("FitComparison", "compare_fits", "stack_readings"),
    "diagnostics.convergence": ("json_summary", "summary", "verdict"),
    "diagnostics.coverage": ("map_coverage",),
    "diagnostics.population": ("population_summary",),
    "effects.choose": (
        "ChosenScene",
        "choose_effects",
        "ledger_sentence",
        "ledger_summary",
        "ledger_table",
    ),
    "errors": ("CaptureError", "FitError", "OutputError", "PolarBayesError", "SceneError"),
    "importers.camera_geometry": ("Direction", "Highlight", "Position", "Surroundings"),
    "importers.detector": ("Detector",),
    "importers.goniometer": ("from_goniometer",),
    "importers.images": ("from_mosaic", "from_polarizer"),
    "importers.normals": ("NormalMap", "Sphere", "Spheres", "fit_sphere"),
    "importers.table": ("from_table",),
    "inference.auto": ("Auto", "auto_sentences"),
    "inference.batch_fit": ("PixelLaplace",),
    "inference.batch_nuts": ("PixelNuts",),
    "inference.files": ("load_result", "save_result"),
    "inference.fit": ("fit",),
    "inference.methods": ("STUDY_METHODS",),
    "inference.mode_methods": ("Laplace", "Nuts", "Point"),
    "inference.smc": ("PixelTempering",),
    "inference.spectrum": ("predict_spectrum",),
    "inference.variational": ("FlowGuide", "NormalGuide"),
    "inference.weighted": ("Importance", "Tempered"),
    "maps.fit_map": ("count_pixels", "fit_pixels"),
    "maps.lazy": ("open_capture", "open_map"),
    "maps.store": ("map_file",),
    "models.gp_spectral": ("GpSpectral",),
    "models.hierarchical": ("Hierarchical",),
    "models.spectral_process": ("SpectralProcess",),
    "observation.links": (
        "BetaLink",
        "ConcentrationSchedule",
        "LogitNormalLink",
        "NormalLink",
        "ScaleSchedule",
        "StokesLink",
        "StudentTLink",
    ),
    "physics.coat": ("ClearCoat", "CoatStack", "ThinFilm"),
    "physics.discrepancy": ("Discrepancy",),
    "physics.dispersion": ("Cauchy", "Sellmeier"),
    "physics.facets": ("FacetQuadrature",),
    "physics.geometry": ("Geometry",),
    "physics.illumination": ("Disc", "PointSource", "UniformSky"),
    "physics.instrument": (
        "Analyzer",
        "AngleZero",
        "BeamOverlap",
        "ChannelGain",
        "DarkLevel",
        "DolpGain",
        "Instrument",
        "Leakage",
        "Saturation",
        "TiltedNormal",
    ),
    "physics.microfacet": (
        "AnisotropicSlopes",
        "Beckmann",
        "GGX",
        "HeightCorrelatedShadowing",
        "IsotropicSlopes",
        "NoShadowing",
        "SeparableShadowing",
    ),
    "physics.mixing": ("DopMixing", "StokesMixing"),
    "physics.scene": ("Scene",),
    "physics.stokes": ("LinearPolarization",),
    "physics.subsurface": ("Depolarizer", "Lambertian", "TurbidMedium", "Unpolarized"),
    "physics.surface": (
        "InternalReflection",
        "RoughExit",
        "RoughSurface",
        "SmoothExit",
        "SmoothSurface",
    ),
    "prior_table": ("prior_table",),
    "priors": ("PRIORS",),
    "reporting.accuracy": ("plot_accuracy",),
    "reporting.comparison": ("comparison_of_fits_sentences", "plot_comparison"),
    "reporting.maps": ("plot_maps",),
    "reporting.plots_calibration": ("plot_calibration",),
    "reporting.plots_fit": (
        "plot_pairs",
        "plot_pit",
        "plot_prior_posterior",
        "plot_ranks",
        "plot_shrinkage",
    ),
    "reporting.plots_observations": ("plot_readings", "plot_residuals"),
    "reporting.plots_spectrum": ("plot_spectrum",),
    "reporting.report": ("report",),
    "reporting.show": ("show",),
    "setups": ("SETUPS", "Setup"),
    "simulate": ("Material", "PRESETS", "Protocol", "simulate"),
}
_MODULE_OF = {name: module for module, names in _HOMES.items() for name in names}

__all__ = sorted(_MODULE_OF)

if TYPE_CHECKING:
    from polar_bayes.inference.fit import fit as fit


def __getattr__(name: str) -> Any:
    """Load a public name from its home (PEP 562)."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'polar_bayes' has no attribute {name!r}")
    _force_numpyro_import()
    with _random_state_of_the_caller():
        value = getattr(importlib.import_module(f"polar_bayes.{_MODULE_OF[name]}"), name)
    globals()[name] = value
    return value


@contextlib.contextmanager
def _random_state_of_the_caller() -> Iterator[None]:
    """Undo what JAX (`numpy.random`) and Rich (`random`) draw from global states when imported."""
    numpy_random = sys.modules.get("numpy.random")  # not there: nobody has seeded it
    state = random.getstate()
    numpy_state = None if numpy_random is None else numpy_random.get_state(legacy=False)
    try:
        yield
    finally:
        random.setstate(state)
        if numpy_random is not None:
            numpy_random.set_state(numpy_state)


def _force_numpyro_import() -> None:
    """Load NumPyro for real where ArviZ was imported first.

    ArviZ leaves a lazy stand-in for it; `import numpyro.infer` on a stand-in runs NumPyro twice,
    and its modules no longer find each other. Looking at any attribute loads it once.
    """
    stand_in = sys.modules.get("numpyro")
    if stand_in is not None:
        stand_in.__path__  # noqa: B018


def __dir__() -> list[str]:
    return __all__


_force_numpyro_import()
