"""`safe-envs cache`: what is kept of earlier commands, and how much room it takes."""

from __future__ import annotations

from typing import Annotated

import typer

from safe_envs.scripts.options.app import run_alone
from safe_envs.scripts.options.console import Json, require_result, say, stdout, write_result
from safe_envs.scripts.reports.tables import print_rows, size_text


def cache(
    clear: Annotated[
        bool, typer.Option("--clear", help="Remove all of it: what is needed is computed again.")
    ] = False,
    json: Json = None,
) -> None:
    """Print what is kept in the user's cache, or clear it.

    Tables and compiled programs are kept, on which the results of no command depend. What was not
    used for longest is removed where all of it takes more than 2 GB. The environment variable
    SAFE_ENVS_CACHE names another folder; empty, nothing is kept.
    """
    from safe_envs import files

    require_result(json)
    folder = files.cache_folder(next(iter(files.CONTENTS)))
    removed = files.clear() if clear else None
    contents = []
    for name, about in files.CONTENTS.items():
        sizes = [entry.size for entry in files.entries(name)]
        contents.append({"name": name, "about": about, "entries": len(sizes), "bytes": sum(sizes)})
    total = sum(each["bytes"] for each in contents)
    if folder is None:
        say(
            stdout(),
            f"Nothing is kept: {files.VARIABLE} is empty, or there is no folder to which"
            " nobody but you can write.",
        )
    else:
        say(stdout(), f"{folder.parent}", wrap=False)
        rows = [
            (each["name"], str(each["entries"]), size_text(each["bytes"]), each["about"])
            for each in contents
        ]
        stdout().print()
        print_rows(stdout(), "lrrp", ("folder", "entries", "size", ""), rows)
        stdout().print()
        if removed is not None:
            say(stdout(), f"Removed: {size_text(removed)}.")
        say(
            stdout(),
            f"In all {size_text(total)} of at most {size_text(files.MOST_CACHE_BYTES)}; what was"
            " not used for longest is removed first.",
        )
    document = {
        "folder": None if folder is None else str(folder.parent),
        "contents": contents,
        "bytes": total,
        "most_bytes": files.MOST_CACHE_BYTES,
        "removed_bytes": removed,
    }
    write_result(json, lambda: document)


if __name__ == "__main__":
    run_alone("cache", cache)
