r"""Alternatives to the parts of a scene: does another one explain the readings, and what changes?

A fit rests on parts that nobody has measured, such as a distribution of slopes. For each part that
names an alternative (`Part.alternatives`) the posterior of the scene with that one is found near
the modes of the fit, and both are compared by Laplace's approximation of the evidence,

$$ \log p(y \mid M) = \log \sum_k p(y, \hat z_k \mid M) \, (2\pi)^{d/2} \, |H_k|^{-1/2} $$

over the modes $\hat z_k$, with $H_k$ the Hessian of the potential and d the number of coordinates.

Source: Tierney & Kadane (1986), J. Am. Stat. Assoc. 81, 82; Kass & Raftery (1995), J. Am. Stat.
Assoc. 90, 773 (Bayes factors).
"""

import dataclasses
import itertools
import math
from collections.abc import Collection

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpyro import distributions as dist

from polar_bayes.errors import FitError
from polar_bayes.inference.initialization import HEAVY_MODE, JointInit
from polar_bayes.inference.problem import Problem, compile_request
from polar_bayes.inference.program import Values
from polar_bayes.inference.request import Request
from polar_bayes.inference.result import Provenance
from polar_bayes.numerics.optimize import (
    DifferencedPotential,
    Modes,
    ValueAndGradient,
    find_modes,
    symmetrize,
)
from polar_bayes.physics.scene import Scene
from polar_bayes.physics.variants import alternatives_of
from polar_bayes.priors import resolve_priors
from polar_bayes.progress import Progress


def compare_alternatives(
    request: Request,
    problem: Problem,
    posterior: Values,
    key: Array,
    progress: Progress,
    compared: Collection[Scene] = (),
) -> list[Provenance]:
    """For each alternative its log Bayes factor and the answer that it gives, as JSON holds it.

    `shift` is the difference of the modes in posterior sds, by parameter. Scenes that were compared
    already are left out. A `FitError` where all coordinates together have no modes, as those of
    many patches.
    """
    scenes = {each: each.apply(request.scene) for each in alternatives_of(request.scene)}
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
    evidence, values = _log_evidence(found.potential, found.modes), _at_mode(problem, found.modes)
    names = values.keys() & posterior.keys()
    sd = {name: np.std(np.asarray(posterior[name]), axis=(0, 1)) for name in names}
    rows = []
    for number, alternative in enumerate(alternatives):
        progress("comparing alternatives", number / len(alternatives))
        row: Provenance = {
            "part": type(alternative.part).__name__,
            "alternative": type(alternative.replacement).__name__,
            "path": alternative.path,
            "defines": list(alternative.part.defines),
        }
        try:
            with jax.enable_x64(True):  # single precision leaves nothing of a difference
                given = request, problem, found.modes, scenes[alternative], key
                other, starts, covariance = _with_scene(*given)
                modes = find_modes(other, starts, progress, covariance)
                factor = _log_evidence(other, modes) - evidence
                at_mode = other.parameters(modes.z[0])
        except FitError as error:
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


def _with_scene(
    request: Request, problem: Problem, modes: Modes, scene: Scene, key: Array
) -> tuple[DifferencedPotential, np.ndarray, np.ndarray]:
    """The potential of another scene, and the modes and the covariance of this one as a guess."""
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
    # What only the other scene has starts at the median of its prior.
    for name in program.positions.keys() - known.keys():
        median = jnp.median(priors[name].sample(key, (101,)), axis=0)
        starts[:, program.positions[name]] = dist.biject_to(program.supports[name]).inv(median)
    potential = DifferencedPotential(program.evaluated, data, np.sqrt(np.diagonal(covariance)))
    return potential, starts, covariance


def _log_evidence(potential: ValueAndGradient, modes: Modes) -> float:
    """Laplace's approximation of the log evidence, summed over the modes."""
    volume = 0.5 * np.linalg.slogdet(2.0 * math.pi * modes.covariance[0])[1]
    return float(volume - potential(modes.z[0])[0] - math.log(modes.weight[0]))


def _at_mode(problem: Problem, modes: Modes) -> dict[str, np.ndarray]:
    """Parameters at the mode of largest weight."""
    found = problem.constrain(modes.z[None, :1])
    return {name: np.asarray(value)[0, 0] for name, value in found.items()}
