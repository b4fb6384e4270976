"""The table of hard cases in the documentation is what its command prints."""

from pathlib import Path

import jax
import numpy as np
import pytest
from cases import each
from hard_cases.table import CASES, error

PAGE = Path(__file__).parents[2] / "docs" / "hard_cases.md"
BOUND = {np.float64: 1e-10, np.float32: 1e-4}

of_every_case = each("case", CASES, ids=lambda case: f"{case.what}, {case.where}", quick=8)


@of_every_case
def test_ours_holds_where_the_textbook_may_not(case):
    assert error(case, jax.jit(case.ours), np.float64) <= BOUND[np.float64]


@pytest.mark.thorough
@of_every_case
def test_ours_holds_in_single_precision(case):
    assert error(case, jax.jit(case.ours), np.float32) <= BOUND[np.float32]


@pytest.mark.thorough
@of_every_case
def test_the_textbook_is_worse(case):
    textbook = max(error(case, case.textbook, dtype) for dtype in BOUND)
    assert textbook > 10.0 * max(error(case, jax.jit(case.ours), dtype) for dtype in BOUND)


def test_the_page_shows_every_case():
    rows = [line for line in PAGE.read_text().splitlines() if line.startswith("| ")]
    shown = [tuple(cell.strip() for cell in row.split("|")[1:3]) for row in rows[1:]]
    assert shown == [(case.where, case.what) for case in CASES]
