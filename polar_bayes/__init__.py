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
    "budget.accuracy": ("accuracy",),
    "budget.accuracy_files": ("holds_accuracy", "load_accuracy"),
    "budget.advice": ("accuracy_advice", "accuracy_table"),
    "budget.dials": ("DrawsDial", "EffectsDial", "FacetsDial", "PrecisionDial"),
    "budget.effects": ("ChosenScene", "choose_effects"),
    "budget.ledger": ("ledger_sentence", "ledger_summary", "ledger_table"),
    "budget.reference": ("Reference",),
    "calibration.calibrate": ("calibrate",),
    "calibration.compare": ("compare_calibrations", "comparison_sentences"),
    "calibration.files": ("holds_calibration", "load_calibration"),
    "calibration.joint": ("is_calibrated",),
    "calibration.prediction": ("calibration_readings",),
    "calibration.retest": ("proxy_coverage", "proxy_scores", "retest"),
    "calibration.verdict": ("calibration_table", "calibration_verdict"),
    "capture.combine": ("combine",),
    "capture.detector": ("Detector",),
    "capture.files": ("load_capture", "save_capture"),
    "capture.goniometer": ("from_goniometer",),
    "capture.listed": ("from_table",),
    "capture.mosaic": ("from_mosaic",),
    "capture.places": ("Direction", "Highlight", "Position", "Surroundings"),
    "capture.polarizer": ("from_polarizer",),
    "capture.schema": ("count", "validate"),
    "capture.shapes": ("NormalMap", "Sphere", "Spheres", "fit_sphere"),
    "diagnostics.compare_fits": ("FitComparison", "compare_fits"),
    "diagnostics.convergence": ("json_summary", "summary", "verdict"),
    "diagnostics.coverage": ("map_coverage",),
    "diagnostics.population": ("population_summary",),
    "diagnostics.stacking": ("stack_readings",),
    "errors": ("CaptureError", "FitError", "OutputError", "PolarBayesError", "SceneError"),
    "identifiability.criteria": ("AOptimal", "DOptimal", "SingleParameter"),
    "identifiability.identify": ("identify",),
    "identifiability.profile": ("profile",),
    "identifiability.profile_words": ("profile_sentences", "profile_table"),
    "identifiability.rig": ("Rig",),
    "identifiability.view_words": ("next_views_sentences", "next_views_table"),
    "identifiability.views": ("next_views",),
    "identifiability.words": ("identifiability_sentences", "identifiability_table"),
    "inference.files": ("load_result", "save_result"),
    "inference.laplace": ("Laplace",),
    "inference.nuts": ("Nuts",),
    "inference.point": ("Point",),
    "inference.spectrum": ("predict_spectrum",),
    "ladder.auto": ("Auto",),
    "ladder.fit": ("fit",),
    "ladder.rungs": ("LADDER",),
    "ladder.importance": ("Importance",),
    "ladder.tempered": ("Tempered",),
    "ladder.variational": ("FlowGuide", "NormalGuide"),
    "ladder.words": ("auto_sentences",),
    "models.gp_spectral": ("GpSpectral",),
    "models.spectral_process": ("SpectralProcess",),
    "models.hierarchical": ("Hierarchical",),
    "observation.links": (
        "BetaLink",
        "LogitNormalLink",
        "NormalLink",
        "StokesLink",
        "StudentTLink",
    ),
    "observation.noise": ("ConcentrationSchedule", "ScaleSchedule"),
    "physics.coat": ("ClearCoat", "CoatStack", "ThinFilm"),
    "physics.discrepancy": ("Discrepancy",),
    "physics.dispersion": ("Cauchy", "Sellmeier"),
    "physics.exit": ("RoughExit", "SmoothExit"),
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
    ),
    "physics.internal_reflection": ("InternalReflection",),
    "physics.microfacet": ("GGX", "Beckmann"),
    "physics.mixing": ("DopMixing", "StokesMixing"),
    "physics.polarization": ("LinearPolarization",),
    "physics.scene": ("Scene",),
    "physics.shadowing": ("HeightCorrelatedShadowing", "NoShadowing", "SeparableShadowing"),
    "physics.slopes": ("AnisotropicSlopes", "IsotropicSlopes"),
    "physics.subsurface": ("Depolarizer", "Lambertian", "Unpolarized"),
    "physics.surface": ("RoughSurface", "SmoothSurface"),
    "physics.tilt": ("TiltedNormal",),
    "physics.turbid": ("TurbidMedium",),
    "pixels.fitting": ("PixelLaplace",),
    "pixels.maps": ("count_pixels", "fit_pixels"),
    "pixels.opening": ("open_capture", "open_map"),
    "pixels.sampling": ("PixelNuts",),
    "pixels.store": ("map_file",),
    "pixels.tempering": ("PixelTempering",),
    "priors": ("PRIORS",),
    "priors.listing": ("prior_table",),
    "reporting.accuracy": ("plot_accuracy",),
    "reporting.calibration": ("plot_calibration",),
    "reporting.comparison": ("plot_comparison",),
    "reporting.comparison_page": ("comparison_of_fits_sentences",),
    "reporting.figures": ("plot_pairs", "plot_pit", "plot_prior_posterior", "plot_ranks"),
    "reporting.html": ("report",),
    "reporting.maps": ("plot_maps",),
    "reporting.population": ("plot_shrinkage",),
    "reporting.readings": ("plot_readings", "plot_residuals"),
    "reporting.show": ("show",),
    "reporting.spectrum": ("plot_spectrum",),
    "setups": ("SETUPS", "Setup"),
    "simulation.presets": ("PRESETS", "Material"),
    "simulation.protocol": ("Protocol",),
    "simulation.simulate": ("simulate",),
}
_MODULE_OF = {name: module for module, names in _HOMES.items() for name in names}

__all__ = sorted(_MODULE_OF)

if TYPE_CHECKING:
    from polar_bayes.ladder.fit import fit as fit


def __getattr__(name: str) -> Any:
    """Load a public name from its home (PEP 562)."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'polar_bayes' has no attribute {name!r}")
    _wake_numpyro()
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


def _wake_numpyro() -> None:
    """Load NumPyro for real where ArviZ was imported first.

    ArviZ leaves a lazy stand-in for it; `import numpyro.infer` on a stand-in runs NumPyro twice,
    and its modules no longer find each other. Looking at any attribute loads it once.
    """
    stand_in = sys.modules.get("numpyro")
    if stand_in is not None:
        stand_in.__path__  # noqa: B018


def __dir__() -> list[str]:
    return __all__


_wake_numpyro()
