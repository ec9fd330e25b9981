"""The search for an allowed input near a proposed one that is not allowed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from safe_envs.dynamics.codegen import Components
from safe_envs.wrappers.backup.plans import Plans

_SHARES = (0.75, 0.5, 0.25, 0.0)
"""Points between a backup input, 0, and the proposed one, 1, that are tried at first."""

_PARTS = (0.75, 0.5, 0.25)
"""Points that are then tried between an allowed one and the next."""

_STAGES = (_SHARES, _PARTS, _PARTS)
"""The distance of two points is a quarter of that of the stage before."""


class LastResort(NamedTuple):
    """The inputs of the laws with the best plans; arrays (B,).

    Attributes:
        action: m components.
        lowest: the smallest value of each barrier on the plan.
        slack: by how much each barrier is violated there.
        good: whether none is, and the terminal set is reached.
    """

    action: Components
    lowest: Components
    slack: Components
    good: np.ndarray


class Search:
    """Tries inputs on the segments from the backup laws' inputs to proposed ones.

    Args:
        plans: that show whether an input is allowed.
        floor: below which no barrier may be on a plan.
    """

    def __init__(self, plans: Plans, floor: float) -> None:
        self._plans, self._floor = plans, floor

    def of_one(
        self, x: Sequence[float], wanted: Sequence[float]
    ) -> tuple[list[float], float] | None:
        """Search for one state.

        Args:
            x: p components of the state.
            wanted: m components of the proposed input, within its bounds.

        Returns:
            The nearest input that was found to be allowed, and the smallest barrier on its plan;
            None where there is none.
        """
        nearest, found = np.inf, None
        for begin in self._plans.inputs_of_one(x):
            reached = self._on_segment(x, begin, wanted)
            if reached is not None:
                away = sum((a - b) ** 2 for a, b in zip(reached[0], wanted, strict=True))
                if away < nearest:
                    nearest, found = away, reached
        return found

    def _on_segment(
        self, x: Sequence[float], begin: Sequence[float], end: Sequence[float]
    ) -> tuple[list[float], float] | None:
        found, share, width = None, 0.0, 1.0
        for parts in _STAGES:
            for part in parts:
                at = share + width * part
                point = [
                    min(max(a + at * (b - a), low), high)
                    for a, b, low, high in zip(begin, end, *self._plans.bounds, strict=True)
                ]
                tried = self._plans.kept_after_one(x, point, self._floor)
                if tried.kept:
                    found, share = (point, tried.lowest), at
                    break
            if found is None:
                break
            width *= _PARTS[-1]
        return found

    def of_batch(
        self, x: Components, wanted: Components
    ) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
        """Search for a batch, as `of_one` does.

        Args:
            x: p components (R,) of the states.
            wanted: m components (R,) of the proposed inputs, within their bounds.

        Returns:
            m components (R,) of inputs, the smallest barriers on their plans, and whether they are
            allowed.
        """
        begins, size = self._plans.inputs(x), len(x[0])
        laws = len(begins)
        begin = tuple([np.concatenate(parts) for parts in zip(*begins, strict=True)])
        at, end = _repeated(x, laws), _repeated(wanted, laws)
        share, lowest, width = np.zeros(laws * size), np.empty(laws * size), 1.0
        rows = np.arange(laws * size)
        for parts in _STAGES:
            segments = [_at(each, rows) for each in (at, begin, end)]
            kept, low, part = self._tried(segments, share[rows], width, parts)
            now = rows[kept]
            share[now] += width * part[kept]
            lowest[now] = low[kept]
            rows, width = (now if parts is _SHARES else rows), width * _PARTS[-1]
            if not rows.size:
                break
        away = np.full(laws * size, np.inf)
        points = self._between(begin, end, share)
        away[rows] = sum((a - b)[rows] ** 2 for a, b in zip(points, end, strict=True))
        chosen = away.reshape(laws, size).argmin(axis=0) * size + np.arange(size)
        return [c[chosen] for c in points], lowest[chosen], away[chosen] < np.inf

    def _between(self, begin: Components, end: Components, share: np.ndarray) -> Components:
        """Return the points of segments at shares of them."""
        ends = self._plans.ends
        return tuple(
            [np.clip(a + share * (b - a), *c) for a, b, c in zip(begin, end, ends, strict=True)]
        )

    def _tried(
        self,
        segments: Sequence[Components],
        share: np.ndarray,
        width: float,
        parts: Sequence[float],
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Try points of segments.

        Args:
            segments: components (R,) of the states, and of where the segments begin and end.
            share: of the segments from which on points are tried, shape (R,).
            width: up to how much more.
            parts: of the width, the largest first.

        Returns:
            Whether one of the points is allowed, the smallest barrier on the plan of the first that
            is, and its part.
        """
        size, count = len(share), len(parts)
        at, begin, end = [_repeated(each, count) for each in segments]
        shares = np.concatenate([share + width * part for part in parts])
        found = self._plans.kept_after(at, self._between(begin, end, shares), self._floor)
        kept, low = found.kept.reshape(count, size), found.lowest.reshape(count, size)
        which = kept.argmax(axis=0)
        return kept.any(axis=0), low[which, np.arange(size)], np.array(parts)[which]

    def last_resort(self, x: Components) -> LastResort:
        """Return the inputs of the laws with the best plans, where nothing else is allowed.

        Args:
            x: p components (B,) of the states.
        """
        best: list[Any] = []
        for law, u in enumerate(self._plans.inputs(x)):
            entered, lows = self._plans.whole(law, x, u)
            low = lows.min(axis=0)
            new = [np.array(u), lows, low, entered & (low >= 0.0)]
            if not best:
                best = new
                continue
            better = np.where(new[3] == best[3], low > best[2], new[3])
            for old, other in zip(best, new, strict=True):
                old[..., better] = other[..., better]
        action, lows, _, good = best
        slack = np.where(good, 0.0, np.maximum(-lows, 0.0))
        return LastResort(tuple(action), tuple(lows), tuple(slack), good)


def _repeated(components: Components, count: int) -> Components:
    return tuple([np.tile(c, count) for c in components])


def _at(components: Components, rows: np.ndarray) -> Components:
    return tuple([c[rows] for c in components])
