"""What the judge says of the hypotheses of the bounds, as a report."""

from __future__ import annotations

import numpy as np
from rich.console import Console
from rich.text import Text

from safe_envs.problem.problem import SafetyProblem
from safe_envs.scripts.options.console import say
from safe_envs.scripts.reports.quantities import state_text
from safe_envs.scripts.reports.tables import print_rows
from safe_envs.scripts.reports.verify_answer import VerifyAnswer
from safe_envs.wrappers.verification.judge import JudgeResult

_COLORS = {"proved": "green", "refuted": "red", "undecided": "yellow"}


def print_statements(console: Console, answer: VerifyAnswer) -> None:
    """Print a table of the statements that the bounds ask for.

    Args:
        console: to print on.
        answer: with the statements.
    """
    statements = answer.statements
    if not statements:
        return
    say(console, Text.assemble(("\nHypotheses, judged", "bold"), f" {answer.judged_region}"))
    rows = [
        (
            text,
            Text(verdict.word, style=_COLORS[verdict.word]),
            f"{verdict.boxes:,}",
            _why(answer.verification.problem, verdict),
        )
        for text, verdict in statements
    ]
    print_rows(console, "plrp", ("statement", "word", "boxes", "where, or why not"), rows)
    if any(verdict.word == "undecided" for _, verdict in statements):
        say(
            console,
            "Undecided: neither proved nor refuted. It may take more boxes, a smaller workspace, or"
            " another form of the same expressions.",
        )


def _why(problem: SafetyProblem, verdict: JudgeResult) -> str:
    if verdict.word == "refuted" and verdict.state is not None and len(verdict.state):
        return f"fails at {state_text(problem, verdict.state)}"
    if verdict.word == "undecided" and verdict.box is not None:
        return f"{verdict.reason}; open in {_box_text(problem, verdict.box)}"
    return verdict.reason


def _box_text(problem: SafetyProblem, box: np.ndarray) -> str:
    ends = zip(problem.states, *box.tolist(), strict=True)
    return ", ".join(f"{s.symbol} in [{low:.3g}, {high:.3g}]" for s, low, high in ends)
