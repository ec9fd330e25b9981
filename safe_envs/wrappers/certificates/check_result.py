"""What a check of a certificate found."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np

Word = Literal["checked", "refuted", "undecided"]


class StatementCheck(NamedTuple):
    """What was found of one statement of a certificate.

    Attributes:
        name: of the statement.
        word: checked, refuted or undecided.
        boxes: that were looked at.
        seconds: that it took.
        state: at which a refuted statement is wrong, or the middle of a box that is undecided.
        reason: what is known of it.
    """

    name: str
    word: Word
    boxes: int = 0
    seconds: float = 0.0
    state: np.ndarray | None = None
    reason: str = ""

    def as_dict(self) -> dict[str, Any]:
        """Return all as JSON-able data."""
        state = None if self.state is None else [float(x) for x in self.state]
        return {**self._asdict(), "state": state}


class CheckResult(NamedTuple):
    """What was found of a certificate.

    Attributes:
        word: checked, refuted or undecided.
        statement: name of the first statement that is refuted or else undecided; empty if checked.
        state: of that statement.
        boxes: that were looked at.
        parts: what was found of each statement.
    """

    word: Word
    statement: str
    state: np.ndarray | None
    boxes: int
    parts: tuple[StatementCheck, ...]


def combined(parts: list[StatementCheck]) -> CheckResult:
    """Return what the statements say together: checked only if all of them are."""
    words: tuple[Word, ...] = ("refuted", "undecided")
    worst = next((part for word in words for part in parts if part.word == word), None)
    boxes = sum(part.boxes for part in parts)
    if worst is None:
        return CheckResult("checked", "", None, boxes, tuple(parts))
    return CheckResult(worst.word, worst.name, worst.state, boxes, tuple(parts))
