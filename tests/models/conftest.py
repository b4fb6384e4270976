"""Fits of small captures: compilation is what they cost, not sampling."""

from collections.abc import Iterator

import jax
import pytest

from polar_bayes.inference import fitting, hierarchical_reparam, initialization, problem


@pytest.fixture
def compile_fast_rather_than_fast_code(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(initialization, "STARTS", 4)
    monkeypatch.setattr(hierarchical_reparam, "MOST_STARTS", 4)
    monkeypatch.setattr(hierarchical_reparam, "TYPICAL_DRAWS", 50)
    monkeypatch.setattr(fitting, "PRIOR_DRAWS", 100)
    monkeypatch.setattr(problem, "BLOCK", 100)
    monkeypatch.setattr("polar_bayes.inference.program.BLOCK", 100)
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)
