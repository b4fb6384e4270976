"""Notebooks that have run, as pages of Markdown with their pictures beside them.

So MkDocs checks their links, and they look like all other pages. The gallery ends with pictures.
"""

import os
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.plugins import event_priority
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from nbconvert import MarkdownExporter

SOURCES = Path(__file__).parents[2] / "notebooks"
PICTURES: dict[str, list[str]] = {}
COMMAND = "jupytext --set-kernel python3 --execute --to ipynb notebooks/*.py"


@event_priority(100)  # before plugins that look for links count the files
def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Called by MkDocs with the files of the site."""
    folder = Path(os.environ.get("NOTEBOOKS", SOURCES))
    for name in sorted(source.stem for source in SOURCES.glob("*.py")):
        notebook = folder / f"{name}.ipynb"
        if not notebook.exists():
            raise PluginError(f"{notebook} is missing; run: {COMMAND}")
        resources = {"unique_key": name, "output_files_dir": name}
        page, resources = MarkdownExporter().from_filename(str(notebook), resources=resources)
        files.append(File.generated(config, f"notebooks/{name}.md", content=told(page)))
        PICTURES[name] = list(resources["outputs"])
        for path, picture in resources["outputs"].items():
            files.append(File.generated(config, f"notebooks/{path}", content=picture))
    return files


def told(page: str) -> str:
    """The page with its pictures named after the section that they stand in, for who hears it."""
    section, lines, is_code = "", [], False
    for line in page.splitlines():
        is_code ^= line.startswith("```")
        if line.startswith("#") and not is_code:
            section = line.strip("# ")
        lines.append(line.replace("![png](", f"![Picture of the section: {section}]("))
    return "\n".join(lines) + "\n"


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Called by MkDocs with the source of a page."""
    if page.file.src_uri != "gallery.md":
        return markdown
    shown = [
        f"[![{name.replace('_', ' ')}](notebooks/{path})](notebooks/{name}.md)"
        for name, paths in PICTURES.items()
        for path in paths
    ]
    return "\n\n".join([markdown, *shown])
