r"""The table of an evaluation in LaTeX, for a paper: booktabs is all that it needs."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence
from dataclasses import replace

from safe_envs.agents.evaluation.notes import evaluation_notes
from safe_envs.agents.evaluation.results import EvaluationData
from safe_envs.agents.evaluation.statistics import points_in
from safe_envs.agents.evaluation.table import (
    compared,
    evaluation_table,
    interval_name,
    marks_in,
    p_text,
    setting_lines,
)
from safe_envs.text import SOFT_HYPHEN, Column, FittedTable, arranged, columns_of, folded, visible

_WIDTH = 80
_NAMES = 0.38
"""Width of names that take several lines, of that of a line."""

_ESCAPED = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "^": r"\textasciicircum{}",
    "~": r"\textasciitilde{}",
    "<": "$<$",
    ">": "$>$",
    ">=": r"$\geq$",
    "<=": r"$\leq$",
    "|": r"\textbar{}",
    '"': r"\char34{}",
    "'": r"\char39{}",
    "`": r"\char96{}",
    "\u2212": "$-$",
    "\u00a0": "~",
    "\u00ad": "",
    **{sign: f"\\{sign}" for sign in "&%$#_"},
}
_MINUS = re.compile(r"(?<![^\s\[])-(?=[\d.])")
_SIGNS = re.compile(r">=|<=|-{2,}|.", re.DOTALL)
"""What is escaped together; two hyphens would be set as a dash."""

_LETTERS = "Ææß¡¿"
"""Letters beyond ASCII without a decomposition that LaTeX's standard fonts have."""

_ACCENTS = "\u0300\u0301\u0302\u0303\u0308\u030a\u0327\u030c"


_GREEK = re.compile(
    r"GREEK SMALL LETTER (ALPHA|BETA|GAMMA|DELTA|EPSILON|ZETA|ETA|THETA|IOTA|KAPPA|LAMDA|MU|NU|XI"
    r"|PI|RHO|SIGMA|TAU|UPSILON|PHI|CHI|PSI|OMEGA)"
)


def latex_table(evaluation: EvaluationData) -> str:
    """Return a floating table with a row for each filter, the comparisons of filters, and notes.

    Args:
        evaluation: to show.

    Returns:
        LaTeX that needs the package booktabs.
    """
    table = evaluation_table(evaluation)
    # Titles are broken between words only: a paper has more room than a terminal.
    columns = [replace(c, title=c.title.replace(SOFT_HYPHEN, "")) for c in table.columns]
    tabulars = [_tabular(each) for each in arranged([table.names], columns, _WIDTH)]
    differences = compared(evaluation)
    if differences:
        tabulars.append(_compared(evaluation))
    facts = "".join(f" {escape(fact[:1].upper() + fact[1:])}." for fact in table.facts)
    body = "\n\n\\medskip\n".join(tabulars)
    return (
        "% \\usepackage{booktabs}\n"
        "\\begin{table}\n"
        "\\centering\n"
        "\\footnotesize\n"
        f"\\caption{{{_caption(evaluation)}{facts}}}\n"
        f"\\label{{{_label(evaluation)}}}\n"
        f"{body}\n"
        f"{_notes(evaluation)}"
        "\\end{table}"
    )


def escape(text: str) -> str:
    """Return a text as LaTeX that sets the same characters.

    A letter that the standard fonts of LaTeX lack is set as its number in Unicode, "U+4E2D".

    Args:
        text: with any characters.
    """
    return "".join(map(_sign, _SIGNS.findall(_MINUS.sub("\u2212", visible(text)))))


def _sign(sign: str) -> str:
    if sign in _ESCAPED:
        return _ESCAPED[sign]
    if sign.startswith("--"):
        return "{}".join(sign)
    if sign.isascii():
        return sign if sign.isprintable() else " "
    decomposed = unicodedata.normalize("NFD", sign)
    if sign in _LETTERS or (
        len(decomposed) == 2 and decomposed[0].isascii() and decomposed[1] in _ACCENTS
    ):
        return sign
    greek = _GREEK.fullmatch(unicodedata.name(sign, ""))
    if greek:
        return f"$\\{greek[1].lower().replace('lamda', 'lambda')}$"
    return f"U+{ord(sign):04X}"


def _tabular(table: FittedTable) -> str:
    """Return a table with titles of one or two lines, broken as in a terminal."""
    height = max(len(column.title) for column in table)
    titles = zip(*(_bottom(column.title, height) for column in table), strict=True)
    rows = zip(*(column.cells for column in table), strict=True)
    return _framed([column.column for column in table], [*titles], [*rows])


def _compared(evaluation: EvaluationData) -> str:
    rows = [
        (
            folded(f"{c.first} - {c.second}", _WIDTH // 2),
            points_in(c.difference, c.ci_low, c.ci_high, unit=""),
            "-" if c.mcnemar_p is None else p_text(c.mcnemar_p).removeprefix("= "),
            f"{c.only_first} / {c.only_second}",
        )
        for c in compared(evaluation)
    ]
    titles = (
        ("difference of", "points", "McNemar", "safe with"),
        ("safety rates", f"[{interval_name(evaluation)}]", "p", "one only"),
    )
    return _framed(columns_of("lr", titles[1], rows), titles, rows)


def _framed(
    columns: Sequence[Column], titles: Sequence[Sequence[str]], rows: Sequence[Sequence[str]]
) -> str:
    kinds = "".join("r" if column.kind == "r" else "l" for column in columns)
    if any("\n" in cells[0] for cells in rows):
        # Long names take several lines.
        kinds = f"p{{{_NAMES}\\linewidth}}{kinds[1:]}"
    lines = [
        f"\\begin{{tabular}}{{@{{}}{kinds}@{{}}}}",
        "\\toprule",
        *(_row(cells) for cells in titles),
        "\\midrule",
        *(_row(cells) for cells in rows),
        "\\bottomrule",
        "\\end{tabular}",
    ]
    return "\n".join(lines)


def _row(cells: Sequence[str]) -> str:
    # Braces, since after the end of a row LaTeX takes a bracket or a star for an option.
    return " & ".join(f"{{{_cell(str(cell))}}}" for cell in cells) + " \\\\"


def _cell(text: str) -> str:
    lines = [escape(line) for line in text.split("\n")]
    return lines[0] if len(lines) == 1 else "\\raggedright " + "\\newline ".join(lines)


def _notes(evaluation: EvaluationData) -> str:
    notes = [f"Note: {escape(note)}\\par\n" for note in evaluation_notes(evaluation)]
    if not notes:
        return ""
    # In a box, or else each would be centered.
    return (
        "\n\\medskip\n\\begin{minipage}{\\linewidth}\n\\raggedright\n"
        f"{''.join(notes)}\\end{{minipage}}\n"
    )


def _bottom(lines: Sequence[str], height: int) -> list[str]:
    return [""] * (height - len(lines)) + list(lines)


def _caption(evaluation: EvaluationData) -> str:
    config, settings = evaluation.config, setting_lines(evaluation)
    text = (
        f"Safety of the policy {config['policy']['name']} on {evaluation.title}:"
        f" {evaluation.counted} from the seed {config['seed']}; {'. '.join(settings)}."
        f" Brackets: {interval_name(evaluation)}."
    )
    marks = "; ".join(marks_in(evaluation_table(evaluation).columns))
    return escape(text + (f" Bounds: {marks}." if marks else ""))


def _label(evaluation: EvaluationData) -> str:
    name = unicodedata.normalize("NFKD", evaluation.title).encode("ascii", "ignore").decode()
    slug = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")
    return f"tab:{slug or 'evaluation'}"
