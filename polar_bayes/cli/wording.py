r"""Translation of advice from Python calls to commands and options.

Sentences and hints are written once, in their Python form. Whatever a command prints of them passes
through `as_commands`, which puts an option or a command in the place of each keyword, setting or
function that a sentence names:

    use method='nuts', or Nuts(most_draws=9000)  ->  use --method nuts, or --most-draws 9000
"""

import re
import shlex
from collections.abc import Callable

import click

from polar_bayes.cli.options import NUTS_OPTIONS

FUNCTIONS = {
    **{name: name for name in ("accuracy", "calibrate", "fit", "identify", "report", "simulate")},
    "capture.combine": "combine",
    "choose_effects": "effects",
    "compare_fits": "compare",
    "compare_scenes": "scenes",
    "fit_pixels": "map",
    "from_goniometer": "import goniometer",
    "from_table": "import table",
    "maps.count_pixels": "report",
    "next_views": "identify",
    "profile": "identify",
    "region_means": "regions",
}
"""Functions, and the command that calls each of them."""

OF_IMPORTS = (
    *("angle", "angle_is", "angle_set_by", "aolp_from", "bin", "color", "dark", "dark_level"),
    *("delta", "delta_error", "flat", "gain", "layout", "mueller", "p", "p_error", "p_incident"),
    *("psi", "psi_error", "read_noise", "relative_error", "s", "s_error", "s_incident"),
    *("saturation_level", "sheet", "table", "transfer", "unit", "unpolarized", "wavelength"),
    "window",
)
"""Keyword arguments of imports, which their errors also begin with."""

KEYWORDS = {
    **{
        name: f"--{name.replace('_', '-')}"
        for name in (
            *OF_IMPORTS,
            *("dim", "drop", "keep", "method", "model", "precision", "preset", "scene"),
            *("scheduler", "seed", "setup", "truth"),
        )
    },
    "columns": "--column",
    "constants": "--constant",
    "ignored": "--ignore",
    "known": "--known",
    "links": "--link",
    "parameter": "--profile",
    "priors": "--prior",
    "shared": "--share",
    "store": "--out",
}
"""Keyword arguments, and the option that sets each of them."""

CALL = r"\((?:[^()']|'[^']*'|\([^()]*\))*\)"
FREE = r"(?<![\w.('=])"  # not within quotes, brackets or another name
PACKAGE = r"(?:polar_bayes|pb)\."
KEYWORD, FUNCTION = ("|".join(map(re.escape, names)) for names in (KEYWORDS, FUNCTIONS))

