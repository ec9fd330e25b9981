"""Hooks of mkdocs: generated pages, executed examples, and mathematics."""

from __future__ import annotations

import os
from typing import Any

from attainable import attainable_table
from commands import command_line_page
from contract import info_page
from environments import env_pages
from mathml import font, with_mathml
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File
from navigation import complete
from notebooks import notebook_pages
from pictures import pictures
from runs import with_output

_TABLE = "<!-- table of envs -->"
_ATTAINABLE = "<!-- table of attainable safety -->"

_made: dict[str, str | bytes] = {}


def on_config(config: Any) -> Any:
    """Add a page for each env and each filter to the navigation."""
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    complete(config.nav)
    return config


def on_files(files: Any, config: Any) -> Any:
    """Add the generated pages and pictures."""
    _made.update({**env_pages(), **notebook_pages(), **pictures()})
    _made.update(
        {
            "reference/command-line.md": command_line_page(),
            "reference/info.md": info_page(),
            "assets/STIXGeneral.ttf": font(),
        }
    )
    for path, content in _made.items():
        if path != "envs/table.md":
            files.append(File.generated(config, path, content=content))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Run the examples of a page, and insert the tables of envs."""
    try:
        markdown = markdown.replace(_TABLE, str(_made["envs/table.md"]))
        if _ATTAINABLE in markdown:
            markdown = markdown.replace(_ATTAINABLE, attainable_table())
        return with_output(markdown)
    except Exception as error:
        raise PluginError(
            f"{page.file.src_uri}: an example does not run: {type(error).__name__}: {error}"
        ) from error


def on_page_content(html: str, **_: Any) -> str:
    """Turn LaTeX into MathML."""
    return with_mathml(html)
