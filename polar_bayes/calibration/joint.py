"""One test of several p-values together, and the sentences of those that stray."""

from collections.abc import Callable

import pandas as pd

FALSE_ALARMS = 0.05
"""How often a right model, prior, link and method fail a joint test, at most."""


def limit_of(table: pd.DataFrame) -> float:
    """The p-value below which a row strays: the false-alarm rate over the number of rows."""
    return FALSE_ALARMS / len(table)


def is_calibrated(table: pd.DataFrame) -> bool:
    """Whether ranks pass the joint test, at a rate of false alarms of at most 5%.

    Args:
        table: Of `calibration_table`, or of `calibration_readings`.

    Returns:
        False where the smallest p-value is below 5% over the number of rows (Bonferroni), or a row
        has none, with fewer than two answers.

    Raises:
        Nothing.
    """
    return bool((table["p_value"] >= limit_of(table)).all())


def which_stray(table: pd.DataFrame, how: Callable[[pd.Series], str]) -> list[str]:
    """A sentence for each row whose ranks stray."""
    limit, said = limit_of(table), []
    for label, row in table.iterrows():
        if not row["p_value"] >= limit:  # none at all strays too
            chance = f" (p = {row['p_value']:.2g})" if row["answered"] > 1 else ""
            said.append(f"{label}: {how(row)}{chance}.")
    return said
