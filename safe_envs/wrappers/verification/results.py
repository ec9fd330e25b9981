"""What is known of the probability of staying safe: single bounds, and the guarantee of a filter."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np

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


class Guarantee(Protocol):
    """The largest lower bound on the probability of staying safe that is estimated for a filter.

    Attributes:
        note: why there is none; None if there is one.
        remark: why it is weaker than what holds where the conditions can be met everywhere; may be
            empty.
    """

    @property
    def note(self) -> str | None:
        """Why there is none."""
        ...

    @property
    def remark(self) -> str:
        """Why it is weak."""
        ...

    def at(self, starts: np.ndarray, horizon: float) -> np.ndarray:
        """Return the bound on P(safe up to the horizon) at each start; 0 where there is none.

        Args:
            starts: states, shape (B, n).
            horizon: T in s.

        Returns:
            Values in [0, 1], shape (B,).
        """
        ...

    def contradiction(
        self, reached: np.ndarray, violated: np.ndarray, actions: np.ndarray, slack: np.ndarray
    ) -> str:
        """Say what states contradict in the numbers of the bound; "" if nothing.

        Args:
            reached: states that were reached, starts among them, shape (B, n).
            violated: states where the filter violated its conditions, shape (E, n).
            actions: what it executed there, shape (E, m).
            slack: by how much it reports to have violated them, shape (E,).
        """
        ...
