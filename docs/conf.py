"""Configuration of Sphinx for these pages: `sphinx-build -W -n docs site`.

With `-t online`, names of other projects are links to their documentation.
"""

import os
import re
import sys
from importlib.metadata import version as version_of
from pathlib import Path

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.writers.html5 import HTML5Translator

import polar_bayes

project = "polar_bayes"
author = "The polar_bayes authors"
version = release = version_of("polar_bayes")

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.intersphinx",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
]
exclude_patterns = ["conf.py", "_templates"]

# Pages: MyST Markdown. Notebooks: percent scripts, executed; what they say to stderr is a warning.
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 4
nb_custom_formats = {".py": ["jupytext.reads", {"fmt": "py:percent"}]}
nb_execution_mode = "cache"
nb_execution_excludepatterns = (
    [] if "POLAR_BAYES_DATA" in os.environ else ["measured_plates.py", "water_under_the_sky.py"]
)
nb_execution_in_temp = True
nb_execution_timeout = 1200
nb_execution_raise_on_error = True
nb_output_stderr = "warn"
nb_merge_streams = True
suppress_warnings = ["myst-nb.lexer"]  # of a notebook that is not executed

# Reference: from docstrings, whose formulas and `names` are written as in Markdown. Namespaces that
# are modules of another name are found by the name that users write.
for namespace in ("input_quantities", "instrument", "links", "plots"):
    sys.modules[f"polar_bayes.{namespace}"] = getattr(polar_bayes, namespace)
templates_path = ["_templates"]
default_role = "py:obj"
autosummary_generate = True
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_member_order = "bysource"
napoleon_numpy_docstring = False
napoleon_use_rtype = False

# A docstring that names a class or constant of ours which is not public is wrong. Modules and types
# that only signatures mention have no page, and other projects' are known where online.
nitpick_ignore = [
    ("py:obj", f"polar_bayes.{name}")
    for name in ("PRIORS", "methods.STUDY_METHODS", "priors.ANGLE_ZERO")
]
nitpick_ignore_regex = [
    ("py:.*", r"(?!polar_bayes\.).*"),
    ("py:.*", r"polar_bayes\.(\w+\.\w+|results|repr_html)\.\w+"),
    ("py:obj", r"polar_bayes\.[a-z_]+\.[a-z_]+"),
]
intersphinx_mapping = (
    {
        "arviz": ("https://python.arviz.org/en/stable/", None),
        "jax": ("https://docs.jax.dev/en/latest/", None),
        "numpy": ("https://numpy.org/doc/stable/", None),
        "numpyro": ("https://num.pyro.ai/en/stable/", None),
        "python": ("https://docs.python.org/3/", None),
        "xarray": ("https://docs.xarray.dev/en/stable/", None),
    }
    if tags.has("online")  # Sphinx defines it
    else {}
)

# The code of notebooks is wider than a column that has a list of contents at its side.
NOTEBOOKS = [f"notebooks/{file.stem}" for file in Path(__file__).parent.glob("notebooks/*.py")]
html_theme = "pydata_sphinx_theme"
html_title = "polar_bayes"
html_sidebars = {page: [] for page in ("index", "gallery")}
html_favicon = "favicon.svg"
html_static_path = ["style.css"]
html_css_files = ["style.css"]
html_context = {"default_mode": "auto"}
html_copy_source = False
html_show_sourcelink = False
html_math_renderer = "mathml"
html_theme_options = {
    "navbar_align": "left",
    "show_toc_level": 2,
    "footer_start": ["copyright"],
    "footer_end": [],
    "secondary_sidebar_items": {"**": ["page-toc"], **{name: [] for name in NOTEBOOKS}},
}


def draw_formula(page: HTML5Translator, node: nodes.math | nodes.math_block) -> None:
    """Return a formula as MathML, which browsers draw without an external script."""
    display = "block" if isinstance(node, nodes.math_block) else "inline"
    page.body.append(convert(node.astext(), display=display))
    raise nodes.SkipNode


def write_formulas_as_in_sphinx(*event: object) -> None:
    """Turn `$x$` and `$$ x $$` of a docstring into a role and a directive of Sphinx."""
    lines = event[-1]
    text = re.sub(r"( *)\$\$(.+?)\$\$", _directive, "\n".join(lines), flags=re.DOTALL)
    lines[:] = re.sub(r"\$([^$]+)\$", _role, text).split("\n")


def _directive(found: re.Match[str]) -> str:
    return f"{found[1]}.. math:: {' '.join(found[2].split())}"


def _role(found: re.Match[str]) -> str:
    return f":math:`{' '.join(found[1].split())}`"


def setup(app: Sphinx) -> None:
    """Register the extensions of this file; Sphinx calls this function."""
    app.add_html_math_renderer("mathml", (draw_formula, None), (draw_formula, None))
    app.connect("autodoc-process-docstring", write_formulas_as_in_sphinx)
