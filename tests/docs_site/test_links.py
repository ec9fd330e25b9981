"""Every link and picture of the built site leads to a file, and to an anchor in it."""

from __future__ import annotations

from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

pytestmark = pytest.mark.docs


class _Targets(HTMLParser):
    """Anchors of a page, and what it refers to.

    Attributes:
        anchors: ids and names.
        references: values of `href` and `src`.
    """

    def __init__(self, text: str) -> None:
        super().__init__()
        self.anchors, self.references = set[str](), set[str]()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if value is None:
                continue
            if name == "id" or (name == "name" and tag == "a"):
                self.anchors.add(value)
            elif name in ("href", "src", "poster"):
                self.references.add(value)


def broken_links(folder: Path) -> list[str]:
    """Return the internal references of a folder of HTML that lead nowhere, with their page."""
    pages = {path.resolve(): _Targets(path.read_text()) for path in folder.rglob("*.html")}
    found = []
    for page, targets in sorted(pages.items()):
        for reference in sorted(targets.references):
            parts = urlsplit(reference)
            if parts.scheme or parts.netloc or not (parts.path or parts.fragment):
                continue
            name = unquote(parts.path)
            base = folder.resolve() if name.startswith("/") else page.parent
            target = (base / name.lstrip("/")).resolve() if name else page
            if target.is_dir():
                target /= "index.html"
            anchor = unquote(parts.fragment)
            # Material gives the top of a page no id.
            known = target not in pages or anchor in ("", "__skip", *pages[target].anchors)
            if not (target.is_file() and known):
                found.append(f"{page.relative_to(folder.resolve())}: {reference}")
    return found


def test_every_link_and_picture_leads_somewhere(site: Path):
    assert not broken_links(site)


def test_what_leads_nowhere_is_found(tmp_path: Path):
    (tmp_path / "one.html").write_text(
        '<h1 id="top"></h1><a href="#top"></a><a href="#none"></a><a href="two.html#a%20b"></a>'
        '<a href="two.html#c"></a><a href="three.html"></a><img src="no.png">'
        '<a href="https://example.org/x"></a><a href="mailto:x@example.org"></a>'
    )
    (tmp_path / "two.html").write_text('<p id="a b"></p>')
    assert broken_links(tmp_path) == [
        f"one.html: {link}" for link in ("#none", "no.png", "three.html", "two.html#c")
    ]
