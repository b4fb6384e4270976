"""Every material that can be simulated can be fitted with the defaults."""

import pytest

import polar_bayes as pb
from polar_bayes.inference.result import provenance_of


@pytest.mark.thorough
@pytest.mark.parametrize("preset", pb.simulation.PRESETS)
def test_every_preset_converges(preset: str) -> None:
    result = pb.fit(pb.simulate(preset, seed=0), seed=0)
    verdict = pb.verdict(result)
    assert verdict.passed, verdict.problems
    found = pb.diagnostics.json_summary(result)
    rows = found["parameters"].values()
    assert max(row["r_hat"] for row in rows) <= 1.01
    # Of weighted draws, which are independent, the weights tell the effective sample size.
    weighted = provenance_of(result).get("ess") if found["method"] == "importance" else None
    assert (weighted or min(row["ess_bulk"] for row in rows)) >= 400.0
