"""Ours for maps and calibrations: weighted draws of one pixel, from the prior in small steps."""

import functools
from collections.abc import Iterator

import numpy as np
from posterior import AbstractPeer, Round

import polar_bayes as pb
from polar_bayes.inference.batch_engine import BatchEngine, make_engine
from polar_bayes.inference.batching import ObservationBatch, batch_pixels
from polar_bayes.inference.program import Values
from polar_bayes.observation.data import observe

SETTINGS = pb.methods.PixelSMC(effective_draws=400.0)


class Peer(AbstractPeer):
    packages = ("polar_bayes",)

    @functools.cached_property
    def _engine(self) -> BatchEngine:
        of_one = self.posterior
        return make_engine("one material", of_one.request, lambda: of_one.data)

    @functools.cached_property
    def _pixels(self) -> ObservationBatch:
        image = self.posterior.request.capture.expand_dims(("y", "x"))
        return batch_pixels(
            observe(image, largest_view_zenith=self.posterior.request.largest_view_zenith)
        )

    def rounds(self, seed: int) -> Iterator[Round]:
        told: list[tuple[Values, np.ndarray]] = []

        def describe(_: np.ndarray, parameters: Values, weights: np.ndarray) -> None:
            told.append((parameters, weights))

        found = SETTINGS.run_batch(self._engine, self._pixels, np.array([0]), seed, describe)
        for parameters, weights in told:
            drawn = {name: np.asarray(value) for name, value in parameters.items()}
            yield Round(drawn, weights=weights, worth=float(found.effective_draws[0]))
