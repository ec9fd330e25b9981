"""The numbers of a QP of one state, and what is seen from them at once."""

from __future__ import annotations

from collections.abc import Sequence
from operator import mul

from safe_envs.wrappers.qp.rounding import ROUNDING, Floats


def margins(a: Sequence[Floats], b: Floats, u: Floats) -> tuple[list[float], list[float]]:
    """Return the margins (k) at inputs, and their rounding.

    Args:
        a: k constraints of m coefficients.
        b: k offsets.
        u: m inputs.
    """
    margin, allowed = [], []
    for row, offset in zip(a, b, strict=True):
        terms = [*map(mul, row, u), offset]
        margin.append(sum(terms))
        allowed.append(ROUNDING * sum(map(abs, terms)))
    return margin, allowed


class PlainQP:
    """A QP of one state.

    Attributes:
        start: the clipped proposal.
        margin: of the constraints there.
    """

    def __init__(
        self,
        a: Sequence[Floats],
        b: Floats,
        v: Floats,
        low: Floats,
        high: Floats,
        w: Floats,
        priority: Floats,
    ) -> None:
        """Take a QP; see `dispatch.project_floats`."""
        self.a, self.b, self.v, self.low, self.high = a, b, v, low, high
        self.w, self.priority = w, priority
        self.start = [
            lo if vj < lo else hi if vj > hi else vj
            for vj, lo, hi in zip(v, low, high, strict=True)
        ]
        self.margin = [
            sum(map(mul, row, self.start)) + offset for row, offset in zip(a, b, strict=True)
        ]

    def meets_each(self, rows: list[int]) -> bool:
        """Return whether the input bounds allow to meet each of some constraints by itself.

        Args:
            rows: the constraints.
        """
        for i in rows:
            most = self.b[i]
            for aj, lo, hi in zip(self.a[i], self.low, self.high, strict=True):
                most += aj * (hi if aj > 0.0 else lo)
            if not most >= 0.0:
                return False
        return True
