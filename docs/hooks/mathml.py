"""Mathematics as MathML, which browsers draw without fetching a script or a font."""

from __future__ import annotations

import html
import re
from pathlib import Path

import matplotlib as mpl
from latex2mathml.converter import convert

_MATH = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)


def font() -> bytes:
    """Return matplotlib's font of mathematical letters, for systems that have none."""
    return (Path(mpl.get_data_path()) / "fonts" / "ttf" / "STIXGeneral.ttf").read_bytes()


def with_mathml(page: str) -> str:
    """Replace the LaTeX that pymdownx.arithmatex marked in the HTML of a page."""
    return _MATH.sub(_converted, page)


def _converted(found: re.Match[str]) -> str:
    tag, _, latex = found.groups()
    block = tag == "div"
    mathml = convert(html.unescape(latex).strip(), display="block" if block else "inline")
    return f'<div class="equation">{mathml}</div>' if block else mathml
