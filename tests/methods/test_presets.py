"""Every material that can be simulated can be fitted with the defaults."""

import pytest

import polar_bayes as pb


@pytest.mark.thorough
@pytest.mark.parametrize("preset", pb.simulation.PRESETS)
def test_every_preset_converges(preset: str) -> None:
    result = pb.fit(pb.simulate(preset, seed=0), seed=0)
    verdict = pb.verdict(result)
    assert verdict.passed, verdict.problems
    found = pb.diagnostics.json_summary(result)
    rows = found["parameters"].values()
    assert max(row["r_hat"] for row in rows) <= 1.01
    # Weighted draws are independent: their number counts, that of chains is estimated.
    weighted = found["method"] == "importance"
    ess = result["posterior"].sizes["draw"] * result["posterior"].sizes["chain"]
    assert (ess if weighted else min(row["ess_bulk"] for row in rows)) >= 400.0
