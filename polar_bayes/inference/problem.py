"""One capture with its model, compiled: the argument of every method.

All that is compiled belongs to the layout of the capture, and serves the next capture of that
layout; `Problem` adds the readings and the posterior modes that were found for them.
"""

import dataclasses
import time
from collections.abc import Mapping

import jax
import numpy as np
import pandas as pd
from jaxtyping import Array, ArrayLike, Float

from polar_bayes.errors import CaptureError, FitError
from polar_bayes.inference.compiled_model import CompiledModel, compile_model
from polar_bayes.inference.initialization import AbstractInit
from polar_bayes.inference.program import Draw, Program, Values, in_blocks, keys_of_draws
from polar_bayes.inference.request import MIN_VIEWS, Request
from polar_bayes.numerics.compile import TRACING_LOCK
from polar_bayes.observation.data import Observations, observe
from polar_bayes.priors import RANGES, describe_prior, support_bounds
from polar_bayes.progress import Progress, no_progress


@dataclasses.dataclass(frozen=True, eq=False)
class Problem:
    """A posterior to draw from, for one material or for many patches.

    `describe` tells what is estimated; `initialize` finds the modes; `log_density`, `constrain` and
    `predict` are functions of unconstrained vectors.

    Args:
        compiled_model: Programs of the model for the layout of the capture.
        data: The capture.
        key: Random key of the search for modes.
        start_time: When the fit was asked for, on the clock of `time.perf_counter`, unit second;
            time limits count from there.
    """

    compiled_model: CompiledModel
    data: Observations
    key: Array
    start_time: float = dataclasses.field(default_factory=time.perf_counter)
    _searched: list[tuple[AbstractInit, float]] = dataclasses.field(
        default_factory=list, init=False, repr=False
    )
    """What the search for modes has found, once it has, and how long it took."""

    @property
    def program(self) -> Program:
        """The model as functions of one unconstrained vector."""
        return self.compiled_model.program

    @property
    def dtype(self) -> np.dtype:
        """Floating type of the fit."""
        return np.dtype(self.data.brightness.dtype)

    @property
    def search_seconds(self) -> float:
        """Time that the search for modes took; 0 where no method has asked for it."""
        return self._searched[0][1] if self._searched else 0.0

    def initialize(self, progress: Progress = no_progress) -> AbstractInit:
        """Search the posterior modes at the first call, and return the result.

        Args:
            progress: Called with the name of a stage and the fraction of it that is done.

        Returns:
            Modes, starting points and metric.

        Raises:
            FitError: No start reached a mode.
        """
        if not self._searched:
            begun = time.perf_counter()
            found = self.compiled_model.initializer.find(self.data, self.key, progress)
            self._searched.append((found, time.perf_counter() - begun))
        return self._searched[0][0]

    def describe(self) -> pd.DataFrame:
        """Describe what is estimated, and from which readings.

        Returns:
            A row for each parameter, derived ones included: its dims and their lengths, how many
            numbers it is, its prior (as text; the family of a distribution that the model itself
            declares; "derived"), and the bounds of the prior in the unit of the parameter. The
            attributes `used` and `measured` count the readings of each variable.
        """
        program, priors = self.program, self.compiled_model.priors
        z = jax.ShapeDtypeStruct((program.size,), self.dtype)
        with TRACING_LOCK:
            shapes = jax.eval_shape(program.parameters, z, self.data)
        rows = {}
        for name, value in shapes.items():
            text = program.families.get(name, "derived")
            low, high = RANGES.get(name, (-np.inf, np.inf))
            if name in priors:
                text, (low, high) = describe_prior(priors[name]), support_bounds(priors[name])
            dims = {dim: program.plates[dim] for dim in program.dims[name]}
            rows[name] = [dims, int(np.prod(value.shape)), text, low, high]
        columns = ["dims", "size", "prior", "low", "high"]
        table = pd.DataFrame.from_dict(rows, orient="index", columns=columns)
        data = jax.device_get(self.data)  # on the host, where nothing compiles
        fitted = {n: data.fitted(n)[..., data.measured] for n in program.observed}
        table.attrs["used"] = {name: int(np.sum(each)) for name, each in fitted.items()}
        table.attrs["measured"] = {name: each.size for name, each in fitted.items()}
        return table

    def log_density(
        self, z: Float[np.ndarray, "draw size"], data: Observations | None = None
    ) -> Float[np.ndarray, " draw"]:
        """Return the log posterior density of unconstrained vectors, up to a constant.

        Args:
            z: Unconstrained vectors, shape (draw, size).
            data: Another capture of this layout; by default that of the problem.

        Returns:
            Log densities, shape (draw,); minus infinity where there is none.
        """
        return self.program.log_density(z.astype(self.dtype), self.data if data is None else data)

    def constrain(self, z: Float[np.ndarray, "chain draw size"]) -> Values:
        """Transform draws to parameters in their supports.

        Args:
            z: Unconstrained vectors, shape (chain, draw, size).

        Returns:
            Arrays of shape (chain, draw, ...), by name.
        """
        each = z.reshape(-1, 1, self.program.size).astype(self.dtype)  # a chain of one draw
        found = in_blocks(self.program.parameters_of_chains, (each,), self.data)
        return {name: x.reshape(*z.shape[:2], *x.shape[2:]) for name, x in found.items()}

    def hold(self, values: Mapping[str, ArrayLike]) -> "Problem":
        """Return the problem with some parameters fixed to values; nothing is compiled.

        Args:
            values: By latent site, in its support or at the end of it; NaN where an entry is to be
                estimated. What is held has a coordinate still, whose density is a standard normal
                one.

        Returns:
            The problem whose density is that of the other parameters given these.

        Raises:
            FitError: No latent site has such a name or shape, only some entries of one density are
                given, or captures of this layout hold nothing.
        """
        held = dict(self.data.held)
        for name, value in values.items():
            where = f"hold: {name}"
            if name not in held:
                hint = f"give some of {', '.join(held)}" if held else "fit one patch alone"
                raise FitError("it cannot be held", where=where, hint=hint)
            shape, given = held[name].shape, np.asarray(value, self.dtype)
            if given.shape not in ((), shape):
                hint = f"give one of {shape}"
                raise FitError(f"its shape is {given.shape}", where=where, hint=hint)
            if self.program.events[name] and len(set(np.isnan(given).flat)) > 1:
                raise FitError("its entries have one density", where=where, hint="hold all or none")
            held[name] = jax.device_put(np.broadcast_to(given, shape))
        return dataclasses.replace(self, data=dataclasses.replace(self.data, held=held))

    def prepare_search(self) -> None:
        """Begin to compile what `initialize` needs, in another thread."""
        self.compiled_model.initializer.prepare(self.data)

    def prepare_predictions(self) -> None:
        """Begin to compile what `predict` needs, in another thread."""
        self.program.begin_described(self.data)

    def predict(self, key: Array, z: Float[np.ndarray, "chain draw size"]) -> Draw:
        """Return parameters, densities and predicted readings of draws.

        Args:
            key: Random key of the predicted readings.
            z: Unconstrained vectors, shape (chain, draw, size).

        Returns:
            Arrays of shape (chain, draw, ...), by group and name.
        """
        flat = z.reshape(-1, self.program.size).astype(self.dtype)
        keys = keys_of_draws(key, len(flat))
        found = in_blocks(self.program.described, (keys, np.ones(len(flat), bool), flat), self.data)
        return jax.tree.map(lambda x: x.reshape(*z.shape[:2], *x.shape[1:]), found)


