r"""Comparisons of a fit: without instrument terms, and with alternative parts.

The comparisons without terms of an instrument hold these at the values where they change nothing.

A fit rests on parts that nobody has measured, such as a distribution of slopes. For each part that
names an alternative (`Part.alternatives`) the posterior of the scene with that one is found near
the modes of the fit, and both are compared by Laplace's approximation of the evidence,

$$ \log p(y \mid M) = \log \sum_k p(y, \hat z_k \mid M) \, (2\pi)^{d/2} \, |H_k|^{-1/2} $$

over the modes $\hat z_k$, with $H_k$ the Hessian of the potential and d the number of coordinates.

Source: Tierney & Kadane (1986), J. Am. Stat. Assoc. 81, 82; Kass & Raftery (1995), J. Am. Stat.
Assoc. 90, 773 (Bayes factors).
"""

import contextlib
import dataclasses
import functools
import itertools
import math
from collections.abc import Collection, Mapping
from types import MappingProxyType

import jax
import numpy as np
import xarray as xr
from jaxtyping import Array, ArrayLike

from polar_bayes.diagnostics.alternatives import NOTHING
from polar_bayes.errors import FitError, SceneError
from polar_bayes.inference.initialization import HEAVY_MODE, JointInit
from polar_bayes.inference.problem import Problem, compile_request, make_problem
from polar_bayes.inference.program import Values, from_prior
from polar_bayes.inference.request import Request
from polar_bayes.inference.result import Provenance, posterior_of
from polar_bayes.methods.method import AbstractMethod
from polar_bayes.numerics.compile import OutOfTimeError, run_until
from polar_bayes.numerics.mcse import SMALLEST_ESS
from polar_bayes.numerics.optimize import (
    DifferencedPotential,
    Modes,
    ValueAndGradient,
    by_likelihood,
    find_modes,
    symmetrize,
)
from polar_bayes.physics.instrument import AbstractInstrumentTerm, Discrepancy
from polar_bayes.physics.part import ABSENT
from polar_bayes.physics.scene import Scene
from polar_bayes.physics.surface import SmoothSurface
from polar_bayes.physics.variants import Effect, alternatives_of
from polar_bayes.priors import INDICES, resolve_priors
from polar_bayes.progress import Progress

OTHER_STARTS, OTHER_SEARCHES = 100, 4
"""Prior draws of parameters that only an alternative has; number of searches from the likeliest."""

INDICES_UNDER: Mapping[str, tuple[tuple[float, float], ...]] = MappingProxyType(
    {"water film": ((1.333, 1.42),), "thin film": ((0.0, 1.4), (1.65, math.inf))}
)
"""Ranges of the index that a bare scene finds under a layer; the layer is compared only there.
Bodies of index 1.33 to 1.8 give these values under water. Few solids have an index below 1.4 or
above 1.65, but films produce such values."""
SLACK = 1.5
"""Distance beyond these ranges, in posterior sds, at which a layer is still compared."""

NEAR = 3.0
"""Distance from the value at which a part sends nothing, in posterior sds, up to which the scene
without that part is compared."""

STOPPED = "it was stopped before it was done"
"""Reason for a missing comparison that the user interrupted."""


# --- The same scene without terms of its instrument -----------------------------------------------


def removed_terms(request: Request) -> dict[str, list[AbstractInstrumentTerm]]:
    """Return the instrument terms that each comparison fit omits, by its name."""
    terms = request.scene.terms
    if not request.scene.has(Discrepancy):
        return {}
    return {
        "without_discrepancy": [each for each in terms if isinstance(each, Discrepancy)],
        "without_instrument": list(terms),
    }


def fit_comparisons(
    removed: Mapping[str, list[AbstractInstrumentTerm]],
    request: Request,
    problem: Problem,
    methods: tuple[AbstractMethod, ...],
    deadline: float,
    key: Array,
    progress: Progress,
) -> tuple[dict[str, xr.Dataset], dict[str, str]]:
    """Fit the capture with less of the instrument; return posteriors and failures."""
    found: dict[str, xr.Dataset] = {}
    failed: dict[str, str] = {}

    def compare(progress: Progress) -> None:
        for number, (name, terms) in enumerate(removed.items()):
            done = number / len(removed)
            progress("comparing", done)
            try:
                other, gone = _without(request, problem, terms)
                z = _first_trusted(
                    methods, other, key, lambda *_, done=done: progress("comparing", done)
                )
                values = other.constrain(z)
                kept = {name: x for name, x in values.items() if name not in gone}
                found[name] = posterior_of(other.program, kept)
            except FitError as error:  # a failed comparison must not cost the user the fit
                failed[name] = str(error)

    late = ""
    try:
        run_until(deadline, progress, compare)
        progress("comparing", 1.0)
    except OutOfTimeError as error:
        late = str(error)
    except KeyboardInterrupt:  # who does not wait for it keeps the fit
        late = STOPPED
    done = dict(found)  # an abandoned thread may still write to its own
    return done, {name: late for name in removed if late and name not in done} | failed


