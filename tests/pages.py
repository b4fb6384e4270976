"""Pages as tests read them: tags, attributes and texts."""

import contextlib
from collections.abc import Iterator
from html.parser import HTMLParser

import pytest
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

VOID = {"meta", "img", "br", "hr", "link", "input"}
LINES = {"h1", "h2", "h3", "p", "tr", "li", "figcaption", "summary", "a", "caption", "dt", "pre"}
EXTERNAL = {"script", "link", "iframe", "object", "embed", "base"}
EVIL = '<script>alert(1)</script>"><img src=x onerror=alert(2)>'


class Page(HTMLParser):
    """Tags, attributes, visible text and balance of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags, self.attributes, self.texts, self.read, self.open = [], [], [], [], []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs) -> None:
        kind = dict(attrs).get("class")
        self.tags.append(tag)
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        if tag not in VOID:
            self.open.append(tag)
        if tag in LINES:
            self.read.append("\n")
        elif tag in ("td", "th"):
            self.read.append(f"| <{kind}>" if kind else "|")
        elif tag == "section" and kind:
            self.read.append(f"\n<{kind}>")
        elif tag == "img":
            self.read.append(f"\n[{dict(attrs).get('alt')}]")

    def handle_endtag(self, tag) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data) -> None:
        if "style" not in self.open:
            self.texts.append(data)
            self.read.append(" ".join(data.split()))

    @property
    def lines(self) -> list[str]:
        """Text of a page: a line for each paragraph, row, link or picture."""
        lines = " ".join(self.read).split("\n")
        return [line for line in (" ".join(line.split()) for line in lines) if line]

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.texts).split())

    def values(self, name: str) -> list[str]:
        return [value for _, attribute, value in self.attributes if attribute == name]


BESIDE_OR_WITHIN = ("#", "data:text/csv;", "explore.html")
"""What a page may link to: places in it, tables in it, and the map to point at."""


def faults_of(page: Page) -> list[str]:
    """List faults of a page: other files, scripts, dead anchors, pictures without words."""
    ids, boxes = page.values("id"), [x for x in page.values("class") if x.startswith("scroll")]
    led_to = {value[1:] for value in page.values("href") if value.startswith("#")}
    led_to |= set(page.values("aria-labelledby"))
    found = {
        "tags left open": page.open,
        "tags that load or run": EXTERNAL & set(page.tags),
        "handlers": [name for _, name, _ in page.attributes if name.startswith("on")],
        "attributes": page.values("srcset") + page.values("action") + page.values("style"),
        "sources": [x for x in page.values("src") if not x.startswith("data:image/svg+xml;base64")],
        "links": [x for x in page.values("href") if not x.startswith(BESIDE_OR_WITHIN)],
        "names given twice": [name for name in set(ids) if ids.count(name) > 1],
        "dead anchors": led_to - set(ids),
        "pictures without words": [
            x for tag, name, x in page.attributes if name == "alt" and not x
        ],
        "pictures that say nothing": page.tags.count("img") != len(page.values("alt")),
        "tables in no box": page.tags.count("table") > len(boxes),
        "no policy": "default-src 'none'" not in " ".join(page.values("content")),
    }
    return [f"{what}: {which}" for what, which in found.items() if which]


@contextlib.contextmanager
def blank_pictures() -> Iterator[None]:
    """Nothing is drawn where a figure is written to a page."""
    with pytest.MonkeyPatch.context() as patch:
        for way, name in ((Figure, "savefig"), (FigureCanvasSVG, "print_svg")):
            patch.setattr(way, name, lambda _, file, **__: file.write(b"<svg/>"))
        yield