def observe_request(request: Request, *, padded: bool = False) -> Observations:
    """Return the capture of a request as arrays in its precision.

    A `CaptureError` where too few views are left, since a saturated one does not count without its
    intensity.
    """
    limit = request.largest_view_zenith
    data = observe(
        request.capture, largest_view_zenith=limit, padded=padded, described=request.links
    )
    valid = np.asarray(data.valid)  # on the host, where nothing compiles
    left = int(np.any(valid, axis=tuple(range(valid.ndim - 1))).sum())
    if left < MIN_VIEWS:
        raise CaptureError(
            f"only {left} of its views are not saturated, and no link describes the intensity",
            where=f"{request.capture.attrs.get('name', 'capture')}: view",
            hint="expose shorter, or fit the intensity, too",
        )
    return data.in_single_precision() if request.precision == "single" else data


def compile_request(request: Request) -> tuple[CompiledModel, Observations]:
    """The compiled model of a request, from the cache, and its capture."""
    data = observe_request(request, padded=request.is_padded)
    compiled_model = compile_model(request, data)
    return compiled_model, compiled_model.free(data)


def make_problem(request: Request, key: Array, start_time: float | None = None) -> Problem:
    """Make the problem of a request; only a new layout is compiled."""
    begun = time.perf_counter() if start_time is None else start_time
    return Problem(*compile_request(request), key, begun)