def _first_trusted(
    methods: tuple[AbstractMethod, ...], problem: Problem, key: Array, progress: Progress
) -> np.ndarray:
    """Return draws of the first method that finds them reliable, or of the last."""
    for method in methods[:-1]:
        with contextlib.suppress(FitError):
            draws = method.run(problem, key, progress)
            if not draws.doubts and draws.ess >= 0.5 * SMALLEST_ESS:
                return draws.z
    return methods[-1].run(problem, key, progress).z


def _without(
    request: Request, problem: Problem, terms: list[AbstractInstrumentTerm]
) -> tuple[Problem, set[str]]:
    """Return the problem without instrument terms, and the parameters that it lacks."""
    gone = {name for term in terms for name in term.parameters}
    neutral = {name: value for term in terms for name, value in term.neutral.items()}
    is_neutral = all(term.neutral or not term.parameters for term in terms)
    # A model of the user's own may know some of them, or sample none.
    if is_neutral and problem.data.held and neutral.keys() <= problem.data.held.keys():
        return problem.hold(neutral), gone
    scene = request.scene
    for term in terms:
        scene = scene.without(type(term))
    return make_problem(dataclasses.replace(request, scene=scene), problem.key), gone


# --- Other parts ----------------------------------------------------------------------------------


def try_alternatives(
    request: Request,
    problem: Problem,
    posterior: Values,
    key: Array,
    progress: Progress,
    *,
    deadline: float = math.inf,
    compared: Collection[Scene] = (),
) -> Provenance:
    """Entries of the provenance: the comparison with alternative parts, or why there is none."""
    compare = functools.partial(compare_alternatives, request, problem, posterior, key, compared)
    try:
        return {"alternatives": run_until(deadline, progress, compare)}
    except (FitError, OutOfTimeError) as error:
        return {"alternatives_failed": str(error)}
    except KeyboardInterrupt:  # who does not wait for it keeps the fit
        return {"alternatives_failed": STOPPED}


def suits_index(layer: str, index: ArrayLike | None) -> bool:
    """Return whether index draws of a bare scene, (chain, draw, ...), suggest a layer."""
    if index is None:
        return False
    draws = np.asarray(index)
    mean, sd = draws.mean(axis=(0, 1)), draws.std(axis=(0, 1))
    within = [
        (mean > low - SLACK * sd) & (mean < high + SLACK * sd)
        for low, high in INDICES_UNDER.get(layer, ((0.0, math.inf),))
    ]
    return bool(np.any(within))


def suits_absence(field: str, posterior: Values) -> bool:
    """Return whether draws allow that the part of a field of the scene sends nothing."""
    for name, absent in ABSENT.items():
        if absent.part == field and name in posterior:
            distance = np.abs(np.asarray(posterior[name]) - absent.value)
            if np.any(distance.mean(axis=(0, 1)) < NEAR * distance.std(axis=(0, 1))):
                return True
    return False


def _called_for(request: Request, posterior: Values) -> list[Effect]:
    """Return the alternatives that the posterior does not exclude."""
    # A thin film on facets takes as long to search as the fit itself; `compare_scenes` tries it.
    is_smooth = isinstance(request.scene.surface, SmoothSurface)
    fringes = is_smooth and "wavelength" in request.capture.coords
    index = posterior.get("refractive_index")
    return [
        each
        for each in alternatives_of(request.scene, has_wavelength=fringes)
        if (each.part is not None or suits_index(each.name, index))
        and (each.replacement is not None or suits_absence(str(each.key_path[0]), posterior))
    ]


