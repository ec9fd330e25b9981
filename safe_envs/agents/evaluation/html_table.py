"""The table of an evaluation in HTML, as notebooks show it: no script, no color of its own."""

from __future__ import annotations

from html import escape

from safe_envs.agents.evaluation.bound_marks import marks_in
from safe_envs.agents.evaluation.evaluation_data import EvaluationData
from safe_envs.agents.evaluation.evaluation_table import (
    compared,
    describe,
    evaluation_table,
    interval_name,
)
from safe_envs.text_tables import Column

_CELL = "padding:.2em .7em;white-space:nowrap;vertical-align:bottom;"
_RULE = "border-bottom:1px solid currentColor;"
_SMALL = "margin:.4em 0;font-size:90%"


def html_table(evaluation: EvaluationData) -> str:
    """Return a heading, a table with a row for each filter, and comparisons, as HTML.

    Colors are those of the page, so that it can be read on a dark one too.

    Args:
        evaluation: to show.
    """
    table = evaluation_table(evaluation)
    columns = [table.names, *table.columns]
    rows = zip(*(column.cells for column in columns), strict=True)
    body = "".join(
        f"<tr>{''.join(_cell(*each) for each in zip(columns, cells, strict=True))}</tr>"
        for cells in rows
    )
    lines = [*table.facts, *marks_in(table.columns)]
    differences = compared(evaluation)
    if differences:
        heading = "Difference of the safety rates on the same episodes"
        lines.append(f"{heading} [{interval_name(evaluation)}]:")
        lines += map(describe, differences)
    told = "<br>".join(map(escape, lines))
    head = "".join(map(_title, columns))
    heading = f"<b>{escape(evaluation.title)}</b> | {escape(evaluation.about)}"
    under = f'<p style="{_SMALL}">{told}</p>' if lines else ""
    return (
        f'<div><p style="{_SMALL}">{heading}</p>'
        '<div style="overflow-x:auto"><table style="border-collapse:collapse;font-size:90%">'
        f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>{under}</div>"
    )


def _title(column: Column) -> str:
    style = f"{_align(column)}{_CELL}{_RULE}"
    return f'<th scope="col" style="{style}">{escape(column.plain_title)}</th>'


def _cell(column: Column, text: str) -> str:
    return f'<td style="{_align(column)}{_CELL}">{escape(text)}</td>'


def _align(column: Column) -> str:
    return f"text-align:{'right' if column.kind == 'r' else 'left'};"
