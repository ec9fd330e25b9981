"""Mathematics as MathML, which browsers draw themselves: no script and no font has to be fetched."""

from __future__ import annotations

import html
import re

from latex2mathml.converter import convert

_MATH = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)


def with_mathml(page: str) -> str:
    """Replace the LaTeX that pymdownx.arithmatex marked in the HTML of a page."""
    return _MATH.sub(_converted, page)


def _converted(found: re.Match[str]) -> str:
    tag, _, latex = found.groups()
    block = tag == "div"
    mathml = convert(html.unescape(latex).strip(), display="block" if block else "inline")
    return f'<div class="equation">{mathml}</div>' if block else mathml