def compare_alternatives(
    request: Request,
    problem: Problem,
    posterior: Values,
    key: Array,
    compared: Collection[Scene],
    progress: Progress,
) -> list[Provenance]:
    """Return log Bayes factor and answer of each alternative in types of JSON.

    `shift` is the difference of the modes in posterior sds, by parameter. Scenes that were compared
    already are left out. A `FitError` where all coordinates together have no modes, as those of
    many patches.
    """
    scenes = {each: each.apply(request.scene) for each in _called_for(request, posterior)}
    alternatives = [each for each, scene in scenes.items() if scene not in compared]
    if not alternatives:
        return []
    found = problem.initialize(progress)
    if not isinstance(found, JointInit):
        raise FitError(
            "patches have modes of their own, which give no evidence of the whole",
            where="alternatives",
            hint="fit one patch alone",
        )
    evidence, heaviest = _log_evidence(found.potential, found.modes), found.modes.z[None, :1]
    values = {name: np.asarray(x)[0, 0] for name, x in problem.constrain(heaviest).items()}
    names = values.keys() & posterior.keys()
    sd = {name: np.std(np.asarray(posterior[name]), axis=(0, 1)) for name in names}
    rows = []
    for number, alternative in enumerate(alternatives):
        progress("comparing alternatives", number / len(alternatives))
        row: Provenance = {
            "part": NOTHING if alternative.part is None else type(alternative.part).__name__,
            "alternative": _name_of(alternative),
            "path": alternative.path,
            "defines": [] if alternative.part is None else list(alternative.part.defines),
        }
        try:
            with jax.enable_x64(True):  # single precision leaves nothing of a difference
                given = request, problem, found.modes, scenes[alternative], key
                other, starts, covariance = _with_scene(*given)
                modes = find_modes(other, starts, progress, covariance)
                factor = _log_evidence(other, modes) - evidence
                at_mode = other.parameters(modes.z[0])
        except (FitError, SceneError) as error:  # a model of the user's own may not read it
            rows.append(row | {"failed": str(error)})
            continue
        shift = {
            name: np.ravel((at_mode[name] - values[name]) / np.where(own > 0.0, own, 1.0)).tolist()
            for name, own in sd.items()
            if name in at_mode
        }
        if not np.isfinite([factor, *itertools.chain(*shift.values())]).all():
            rows.append(row | {"failed": "its evidence or its mode is not finite"})
            continue
        rows.append(row | {"log_bayes_factor": factor, "shift": shift})
    progress("comparing alternatives", 1.0)
    return rows


def _name_of(alternative: Effect) -> str:
    """Return the class of what takes a place, or the name of a layer."""
    if alternative.replacement is None:
        return NOTHING
    is_layer = alternative.part is None
    return alternative.name if is_layer else type(alternative.replacement).__name__


def _with_scene(
    request: Request, problem: Problem, modes: Modes, scene: Scene, key: Array
) -> tuple[DifferencedPotential, np.ndarray, np.ndarray]:
    """Return the potential of another scene, and guesses of its modes and covariance."""
    new = [name for name in scene.parameters if name not in request.scene.parameters]
    priors = {**resolve_priors(new), **request.priors}
    other = dataclasses.replace(request, scene=scene, priors=priors, precision="double")
    compiled_model, data = compile_request(other)
    program = compiled_model.program
    known = problem.program.positions
    both = [name for name in program.positions if name in known]
    here, there = (np.hstack([of[n].ravel() for n in both]) for of in (program.positions, known))
    heavy = modes.z[modes.weight >= HEAVY_MODE]
    starts, covariance = np.zeros((len(heavy), program.size)), np.eye(program.size)
    starts[:, here] = heavy[:, there]
    covariance[np.ix_(here, here)] = symmetrize(modes.covariance[0])[np.ix_(there, there)]
    covariance[np.diag_indices_from(covariance)] *= 1.0 + 1e-9  # positive definite after rounding
    potential = DifferencedPotential(program.evaluated, data, np.sqrt(np.diagonal(covariance)))
    own = [name for name in program.positions if name not in known]
    if not own:
        return potential, starts, covariance
    # What only the other scene has starts at the median of its prior.
    drawn = from_prior(program, key, OTHER_STARTS, data)
    added = np.hstack([program.positions[name].ravel() for name in own])
    starts[:, added] = np.median(drawn[:, added], axis=0)
    if len(own) > 1:  # fringes have many modes: the likeliest of some draws, the index with them
        indices = [program.positions[name].ravel() for name in both if name in INDICES]
        moved = np.hstack([added, *indices])
        others = np.repeat(starts[:1], OTHER_STARTS, axis=0)
        others[:, moved] = drawn[:, moved]
        starts = np.vstack([starts, others[by_likelihood(potential, others)[:OTHER_SEARCHES]]])
    return potential, starts, covariance


def _log_evidence(potential: ValueAndGradient, modes: Modes) -> float:
    """Return Laplace's approximation of the log evidence, summed over the modes."""
    volume = 0.5 * np.linalg.slogdet(2.0 * math.pi * modes.covariance[0])[1]
    return float(volume - potential(modes.z[0])[0] - math.log(modes.weight[0]))
