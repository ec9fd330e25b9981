"""Hooks of mkdocs: generated pages, executed examples, and mathematics."""

from __future__ import annotations

import gc
import logging
import os
import sys
from functools import partial
from pathlib import Path

# Before NumPy and SymPy are imported: on small matrices, threads wait for each other; and what one
# example has differentiated serves the next one.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("SYMPY_CACHE_SIZE", "None")
os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")

from typing import Any

from attainable import attainable_table
from mathml import font, with_mathml
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File
from navigation import complete
from notebooks import FOLDER as NOTEBOOKS
from notebooks import notebook_pages
from result_cache import cached, forget_unused
from runs import with_output

_TABLE = "<!-- table of envs -->"
_ATTAINABLE = "<!-- table of attainable safety -->"

_made: dict[str, str | bytes] = {}


def on_startup(**_: Any) -> None:
    """Keep the log of examples off the terminal, and look for garbage rarely.

    The expressions that SymPy keeps are many: to look through all of them as often as usual takes a
    tenth of the time.
    """
    logging.getLogger("safe_envs").addHandler(logging.NullHandler())
    gc.set_threshold(100_000, 20, 50)


def on_config(config: Any) -> Any:
    """Add a page for each env and each filter to the navigation."""
    complete(config.nav)
    return config


def on_files(files: Any, config: Any) -> Any:
    """Add the generated pages and pictures."""
    _made.update(cached("generated", _generated))
    for path in sorted(NOTEBOOKS.glob("*.ipynb")):
        _made.update(cached([path.name, path.read_text()], partial(notebook_pages, path)))
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
        return with_output(markdown, cached)
    except Exception as error:
        raise PluginError(
            f"{page.file.src_uri}: an example does not run: {type(error).__name__}: {error}"
        ) from error


def on_page_content(html: str, **_: Any) -> str:
    """Turn LaTeX into MathML."""
    return with_mathml(html)


def on_post_build(**_: Any) -> None:
    """Forget the results of examples that have changed."""
    forget_unused()


def _generated() -> dict[str, str | bytes]:
    """Return the content by path of all pages and pictures that the code determines."""
    # Not before they are needed: importing everything takes longer than reading what was found.
    # mkdocs has these modules on the path only while it imports this one.
    sys.path.append(str(Path(__file__).parent))
    from commands import command_line_page
    from contract import info_page
    from environments import env_pages
    from pictures import pictures

    return {
        **env_pages(),
        **pictures(),
        "reference/command-line.md": command_line_page(),
        "reference/info.md": info_page(),
        "assets/STIXGeneral.ttf": font(),
    }
