"""Ours: all of `polar_bayes.fit`, predictions and densities of every reading included."""

from collections.abc import Iterator

from posterior import AbstractPeer, Round

import polar_bayes as pb


class Peer(AbstractPeer):
    packages = ("polar_bayes",)

    def rounds(self, seed: int) -> Iterator[Round]:
        capture, scene = self.posterior.capture, self.posterior.scene
        found = pb.fit(capture, method=pb.methods.Nuts(), scene=scene, seed=seed)
        parameters = {name: found["posterior"][name].values for name in found["prior"].data_vars}
        steps = found["sample_stats"]
        evaluations = int(steps["n_steps"].sum() + steps["warmup_steps"].isel(draw=0).sum())
        yield Round(parameters, evaluations)
