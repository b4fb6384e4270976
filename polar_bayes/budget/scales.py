"""The scales on which scenes are weighed: one capture, densities compiled once, one judge."""

import dataclasses
import functools
from collections.abc import Mapping

import jax
import numpy as np
from numpyro import distributions as dist

from polar_bayes.budget.cost import Cost, run_seconds
from polar_bayes.budget.density import Density, Readings, compile_density
from polar_bayes.budget.linearized import Change, Peak, compare, find_peak
from polar_bayes.inference.request import Request
from polar_bayes.inference.story import read_story
from polar_bayes.observation.data import observe
from polar_bayes.physics.scene import Scene
from polar_bayes.priors import PriorTable
from polar_bayes.progress import Progress


@dataclasses.dataclass(frozen=True, eq=False)
class Reference:
    """A scene that others are compared with."""

    peak: Peak
    noise_sd: Readings
    names: tuple[str, ...] | None

    @property
    def judged(self) -> np.ndarray:
        """For each coordinate, whether it is judged."""
        density = self.peak.density
        if self.names is None:
            return np.ones(len(density.labels), bool)
        both = zip(density.labels, density.sites, strict=True)
        return np.asarray([bool({label, site} & set(self.names)) for label, site in both])

    def compare(self, other: Density) -> Change:
        """What changes when another scene takes the place of this one."""
        return compare(self.peak, self.noise_sd, other)[0]

    def beside(self, other: Density) -> "Reference":
        """A similar scene to compare with."""
        return dataclasses.replace(self, peak=compare(self.peak, self.noise_sd, other)[1])

    def size(self, change: Change) -> float:
        """The largest change of a judged parameter; infinite where it is not known."""
        # A parameter that the other scene lacks is not judged, unless the user named it.
        sizes = change.size[self.judged]
        lost = np.isnan(sizes)
        unknown = not change.found or lost.all() or (self.names is not None and lost.any())
        return np.inf if unknown else float(np.nanmax(sizes))

    def says(self, change: Change) -> str:
        """The largest change in words: `refractive_index[550] moves by +0.43 sd`."""
        if not change.found:
            return "its posterior has no peak near that of the full scene"
        sizes = np.where(self.judged, np.nan_to_num(change.size, nan=-1.0), -1.0)
        most = int(np.argmax(sizes))
        if sizes[most] < 0.0:
            return "it leaves nothing to judge"
        label = self.peak.density.labels[most]
        shift, widening = change.shift[most], change.sd_ratio[most] - 1.0
        if abs(shift) >= abs(widening):
            return f"{label} moves by {shift:+.2g} sd"
        return f"the sd of {label} changes by {widening:+.0%}"

    def lost(self, change: Change) -> tuple[str, ...]:
        """Parameters that the other scene does not have."""
        sites = np.asarray(self.peak.density.sites)
        left = set(sites[~np.isnan(change.size)])
        return tuple(name for name in dict.fromkeys(sites.tolist()) if name not in left)


class Scales:
    """Densities of scenes for one capture."""

    def __init__(
        self, request: Request, priors: Mapping[str, dist.Distribution] | None, progress: Progress
    ) -> None:
        self.progress = progress
        self._request, self._priors = request, priors
        self._data = observe(request.capture, largest_view_zenith=request.largest_view_zenith)
        self._densities: dict[Scene, Density] = {}

    def density(self, scene: Scene) -> Density:
        """The density of a scene; a prior for a parameter that it lacks is not used."""
        if scene not in self._densities:
            table = self.priors(scene)
            priors = {name: table.row(name) for name in table.read}
            request = dataclasses.replace(self._request, scene=scene, priors=priors)
            self._densities[scene] = compile_density(request, self._data)
        return self._densities[scene]

    def priors(self, scene: Scene) -> PriorTable:
        """The priors, with a note of which ones the model reads with that scene."""
        table = PriorTable(self._priors)
        read_story(self._request.model, self._data, scene, table, self._request.links)
        return table

    def reference(self, scene: Scene, parameters: tuple[str, ...] | None) -> Reference:
        """A scene to compare with."""
        density = self.density(scene)
        peak = find_peak(density, jax.random.key(self._request.seed), self.progress)
        return Reference(peak, density.noise_sd(peak.z), parameters)

    def costs(self) -> dict[Scene, Cost]:
        """What each scene costs, all timed in turns."""
        calls = [
            functools.partial(density.evaluate, np.zeros(density.program.size))
            for density in self._densities.values()
        ]
        timed = zip(self._densities.items(), run_seconds(calls), strict=True)
        return {
            scene: Cost(density.compiled.operations, density.compiled.compile_seconds, seconds)
            for (scene, density), seconds in timed
        }
