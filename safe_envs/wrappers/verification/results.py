"""A lower bound on the probability of staying safe, and what it is worth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

Status = Literal["estimated", "withheld", "hypothesis fails", "no bound", "not established"]
"""What a bound is worth: no hypothesis was found to fail; it did until episodes contradicted it;
one fails; there is none; or an assumption is known to be false or was not looked at."""


@dataclass(frozen=True)
class Bound:
    """A lower bound on the probability of staying safe.

    Attributes:
        name: of the result.
        value: at the start, or its mean over several; None if there is none.
        error: standard error of that mean as the mean over all starts; 0 for one start.
        status: what it is worth.
        reason: why, in words; may be empty where it is estimated.
        forever: whether it is of all times, not only up to the horizon.
    """

    name: str
    value: float | None
    status: Status
    reason: str
    forever: bool = False
    error: float = 0.0

    def without(self, reason: str) -> Bound:
        """Return the bound as withheld for a reason, if it was estimated and there is one."""
        if not reason or self.status != "estimated":
            return self
        return replace(self, value=None, error=0.0, status="withheld", reason=reason)
