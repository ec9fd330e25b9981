"""The page of the leaderboard: its part that a command writes."""

from __future__ import annotations

import os
import re
from pathlib import Path

from safe_envs.atomic_io import require_writable, write_atomically
from safe_envs.bounded_reading import read_bytes
from safe_envs.errors import ConfigurationError

BEGIN, END = "<!-- leaderboard -->", "<!-- end of leaderboard -->"
"""The lines between which it is."""

_PART = re.compile(
    rf"((?:.*\n)?{re.escape(BEGIN)}(\r?\n))(?:.*\n)?({re.escape(END)}(?:\r?\n.*)?)", re.DOTALL
)
"""A page: up to the first line, the end of that line, and from the second line on."""


def put_into(page: Path, markdown: str | None) -> None:
    """Replace the part of a page between the two lines, and nothing else of it.

    Args:
        page: Markdown file.
        markdown: what is to be there; None to check the page only.

    Raises:
        ConfigurationError: the page cannot be read or written, or has not each line once, in this
            order.
    """
    try:
        text = read_bytes(page).decode()
    except OSError as error:
        raise ConfigurationError(
            f"--page {page} cannot be read ({error.strerror}); give a page that is there"
        ) from error
    except UnicodeDecodeError as error:
        raise ConfigurationError(
            f"--page {page} is no text in UTF-8 ({error}); give a page of Markdown"
        ) from error
    found = _PART.fullmatch(text)
    if found is None or text.count(BEGIN) != 1 or text.count(END) != 1:
        raise ConfigurationError(
            f"--page {page} needs the line {BEGIN} and below it the line {END}, each once; what is"
            " between them is replaced"
        )
    require_writable(page)
    if markdown is not None:
        before, newline, after = found.groups()
        lines = f"\n{markdown}\n\n".replace("\n", newline)
        whole = f"{before}{lines}{after}"
        write_atomically(page, lambda part: part.write_bytes(whole.encode()))


def link_from(page: Path | None, file: Path) -> str:
    """Return the link to a file in a page; without a page as it is seen from here.

    Args:
        page: that has the link.
        file: it leads to.
    """
    if page is None:
        return file.as_posix()
    return Path(os.path.relpath(file.resolve(), page.resolve().parent)).as_posix()
