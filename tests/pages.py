"""Pages as tests read them: tags, texts, and how wide they are in a browser."""

import html
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import pytest

VOID = {"meta", "img", "br", "hr", "link", "input"}
EVIL = '<script>alert(1)</script>"><img src=x onerror=alert(2)>'


class Page(HTMLParser):
    """Tags, attributes, visible text and balance of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags, self.attributes, self.texts, self.open = [], [], [], []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs) -> None:
        self.tags.append(tag)
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data) -> None:
        if "style" not in self.open:
            self.texts.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.texts).split())

    def values(self, name: str) -> list[str]:
        return [value for _, attribute, value in self.attributes if attribute == name]


def widths_in_a_browser(folder: Path, page: str, width: int) -> tuple[int, int]:
    """Width of a window, and of what would have to be scrolled in it; unit pixel."""
    browser = next(filter(None, map(shutil.which, ("chromium", "google-chrome"))), None)
    if browser is None:
        pytest.skip("no chromium: install it to test the page in a browser")
    # Scripts are forbidden on the page itself: it is measured inside a frame, without that rule.
    page = re.sub(r"<meta http-equiv=[^>]*>", "", page)
    (folder / "frame.html").write_text(
        f'<!DOCTYPE html><iframe id="f" width="{width}" height="900" style="border:0"'
        f' srcdoc="{html.escape(page)}"></iframe><p id="said"></p><script>'
        'const f = document.getElementById("f"); f.onload = () => {'
        "const d = f.contentDocument.documentElement;"
        'document.getElementById("said").textContent = `seen ${d.clientWidth} ${d.scrollWidth}`};'
        "</script>",
        encoding="utf-8",
    )
    command = [browser, "--headless", "--no-sandbox", "--disable-gpu", "--dump-dom"]
    command += [f"--user-data-dir={folder / 'profile'}", "--virtual-time-budget=5000"]
    done = subprocess.run(
        [*command, (folder / "frame.html").as_uri()],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    seen = re.search(r"seen (\d+) (\d+)", done.stdout)
    assert seen, done.stdout[-500:]
    client, scroll = map(int, seen.groups())
    return client, scroll
