"""What is written in an SVG whose letters are outlines."""

from __future__ import annotations

import html
import re
from pathlib import Path


def svg_texts(path: Path | str) -> str:
    """The texts of a file, each on a line of its own, without the marks of mathematics."""
    found = re.findall(r"<!-- (.*?) -->", Path(path).read_text(), re.DOTALL)
    return "\n".join(html.unescape(text) for text in found).replace("$", "").replace("\u00a0", " ")
