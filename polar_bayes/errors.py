"""Errors whose message is one line: `where: what; hint`."""

import functools
from collections.abc import Callable
from typing import Self, override


class PolarBayesError(ValueError):
    """Base class of errors that a user can correct; instances can be pickled.

    Args:
        what: What is wrong, as a clause without a full stop.
        where: File, variable, view or option that is wrong.
        hint: What to do about it, as an imperative clause.
    """

    def __init__(self, what: str, *, where: str, hint: str) -> None:
        self.what, self.where, self.hint = (one_line(text) for text in (what, where, hint))
        super().__init__(f"{self.where}: {self.what}; {self.hint}")

    def within(self, where: str) -> Self:
        """Return the error with the file or entry that holds its place in front of it."""
        return type(self)(self.what, where=f"{where}: {self.where}", hint=self.hint)

    @override
    def __reduce__(self) -> tuple[Callable[[], "PolarBayesError"], tuple[()]]:
        # Exceptions are unpickled from `args`, which hold no keywords.
        return functools.partial(type(self), self.what, where=self.where, hint=self.hint), ()


class CaptureError(PolarBayesError):
    """A capture, table or file does not hold what a measurement must hold."""


class SceneError(PolarBayesError):
    """The requested optics do not exist or are incompatible."""


class FitError(PolarBayesError):
    """A model, prior, link or sampler setting cannot be used."""


class OutputError(PolarBayesError):
    """An output cannot be written, or would overwrite something else."""


def one_line(text: str) -> str:
    """Return text without line breaks, whatever names and attributes of files contain."""
    printable = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
    return printable if len(printable) <= 400 else printable[:397] + "..."
