"""A real browser opens every page, on a phone and on a desk, light and dark."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.docs_site.chromium import Browser, Page
from thesis.__main__ import app

pytestmark = pytest.mark.docs

CHECKS = (Path(__file__).parent / "page_checks.js").read_text()
DESK, PHONE = 1280, 390
LEGIBLE = 3.0
"""Least contrast of large text in WCAG 2.2, AA."""

SEARCHES = {
    "VecNormalize": "train",
    "latency": "control-loop",
    "ROS": "control-loop",
    "delay": "delay",
    "SCBF": "scbf",
}
"""Words that users look for, and what is in the address of a page that has to be found."""

Serve = Callable[[Path], str]


@dataclass
class Findings:
    """What is wrong with pages, a list of "page: what" for each kind.

    Attributes:
        errors: console errors, failed requests, requests to other machines.
        pictures: that are missing or broken.
        wide: what does not fit the screen, or is cut off.
        faint: text that can hardly be read.
    """

    errors: list[str] = field(default_factory=list)
    pictures: list[str] = field(default_factory=list)
    wide: list[str] = field(default_factory=list)
    faint: list[str] = field(default_factory=list)

    def look(self, page: Page, base: str, path: str) -> None:
        """Open a page, and add what is wrong with it."""
        self.errors += [f"{path}: {text}" for text in page.open(base + path)]
        self.pictures += [f"{path}: {text}" for text in page.evaluate("checks.pictures()")]
        for width in (PHONE, DESK):
            page.resize(width)
            wide = page.evaluate(f"checks.overflow({width})")
            self.wide += [f"{path} at {width} px: {text}" for text in wide]
        faint = page.evaluate(f"checks.contrast({LEGIBLE})")
        self.faint += [f"{path}: {text}" for text in faint]
        self.errors += [f"{path}: {text}" for text in page.complaints(base)]


def opened(browser: Browser, dark: bool = False) -> Page:
    """A page with the checks in it."""
    page = browser.page(dark)
    page.command("Page.addScriptToEvaluateOnNewDocument", source=CHECKS)
    page.resize(DESK)
    return page


def looked_at(browser: Browser, base: str, folder: Path, dark: bool) -> Findings:
    """What is wrong with all pages of a folder."""
    found, page = Findings(), opened(browser, dark)
    for path in sorted(folder.rglob("*.html")):
        found.look(page, base, path.relative_to(folder).as_posix())
    return found


@pytest.fixture(scope="module")
def address(site: Path, serve: Serve) -> str:
    return serve(site)


@pytest.fixture(scope="module", params=["light", "dark"])
def findings(
    request: pytest.FixtureRequest, browser: Browser, address: str, site: Path
) -> Findings:
    """What is wrong with the pages of the site, in either scheme."""
    return looked_at(browser, address, site, request.param == "dark")


def shown(found: list[str]) -> str:
    return "\n".join(found)


def test_no_page_has_an_error_or_asks_for_what_is_not_there(findings: Findings):
    assert not findings.errors, shown(findings.errors)


def test_every_picture_is_there(findings: Findings):
    assert not findings.pictures, shown(findings.pictures)


def test_every_page_fits_a_phone_and_a_desk(findings: Findings):
    assert not findings.wide, shown(findings.wide)


def test_all_text_can_be_read(findings: Findings):
    assert not findings.faint, shown(findings.faint)


@pytest.mark.parametrize(("dark", "scheme"), [(False, "default"), (True, "slate")])
def test_the_scheme_is_that_of_the_system(browser: Browser, address: str, dark: bool, scheme: str):
    page = opened(browser, dark)
    page.open(f"{address}index.html")
    assert page.evaluate("document.body.dataset.mdColorScheme") == scheme


@pytest.mark.parametrize("text", SEARCHES)
def test_search_answers(browser: Browser, address: str, text: str):
    page = opened(browser)
    page.open(f"{address}index.html")
    found = page.evaluate(f"checks.search({text!r})")
    assert any(SEARCHES[text] in link for _, link in found), found
    assert not page.complaints(address)


def test_search_finds_nothing_where_there_is_nothing(browser: Browser, address: str):
    page = opened(browser)
    page.open(f"{address}index.html")
    assert page.evaluate("checks.search('qwertzuiop')") == []


def test_the_page_of_a_reproduction(browser: Browser, serve: Serve, tmp_path: Path):
    names = ["table-5.1", "figure-3.3"]
    done = CliRunner().invoke(app, [*names, "--quick", "--jobs", "1", "--out", str(tmp_path)])
    assert done.exit_code == 0, done.output
    base = serve(tmp_path)
    for dark in (False, True):
        assert looked_at(browser, base, tmp_path, dark) == Findings()


def test_what_is_wrong_is_found(browser: Browser, serve: Serve, tmp_path: Path):
    (tmp_path / "index.html").write_text(
        '<!doctype html><meta name="viewport" content="width=device-width"><link rel="icon"'
        ' href="data:,"><body style="margin:0">'
        '<img src="none.png"><div style="width:500px">wide</div>'
        '<article style="width:90px;overflow:hidden"><b style="margin-left:200px">cut</b>'
        '<p style="color:#ccc;background:#fff">faint</p></article>'
        "<script>console.error('bad'); missing()</script>"
    )
    found = looked_at(browser, serve(tmp_path), tmp_path, dark=False)
    text = shown(found.errors)
    assert "404" in text
    assert "bad" in text
    assert "missing is not defined" in text
    assert found.pictures == ["index.html: no picture: none.png"]
    assert 'index.html at 390 px: div "wide" is too wide' in found.wide
    assert any("is cut off by article" in each for each in found.wide)
    assert any("faint" in each for each in found.faint)
