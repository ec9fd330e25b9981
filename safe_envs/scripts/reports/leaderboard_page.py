"""The page of the leaderboard: its part that a command writes."""

from __future__ import annotations

import os
from pathlib import Path

from safe_envs.atomic_io import write_atomically
from safe_envs.bounded_reading import read_bytes
from safe_envs.errors import ConfigurationError

BEGIN, END = "<!-- leaderboard -->", "<!-- end of leaderboard -->"
"""The lines between which it is."""


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
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"--page {page} cannot be read ({error}); give a page") from error
    before, begin, rest = text.partition(f"{BEGIN}\n")
    _, end, after = rest.partition(f"{END}\n")
    if not (begin and end) or text.count(BEGIN) != 1 or text.count(END) != 1:
        raise ConfigurationError(
            f"--page {page} needs the line {BEGIN} and below it the line {END}, each once; what is"
            " between them is replaced"
        )
    if markdown is not None:
        whole = f"{before}{begin}\n{markdown}\n\n{end}{after}"
        write_atomically(page, lambda part: part.write_text(whole))


def link_from(page: Path | None, file: Path) -> str:
    """Return the link to a file in a page; without a page as it is seen from here.

    Args:
        page: that has the link.
        file: it leads to.
    """
    if page is None:
        return file.as_posix()
    return Path(os.path.relpath(file.resolve(), page.resolve().parent)).as_posix()
