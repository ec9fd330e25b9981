"""Copies that share nothing with what they were made of."""

from __future__ import annotations

import copy
from typing import Self


class IndependentCopies:
    """Base of what holds a state that changes: `copy.copy` of it is `copy.deepcopy`.

    A shallow copy in mid-episode would have the clock, the counters and the noise of its original.
    """

    def __copy__(self) -> Self:
        return copy.deepcopy(self)
