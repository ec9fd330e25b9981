"""What `safe-envs export` prints."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from rich.console import Console
from rich.markup import escape

from safe_envs.export.comparison import CComparison
from safe_envs.export.interface import Interface
from safe_envs.scripts.options.console import say
from safe_envs.scripts.reports.tables import make_table, print_whole
from safe_envs.text import visible


@dataclass(frozen=True)
class ExportAnswer:
    """An exported filter.

    Attributes:
        title: of the env.
        config: what was asked for.
        folder: where the files are.
        interface: of the C.
        comparison: with Python, if it was asked for.
    """

    title: str
    config: dict[str, Any]
    folder: str
    interface: Interface
    comparison: CComparison | None

    def document(self) -> dict[str, Any]:
        """Return all that was found, for JSON."""
        quantities = {
            part: [dataclasses.asdict(q) for q in getattr(self.interface, part)]
            for part in ("states", "runtime", "inputs")
        }
        made = self.comparison is not None and self.comparison.was_made
        return {
            "config": self.config,
            "folder": self.folder,
            "name": self.interface.name,
            "filter": self.interface.title,
            "barriers": dict(zip(self.interface.barriers, self.interface.formulas, strict=True)),
            "precision": self.interface.real,
            **quantities,
            "constraints": list(self.interface.constraints),
            "comparison": dataclasses.asdict(self.comparison) if made and self.comparison else None,
        }


def print_export(console: Console, answer: ExportAnswer) -> None:
    """Print where the files are, and how the C compares with Python.

    Args:
        console: to print on.
        answer: what was exported.
    """
    interface, name = answer.interface, answer.interface.name
    console.print(
        f"[bold]{escape(visible(answer.title))}[/]: {escape(interface.title)}", highlight=False
    )
    say(
        console,
        f"C99 in {interface.real} precision is in {answer.folder}: {name}_decide takes"
        f" a state and a proposed input. README.md there has names, units and order, and says how"
        " to compile it.",
    )
    found = answer.comparison
    if found is None:
        return
    if not found.was_made:
        say(
            console,
            "No comparison was made: there is no C compiler. Install cc, gcc or clang, or name one"
            " by CC=...",
        )
        return
    table = make_table("lr", f"built with {escape(found.compiler)}", "")
    rows = [
        ("states", f"{found.states:,}"),
        ("  infeasible", f"{found.infeasible:,}"),
        ("  a constraint says nothing of the input", f"{found.without_effect:,}"),
        ("  refused: not finite, or no finite constraint", f"{found.invalid:,}"),
        ("flags that differ", f"{found.flags_different:,}"),
        ("  where the margin is rounding", f"{found.flags_close:,}"),
        ("actions outside their bounds", f"{found.out_of_bounds:,}"),
        ("largest error of an action, of the largest input", f"{found.largest_error:.2g}"),
        ("  actions beyond 1e-12, or 1e-5 of floats", f"{found.beyond:,}"),
        ("largest error of an action, of its size", f"{found.largest_relative_error:.2g}"),
        ("processor time of a call", f"{found.nanoseconds:,.0f} ns"),
    ]
    for what, number in rows:
        table.add_row(what, number)
    print_whole(console, table)
