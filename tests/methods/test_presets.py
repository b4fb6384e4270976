"""Every material that can be simulated can be fitted with the defaults."""

import pytest

import polar_bayes as pb


@pytest.mark.thorough
@pytest.mark.parametrize("preset", pb.simulation.PRESETS)
def test_every_preset_converges(preset: str) -> None:
    result = pb.fit(pb.simulate(preset, seed=0), seed=0)
    verdict = pb.verdict(result)
    assert verdict.passed, verdict.problems
    rows = pb.diagnostics.json_summary(result)["parameters"]
    assert max(row["r_hat"] for row in rows.values()) <= 1.01
    assert min(row["ess_bulk"] for row in rows.values()) >= 400.0
