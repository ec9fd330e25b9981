"""The progress of the parts of some work."""

from __future__ import annotations

from safe_envs.agents.evaluation.spec import Progress


class WorkParts:
    """The progress of a number of equal parts of some work, one after the other.

    Args:
        progress: called with the part of the whole work that is done, from 0 to 1.
        parts: how many there are.
    """

    def __init__(self, progress: Progress | None, parts: int) -> None:
        self._progress, self._parts, self._begun = progress, parts, 0

    def part(self, whole: float = 1.0) -> Progress | None:
        """Return the progress of the next part, to be called with how much of `whole` is done."""
        before, self._begun = self._begun, self._begun + 1
        report = self._progress
        return (
            None if report is None else lambda done: report((before + done / whole) / self._parts)
        )
