"""The table of an evaluation in HTML, as notebooks show it: no script, no color of its own."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from safe_envs.agents.evaluation.notes import evaluation_notes
from safe_envs.agents.evaluation.results import EvaluationData
from safe_envs.agents.evaluation.table import (
    compared,
    describe,
    evaluation_table,
    interval_name,
    marks_in,
    setting_lines,
)
from safe_envs.text import Column, visible

_WIDTH = 80
"""Of a table, in characters: about what the column of a page holds."""

_CELL = "padding:.2em .7em;vertical-align:bottom;border:0;"
_RULE = "border-bottom:1px solid currentColor;"


def html_table(evaluation: EvaluationData) -> str:
    """Return a heading, a table with a row for each filter, comparisons and notes, as HTML.

    Colors are those of the page, so that it can be read on a dark one too.

    Args:
        evaluation: to show.
    """
    table = evaluation_table(evaluation)
    first, *others = [_table([c.column for c in each]) for each in table.arranged(_WIDTH)]
    lines = marks_in(table.columns)
    differences = compared(evaluation)
    if differences:
        heading = "Difference of the safety rates on the same episodes"
        lines.append(f"{heading} [{interval_name(evaluation)}]:")
        lines += map(describe, differences)
    heading = f"<b>{_shown(evaluation.title)}</b> | {_shown(evaluation.about)}"
    heading = "<br>".join([heading, *map(_shown, setting_lines(evaluation))])
    parts = [_paragraph(heading), first, *map(_paragraph, map(_shown, table.facts)), *others]
    if lines:
        parts.append(_paragraph("<br>".join(map(_shown, lines))))
    notes = [f"Note: {_shown(note)}" for note in evaluation_notes(evaluation)]
    if notes:
        parts.append(_paragraph(f"<small>{'<br>'.join(notes)}</small>"))
    return f"<div>{''.join(parts)}</div>"


def _shown(text: str) -> str:
    """Return a text as HTML that shows the same characters, and control characters as escapes."""
    return escape(visible(text))


def _paragraph(html: str) -> str:
    return f'<p style="margin:.4em 0;font-size:90%;overflow-wrap:anywhere">{html}</p>'


def _table(columns: Sequence[Column]) -> str:
    """Return a table that scrolls by itself; its class keeps a page's own look away from it."""
    head = "".join(map(_title, columns))
    rows = zip(*(column.cells for column in columns), strict=True)
    body = "".join(
        f"<tr>{''.join(_cell(*each) for each in zip(columns, cells, strict=True))}</tr>"
        for cells in rows
    )
    return (
        '<div style="overflow-x:auto;margin:.6em 0"><table class="safe-envs-evaluation"'
        ' style="border-collapse:collapse;font-size:90%;margin:0;border:0">'
        f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def _title(column: Column) -> str:
    style = f"{_align(column)}{_CELL}{_RULE}"
    return f'<th scope="col" style="{style}">{_shown(column.plain_title)}</th>'


def _cell(column: Column, text: str) -> str:
    # A number stays on one line with its interval; titles and long names take several.
    breaks = "white-space:nowrap;" if column.kind == "r" else "overflow-wrap:anywhere;"
    return f'<td style="{_align(column)}{_CELL}{breaks}">{_shown(text)}</td>'


def _align(column: Column) -> str:
    return "text-align:right;" if column.kind == "r" else "text-align:left;min-width:9em;"
