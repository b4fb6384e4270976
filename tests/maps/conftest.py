"""Fits of tiny images: compilation is what they cost."""

from collections.abc import Iterator

import jax
import pytest


@pytest.fixture(scope="module")
def compiled_in_haste() -> Iterator[None]:
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)
