"""The documentation as readers get it: notebooks run, pages are built, links and widths hold."""

import functools
import inspect
import subprocess
import sys
import threading
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import override
from urllib.parse import unquote, urlsplit

import pytest
from browsers import WIDTHS, browser, console, open_page, sideways
from bs4 import BeautifulSoup
from cases import each

import polar_bayes as pb

ROOT = Path(__file__).parents[2]
STRICTLY = ("-W", "--keep-going", "-n", "-q", "-E", "-D", "nb_execution_mode=force")
MADE_BY_SPHINX = {"genindex.html", "search.html", "py-modindex.html"}

DEFINED_IN = {
    "priors.PRIORS": "PRIORS",
    "methods.registry.METHODS": "methods.METHODS",
    "methods.study.STUDY_METHODS": "methods.STUDY_METHODS",
}
"""Constants, whose documentation Sphinx finds only where they are defined."""

pytestmark = pytest.mark.thorough


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built strictly: a cell that raises or warns fails it, and so does a dead link.

    Every notebook is executed, but for those that need measurements where there are none.
    """
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", *STRICTLY, "docs", str(folder)]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    return folder


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, BeautifulSoup]:
    return {
        page: BeautifulSoup(page.read_text(), "html.parser")
        for page in sorted(site.rglob("*.html"))
        if page.name not in MADE_BY_SPHINX and "_static" not in page.parts
    }


def test_every_page_and_notebook_is_there(site: Path, pages: dict[Path, BeautifulSoup]) -> None:
    sources = [*(ROOT / "docs").rglob("*.md"), *(ROOT / "docs").rglob("*.py")]
    names = {source.relative_to(ROOT / "docs").with_suffix(".html") for source in sources}
    assert names - {Path("conf.html")} <= {page.relative_to(site) for page in pages}


def test_links_lead_somewhere(pages: dict[Path, BeautifulSoup]) -> None:
    """Those to other places are well formed, and no page needs such a place to be shown."""
    names = {page: {tag["id"] for tag in soup.select("[id]")} for page, soup in pages.items()}
    for page, soup in pages.items():
        for tag in soup.find_all(["a", "img", "script", "link"]):
            address = urlsplit(tag.get("href") or tag.get("src") or "")
            if address.scheme in ("http", "https"):
                assert "." in address.netloc, f"{page}: {address.geturl()}"
                assert tag.name == "a", f"{page} needs {address.geturl()} to be shown"
                continue
            assert address.scheme in ("", "data"), f"{page}: {address.geturl()}"
            target = (page.parent / unquote(address.path)).resolve() if address.path else page
            assert address.scheme or target.exists(), f"{page}: {address.geturl()}"
            if address.fragment and target in names:
                assert unquote(address.fragment) in names[target], f"{page}: {address.geturl()}"


def test_every_picture_says_in_words_what_it_shows(pages: dict[Path, BeautifulSoup]) -> None:
    for page, soup in pages.items():
        for picture in soup.select("main img"):
            words = picture.get("alt", "")
            assert " " in words, f"{page}: {picture.get('src')}"


def test_the_reference_has_every_public_name_once(pages: dict[Path, BeautifulSoup]) -> None:
    entries = [
        soup.select_one("dt.sig")["id"] for page, soup in pages.items() if page.match("generated/*")
    ]
    of_namespaces = {
        f"{place}.{name}"
        for place in pb.__all__
        for name in getattr(getattr(pb, place), "__all__", ())
        if not inspect.ismodule(getattr(getattr(pb, place), name))
        and getattr(pb, name, None) is not getattr(getattr(pb, place), name)
        and not name.startswith("Abstract")
    }
    of_package = {name for name in pb.__all__ if not inspect.ismodule(getattr(pb, name))}
    named = [
        DEFINED_IN.get(name, name)
        for name in (entry.removeprefix("polar_bayes.") for entry in entries)
        if ".Abstract" not in name
    ]
    assert sorted(named) == sorted(of_package | of_namespaces)


@pytest.fixture(scope="module")
def address(site: Path) -> Iterator[str]:
    """Serve the site: its search reads files, which browsers deny to pages on disk."""
    handler = functools.partial(Quiet, directory=site)
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


class Quiet(SimpleHTTPRequestHandler):
    @override
    def log_message(self, *_: object) -> None:
        """Say nothing."""


@each("width", WIDTHS)
def test_pages_fit_the_window_and_raise_no_error(
    site: Path, pages: dict[Path, BeautifulSoup], address: str, tmp_path: Path, width: int
) -> None:
    errors, wide = [], {}
    with browser(tmp_path) as window:
        for page in pages:
            place = page.relative_to(site).as_posix()
            open_page(window, f"{address}/{place}", width)
            errors += [f"{place}: {said}" for said in console(window)]
            room, needed = sideways(window)
            if needed > room:
                wide[place] = needed
    assert not errors
    assert not wide
