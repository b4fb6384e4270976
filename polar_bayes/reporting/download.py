"""Tables of a page as CSV files that the page itself holds: no second file, no network."""

import base64
import csv

import pandas as pd

FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""What a spreadsheet runs when a text begins with it."""


def csv_link(table: pd.DataFrame, first: str) -> str:
    """A table as the address of a link."""
    safe = table.map(_inert)
    if isinstance(table.index, pd.MultiIndex):
        safe.index = pd.MultiIndex.from_tuples(
            [tuple(map(_inert, row)) for row in table.index], names=table.index.names
        )
        labels: str | list[str] = [str(name) for name in table.index.names]
    else:
        safe.index, labels = pd.Index([_inert(name) for name in table.index]), first
    safe.columns = pd.Index([_inert(str(name)) for name in table.columns])
    text = safe.to_csv(index_label=labels, quoting=csv.QUOTE_NONNUMERIC)
    return f"data:text/csv;charset=utf-8;base64,{base64.b64encode(text.encode()).decode('ascii')}"


def _inert(value: object) -> object:
    return f"'{value}" if isinstance(value, str) and value.startswith(FORMULA) else value
