"""Cases of one check, run in one test.

`each` is written as `pytest.mark.parametrize` is. The cases are pytest's subtests of one test: a
case that fails is reported under its name, with its own traceback, and the others still run.
"""

import contextlib
import functools
import inspect
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import pytest
import xarray as xr

Names = Iterable[object] | Callable[[Any], object] | None


def _copy(value: Any) -> Any:
    """A dataset, tree or dictionary of datasets, copied; anything else as it is."""
    if isinstance(value, xr.Dataset | xr.DataTree):
        return value.copy(deep=True)
    if isinstance(value, dict) and all(isinstance(each, xr.Dataset) for each in value.values()):
        return {name: each.copy(deep=True) for name, each in value.items()}
    return value


def _value_name(value: Any, ids: Names) -> str:
    """Name of one value of a case."""
    name = ids(value) if callable(ids) else None
    if name is None:
        name = getattr(value, "__name__", value)
    readable = " ".join(str(name).split())[:80]
    return readable.encode(errors="backslashreplace").decode()  # workers send names as UTF-8


def _cases(names, values, ids):
    """Name and arguments of every case."""
    single = isinstance(names, str) and "," not in names
    arguments = [n.strip() for n in names.split(",")] if isinstance(names, str) else names
    rows = [(value,) if single else tuple(value) for value in values]
    if ids is None or callable(ids):
        case_names = [", ".join(_value_name(value, ids) for value in row) for row in rows]
    else:
        case_names = [str(name) for name in ids]
    cases = [dict(zip(arguments, row, strict=True)) for row in rows]
    return list(zip(case_names, cases, strict=True))


@contextlib.contextmanager
def _fresh(fixtures: dict[str, Any], number: int) -> Iterator[dict[str, Any]]:
    """The fixtures of a test, such that a case leaves no trace in the next one."""
    fixtures = {name: _copy(value) for name, value in fixtures.items()}
    with contextlib.ExitStack() as stack:
        if "monkeypatch" in fixtures:
            fixtures["monkeypatch"] = stack.enter_context(pytest.MonkeyPatch.context())
        if "tmp_path" in fixtures:
            fixtures["tmp_path"] = fixtures["tmp_path"] / f"case{number}"
            fixtures["tmp_path"].mkdir()
        if "capsys" in fixtures:
            fixtures["capsys"].readouterr()
        yield fixtures


def each(
    names: str | Sequence[str], values: Iterable, ids: Names = None, quick: int | None = None
) -> Callable:
    """Decorator that runs a test once for each case, as subtests.

    Args:
        names: Arguments that the cases fill.
        values: A value for each case; a tuple of them if there is more than one name.
        ids: Names of the cases, or a function of one value.
        quick: How many of the first cases are enough where time counts. A second test, which is
            thorough, runs the others. By default all of them.

    Decorators above one another give every combination. In each case `monkeypatch` and
    `tmp_path` are fresh; datasets, trees and dictionaries of datasets are copies.
    """
    outer = _cases(names, values, ids)

    def decorate(test: Callable) -> Callable:
        inner, function = getattr(test, "cases", [("", {}, True)]), getattr(test, "one_case", test)
        cases = [
            (
                " / ".join(filter(None, (inner_name, name))),
                inner_arguments | arguments,
                is_quick and (quick is None or number < quick),
            )
            for inner_name, inner_arguments, is_quick in inner
            for number, (name, arguments) in enumerate(outer)
        ]
        has_more = not all(is_quick for _, _, is_quick in cases)

        @functools.wraps(function, updated=())  # pytest's hypothesis plugin looks for attributes
        def every_case(subtests: pytest.Subtests, part: str = FIRST, **fixtures: Any) -> None:
            for number, (name, arguments, is_quick) in enumerate(cases):
                if is_quick == (part == FIRST):
                    with subtests.test(name), _fresh(fixtures, number) as case_fixtures:
                        function(**case_fixtures, **arguments)

        filled = {name for _, arguments, _ in cases for name in arguments}
        parameters = inspect.signature(function).parameters
        requested = [name for name in parameters if name not in filled]
        requested += ["subtests", *(["part"] if has_more else [])]
        every_case.__signature__ = inspect.Signature(
            [inspect.Parameter(n, inspect.Parameter.KEYWORD_ONLY) for n in requested]
        )
        every_case.cases, every_case.one_case = cases, function
        every_case.pytestmark = [m for m in getattr(test, "pytestmark", []) if m != PARTS.mark]
        return PARTS(every_case) if has_more else every_case

    return decorate


FIRST = "the first cases"
PARTS = pytest.mark.parametrize(
    "part", [FIRST, pytest.param("the other cases", marks=pytest.mark.thorough)]
)
