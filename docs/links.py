"""Follow every internal link of a built site: ``python docs/links.py docs/build/html``.

Pages, downloads, pictures, style sheets, and the places within pages that a link names must all be there. Links to
other sites are not followed: that would need a network.
"""

from __future__ import annotations

import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit


class Page(HTMLParser):
    """What a page links to, and the places that a link can name.

    Args:
        text: the page.

    Attributes:
        links: targets of its links, as they are written.
        places: its ids and names.
    """

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.places: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Take an element."""
        for name, value in attrs:
            if name in ("href", "src") and value:
                self.links.append(value)
            elif (name == "id" or (tag == "a" and name == "name")) and value:
                self.places.add(value)


def broken_links(site: Path) -> list[str]:
    """Find the internal links of a site that lead nowhere.

    Args:
        site: folder with the pages.

    Returns:
        A sentence for each.

    Raises:
        ValueError: if there is no page in the folder.
    """
    pages = {path.resolve(): Page(path.read_text()) for path in sorted(site.rglob("*.html"))}
    if not pages:
        raise ValueError(f"{site} has no page; build the site with make docs")
    found = []
    for path, page in pages.items():
        for link in dict.fromkeys(page.links):
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            target = target / "index.html" if target.is_dir() else target
            place, name = unquote(parts.fragment), path.relative_to(site.resolve())
            if not target.is_file():
                found.append(f"{name}: {link} leads to no file")
            elif place and target in pages and place not in pages[target].places:
                found.append(f"{name}: {link} leads to no place in its page")
    return found


if __name__ == "__main__":
    broken = broken_links(Path(sys.argv[1]))
    sys.exit("\n".join(broken) or None)