RULES: tuple[tuple[str, str | Callable[[re.Match[str]], str]], ...] = (
    # What a command cannot do is left to Python, or left out.
    (r"pb\.from_ellipsometer\(mueller='column'\)",
     "polar-bayes import ellipsometer --mueller column"),
    (r"goes with pb\.fit only", "is fitted in Python only"),
    (r"fit with load_scene and model= in Python", "fit it in Python"),
    (r"polar_bayes\.save or (?=a command)", ""),
    (r"constraints=pb\.design\.Constraints\([^)]*\), or (?=polar-bayes identify)", ""),
    (r", or pb\.from_table\([^)]*\)", ""),
    (r", as by capture\['valid'\] = capture\['\w+'\]\.notnull\(\)", ""),
    (r"select one with isel\([^)]*\), or ", ""),
    (r", for example capture\.mean\(.*?\)\)", ", or fit each pixel with polar-bayes map"),
    (r"a table or a pair of arrays", "a table, or a column of --table"),
    # Variables of a capture, which a table has as columns.
    (r"columns=\{'(\w+)': COLUMN\}", r"--column \1 COLUMN"),
    (r"columns=\{VARIABLE: '([^']*)'\}",
     lambda found: f"--column VARIABLE {shlex.quote(found[1])}"),
    (r"constants=\{'(\w+)': NUMBER\}", r"--constant \1 NUMBER"),
    (r"ignored=\['([^']*)'\]", lambda found: f"--ignore {shlex.quote(found[1])}"),
    (r"\bvalid=(False|True)", lambda found: f"{int(found[1] == 'True')} in column valid"),
    (r"drop_vars\('([^']*)'\)", r"--drop \1"),
    (r"drop=\['[^']*'\], in a command (?=--drop)", ""),
    # Priors, links and settings of methods, as calls in quotes.
    (r"priors=\{'(\w+)': <[^>]*>\}", r"--prior '\1=DISTRIBUTION'"),
    (r"priors=\{'(\w+)': ([^{}]*)\}", r"--prior '\1=\2'"),
    (rf"(?:a mapping (?:such as )?)?\{{'(\w+)': (\w+Link{CALL})\}}", r"--link '\1=\2'"),
    (rf"\b(\w+) by (\w+Link{CALL})", r"--link '\1=\2'"),
    (r"for example (TruncatedNormal\([^()]*\))", r"for example --prior 'NAME=\1'"),
    (rf"the prior of (\w+) is (\w+{CALL})", r"its prior is --prior '\1=\2'"),
    (rf"{FREE}(\w+Link(?!\(\)){CALL})", r"--link '\1'"),
    (r"use stated_errors=False", "use --link 'StokesLink(stated_errors=False)'"),
    (r"\b(priors|links)\[('?)(\w+)\2\]", lambda found: f"{KEYWORDS[found[1]]} {found[3]}"),
    (rf"(?:{FREE}|(?:{PACKAGE})?methods\.)(Nuts|Laplace|Importance|Point|Auto)\(\)",
     lambda found: f"--method {found[1].lower()}"),
    (rf"{FREE}Nuts(\([^()]*\))", lambda found: _nuts_options(found[1])),
    (rf"{FREE}((?:Importance|CorrectedLaplace|Point|Auto){CALL})", r"--method '\1'"),
    # Other keywords, and functions.
    (r"shared=\(\)", "--share none"),
    (r"truth=capture", "--truth"),
    (r"\btransfer=(GAMMA|\d+\.?\d*)", r"--transfer \1"),
    (rf"\b({KEYWORD})='([^']*)'(?: or '([^']*)')?", lambda found: _option(*found.groups())),
    (rf"{FREE}({KEYWORD})=(?=[\s,;:)]|\.\s|\.?$)", lambda found: KEYWORDS[found[1]]),
    (rf"give the tree (that|as) (?={PACKAGE})", r"give the file \1 "),
    (rf"({PACKAGE}(?:{FUNCTION}))(?: or load)? return(?:ed|s)\b", r"\1 wrote"),
    (r", or a polar_bayes\.Scene", ", or a scene file"),
    (rf"{PACKAGE}compare_scenes|\bcompare_scenes(?!:)",
     lambda _: f"polar-bayes scenes {_capture()}"),
    (rf"{PACKAGE}({FUNCTION})\b", lambda found: f"polar-bayes {FUNCTIONS[found[1]]}"),
    (rf"^({'|'.join(OF_IMPORTS)}):", lambda found: f"{KEYWORDS[found[1]]}:"),
    (rf"^({FUNCTION}):", lambda found: f"{FUNCTIONS[found[1]]}:"),
)  # fmt: skip
"""Patterns and their replacements, applied in this order."""


def as_commands(text: str) -> str:
    """Translate a sentence or error so that it names options and commands, not Python."""
    for pattern, replacement in RULES:
        text = re.sub(pattern, replacement, text)
    return text


def _capture() -> str:
    """Return the path of the command's capture, so that its advice can be pasted and run."""
    context = click.get_current_context(silent=True)
    given = context.params.get("capture") if context else None
    return shlex.quote(str(given)) if given else "capture.nc"


def _option(name: str, value: str, other: str | None) -> str:
    """Format `--method importance or nuts`, quoted as a shell needs it."""
    values = (shlex.quote(each) for each in (value, other) if each)
    return f"{KEYWORDS[name]} {' or '.join(values)}"


def _nuts_options(arguments: str) -> str:
    """Format `--warmup 1000 --most-draws 20000`, or the call if a setting has no option."""
    pairs = [part.split("=") for part in arguments.strip("()").split(", ")]
    if all(len(pair) == 2 and pair[0] in NUTS_OPTIONS for pair in pairs):
        return " ".join(f"--{name.replace('_', '-')} {value}" for name, value in pairs)
    return f"--method 'Nuts{arguments}'"
