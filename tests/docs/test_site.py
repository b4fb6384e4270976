"""The documentation as readers get it: notebooks run, pages are built, links and widths hold.

All in one file, so that one worker executes the notebooks and builds the site from them.
"""

import functools
import inspect
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import override
from urllib.parse import urlsplit

import jupytext
import nbformat
import pytest
from browsers import WIDTHS, browser, console, open_page, sideways
from bs4 import BeautifulSoup
from cases import each
from nbclient import NotebookClient

import polar_bayes as pb

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.py"))
MINUTES = 10  # for one cell on a busy machine; what each takes is in docs/notebooks.md


@pytest.fixture(scope="module")
def executed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the notebooks that have run."""
    return tmp_path_factory.mktemp("notebooks")


@pytest.mark.thorough
@pytest.mark.parametrize(
    "source",
    NOTEBOOKS,
    ids=lambda source: source.stem,
)
def test_a_notebook_runs_without_a_warning(
    source: Path,
    executed: Path,
    tmp_path: Path,
    request: pytest.FixtureRequest,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if "POLAR_BAYES_DATA" in source.read_text():
        monkeypatch.setenv("POLAR_BAYES_DATA", str(request.getfixturevalue("measured")))
    notebook = jupytext.read(source)
    client = NotebookClient(
        notebook,
        timeout=60 * MINUTES,
        kernel_name="python3",
        resources={"metadata": {"path": tmp_path}},
    )
    client.execute()
    nbformat.write(notebook, executed / f"{source.stem}.ipynb")
    said = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    warnings = [output.text for output in said if output.get("name") == "stderr"]
    assert not warnings


@pytest.fixture(scope="module")
def site(executed: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, with every notebook: those that did not run have no output."""
    for source in NOTEBOOKS:
        if not (executed / f"{source.stem}.ipynb").exists():
            nbformat.write(jupytext.read(source), executed / f"{source.stem}.ipynb")
    folder = tmp_path_factory.mktemp("site")
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)],
        cwd=ROOT,
        env=os.environ | {"NOTEBOOKS": str(executed)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert built.returncode == 0, built.stderr
    return folder


def pages(site: Path) -> list[Path]:
    return sorted(site.rglob("index.html"))  # not 404.html, which knows its place on a server only


@pytest.mark.thorough
def test_the_site_is_built_without_a_warning(site: Path) -> None:
    """Strictly: MkDocs and htmlproofer resolve every link, anchor and image of the site itself."""
    assert len(pages(site)) == len(NOTEBOOKS) + len(list((ROOT / "docs").rglob("*.md")))


@pytest.mark.thorough
def test_links_that_lead_elsewhere_are_well_formed(site: Path) -> None:
    for page in pages(site):
        soup = BeautifulSoup(page.read_text(), "html.parser")
        for tag in soup.find_all(["a", "img", "script", "link"]):
            address = urlsplit(tag.get("href") or tag.get("src") or "")
            if address.scheme in ("http", "https"):
                assert "." in address.netloc, f"{page}: {address.geturl()}"
                assert tag.name == "a", f"{page} needs {address.geturl()} to be shown"
            else:
                assert address.scheme in ("", "data"), f"{page}: {address.geturl()}"


@pytest.mark.thorough
def test_every_picture_says_in_words_what_it_shows(site: Path) -> None:
    for page in pages(site):
        for picture in BeautifulSoup(page.read_text(), "html.parser").find_all("img"):
            words = picture.get("alt", "")
            assert len(words.removeprefix("Picture of the section:")) > 5, f"{page}: {picture}"


@pytest.mark.thorough
def test_the_reference_has_every_public_name_once(site: Path) -> None:
    headings = [
        heading.get_text().split()[0]
        for page in (site / "reference").rglob("*.html")
        for heading in BeautifulSoup(page.read_text(), "html.parser").select("h3.doc-heading")
    ]
    of_namespaces = {
        f"pb.{place}.{name}"
        for place in pb.__all__
        for name in getattr(getattr(pb, place), "__all__", ())
        if not inspect.ismodule(getattr(getattr(pb, place), name))
        and getattr(pb, name, None) is not getattr(getattr(pb, place), name)
        and not name.startswith("Abstract")
    }
    of_package = {f"pb.{name}" for name in pb.__all__ if not inspect.ismodule(getattr(pb, name))}
    named = [name for name in headings if name.startswith("pb.")]
    assert sorted(named) == sorted(of_package | of_namespaces)


@pytest.fixture(scope="module")
def address(site: Path) -> Iterator[str]:
    """Where the site is served: a search starts no worker on pages that are files."""
    handler = functools.partial(Quiet, directory=site)
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


class Quiet(SimpleHTTPRequestHandler):
    @override
    def log_message(self, *_: object) -> None:
        """Say nothing."""


@pytest.mark.thorough
@each("width", WIDTHS)
def test_pages_fit_the_window_and_raise_no_error(
    site: Path, address: str, tmp_path: Path, width: int
) -> None:
    errors, wide = [], {}
    with browser(tmp_path) as window:
        for page in pages(site):
            place = page.parent.relative_to(site).as_posix()
            open_page(window, f"{address}/{place}/", width)
            errors += [f"{place}: {said}" for said in console(window)]
            room, needed = sideways(window)
            if needed > room:
                wide[place] = needed
    assert not errors
    assert not wide
