"""What is on a page of the report, and what every page holds to."""

from __future__ import annotations

import base64
import re
import xml.etree.ElementTree as ET
from html.parser import HTMLParser
from pathlib import Path

VOID = {"meta", "img", "br"}
PICTURES = ["Best return of each design", "Learning curves", "Designs over time", "Bodies", "Predicted and achieved"]
PICTURES += ["What the search was worth", "Model error over time", "What was imagined"]
PICTURES += ["Losses and entropy", "Time spent"]


class Page(HTMLParser):
    """What is on a page; tags that do not close each other fail."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.open: list[str] = []
        self.images: list[dict[str, str]] = []
        self.links: list[str] = []
        self.headings: list[str] = []
        self.captions: list[str] = []
        self.cells: list[int] = []  # of each row of a table
        self.words = ""
        self.feed(path.read_text(encoding="utf-8"))
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = {name: value or "" for name, value in attrs}
        self.links += [found[name] for name in ("src", "href") if name in found]
        if tag == "img":
            self.images.append(found)
        if tag == "tr":
            self.cells.append(0)
        if tag in ("th", "td"):
            self.cells[-1] += 1
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" not in self.open:
            self.words += data
            if "h2" in self.open:
                self.headings.append(data)
            if "figcaption" in self.open:
                self.captions.append(data)


def check(path: Path) -> Page:
    """A page is well formed, fetches nothing, shows no NaN, and has short captions and narrow tables."""
    page = Page(path)
    assert page.images
    assert len(page.captions) == len(page.images)
    assert all(0 < len(caption.split()) <= 60 for caption in page.captions)
    assert max(page.cells) <= 10
    assert all(link.startswith("data:image/svg+xml;base64,") for link in page.links)
    assert not re.search(r"\bnan\b", page.words, re.IGNORECASE)
    for image in page.images:
        assert int(image["width"]) > 300
        assert int(image["height"]) > 100
        assert len(image["alt"]) > 20
        assert not re.search(r"\bnan\b", image["alt"], re.IGNORECASE)
        svg = base64.b64decode(image["src"].partition(",")[2]).decode()
        assert not re.search(r"\bnan\b", svg, re.IGNORECASE)  # words are outlines, with their text in comments
        root = ET.fromstring(svg)
        assert all(float(root.attrib[side].removesuffix("pt")) > 0 for side in ("width", "height"))
        hrefs = [value for node in root.iter() for key, value in node.attrib.items() if key.endswith("href")]
        assert all(href.startswith(("#", "data:")) for href in hrefs)
    return page
