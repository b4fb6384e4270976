"""Fits of small captures: compilation is what they cost, not sampling."""

from collections.abc import Iterator

import pytest
from compilations import compiled_fast


@pytest.fixture
def compile_fast_rather_than_fast_code(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    yield from compiled_fast(monkeypatch, starts=4, typical=50, draws=100, block=100)
