"""What is said of the engine under a table."""

from __future__ import annotations

from collections.abc import Sequence


def engine_notes(rows: Sequence[tuple[str, str, int]]) -> list[str]:
    """Return which rows are of the compiled engine.

    Args:
        rows: filter, engine and threads of each.
    """
    compiled = [(name, jobs) for name, engine, jobs in rows if engine == "compiled"]
    if not compiled:
        return []
    names = "" if len(compiled) == len(rows) else f" of {', '.join(name for name, _ in compiled)}"
    jobs = compiled[0][1]
    threads = f"{jobs} threads" if jobs > 1 else "one thread"
    return [f"the steps/s{names} are those of the compiled engine, in {threads}."]
