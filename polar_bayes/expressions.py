"""Values as the expressions that make them: `Normal(0, 3)`, `StokesLink(degrees_of_freedom=4.0)`.

Results, scene files and the command line state parts, links, priors and methods in this form, which
is Python's own. A text is parsed by `ast`, and what it names is looked up in a table of known
classes: nothing is evaluated.
"""

import ast
import dataclasses
import difflib
import inspect
from collections.abc import Callable, Mapping
from typing import Any, NoReturn

from polar_bayes.errors import FitError, PolarBayesError, one_line

Known = Mapping[str, Callable[..., object]]
"""Classes and functions, by name, that a text may use."""


def parse_value(
    text: object, known: Known, where: str, error: type[PolarBayesError] = FitError
) -> Any:
    """Return the value that a text describes.

    Args:
        text: A call with literal arguments, or with such calls as arguments.
        known: What it may name; a dotted name counts by its last part.
        where: Where the text is, for the message of an error.
        error: Class of the error.

    Returns:
        What the class or function of that name returns. Lists become tuples.

    Raises:
        PolarBayesError: It is no such text, a name is unknown, or an argument does not fit.
    """
    return _Parser(known, where, error).parse(text)


@dataclasses.dataclass(frozen=True)
class _Parser:
    known: Known
    where: str
    error: type[PolarBayesError]

    def parse(self, text: object) -> object:
        if not isinstance(text, str):
            self._refuse(f"{text!r} is no text", "quote it")
        try:
            node = ast.parse(text.strip(), mode="eval").body
        except (SyntaxError, ValueError, RecursionError, MemoryError):
            self._refuse(f"{one_line(text)!r} cannot be read")
        if not isinstance(node, ast.Call):
            self._refuse(f"{one_line(text)!r} is no call")
        return self._value(node)

    def _value(self, node: ast.AST) -> object:
        if isinstance(node, ast.Tuple | ast.List):
            return tuple(self._value(each) for each in node.elts)
        if isinstance(node, ast.Call):
            return self._call(node)
        try:
            return ast.literal_eval(node)
        except (ValueError, TypeError, SyntaxError, RecursionError, MemoryError):
            if isinstance(node, ast.Name | ast.Attribute) and _last_name(node) in self.known:
                name = _last_name(node)
                self._refuse(f"{name} is not called", f"write {name}()")
            self._refuse(f"{ast.unparse(node)} is neither a number, a text nor a call")

    def _call(self, node: ast.Call) -> object:
        name = _last_name(node.func)
        on_value = isinstance(node.func, ast.Attribute) and isinstance(node.func.value, ast.Call)
        if on_value and name in ("expand", "to_event"):  # as in `Normal(0, 1).expand([4])`
            made = getattr(self._value(node.func.value), name, None)  # type: ignore[attr-defined]
        else:
            made = None if on_value else self.known.get(name)
        if made is None:
            near = difflib.get_close_matches(name, self.known, n=1) or [*self.known]
            few = ", ".join(near) if len(near) < 40 else "those of NumPyro"  # too many to list
            hint = f"did you mean {near[0]}?" if len(near) == 1 else f"give one of {few}"
            self._refuse(f"{ast.unparse(node.func)} is not known here", hint)
        arguments = [self._value(each) for each in node.args]
        if not all(part.arg for part in node.keywords):
            self._refuse("** stands for no argument")
        keywords = {str(part.arg): self._value(part.value) for part in node.keywords}
        try:
            return made(*arguments, **keywords)
        except PolarBayesError as refusal:
            raise refusal.within(self.where) from None
        except Exception as problem:  # whatever a constructor says of its arguments
            said = str(problem).replace(f"{name}.__init__()", name).rstrip(".")
            takes = (each for each in inspect.signature(made).parameters if each != "validate_args")
            what = f"{name} refuses its arguments ({one_line(said)})"
            self._refuse(what, f"it takes {', '.join(takes)}")

    def _refuse(self, what: str, hint: str = "") -> NoReturn:
        hint = hint or "write a call with numbers, such as Normal(0.0, 3.0)"
        raise self.error(what, where=self.where, hint=hint)


def _last_name(node: ast.AST) -> str:
    """Return `Normal` for `Normal` and `dist.Normal`; empty where there is no name."""
    if isinstance(node, ast.Attribute):
        return node.attr
    return node.id if isinstance(node, ast.Name) else ""


def short_text(value: object) -> str:
    """Format a part, link or method as its shortest call, without fields at their defaults.

    Args:
        value: A frozen dataclass, a tuple of them, or a literal.
    """
    if isinstance(value, tuple):
        inside = ", ".join(map(short_text, value))
        return f"({inside},)" if len(value) == 1 else f"({inside})"
    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        return repr(value)
    given = (
        f"{field.name}={short_text(getattr(value, field.name))}"
        for field in dataclasses.fields(value)
        if field.init and field.repr and getattr(value, field.name) != _default(field)
    )
    return f"{type(value).__name__}({', '.join(given)})"


def _default(field: dataclasses.Field) -> object:
    """Return the default of a field, or a value that equals nothing."""
    made = field.default_factory
    return field.default if made is dataclasses.MISSING else made()
