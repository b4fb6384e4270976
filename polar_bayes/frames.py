"""Tables that print all their columns, at the width of the terminal or at 80 characters."""

import shutil
import sys
from typing import override

import pandas as pd

type Frame = pd.DataFrame

WIDTH = 80
"""Characters per line where the output is not a terminal."""


class PrintedFrame(pd.DataFrame):
    """A data frame that prints whole: numbers in four digits, wide tables in blocks of columns."""

    # pandas leaves out the middle columns of what is wider than a terminal. What is selected from
    # this frame is a plain data frame.

    @override
    def __repr__(self) -> str:
        width = shutil.get_terminal_size((WIDTH, 24)).columns if sys.stdout.isatty() else WIDTH
        return self.to_string(float_format=lambda number: f"{number:.4g}", line_width=width)
