"""The search for an allowed input near a proposed one that is not allowed.

With several inputs the segment from a backup input to the proposed one is a poor choice: to save an
altitude it gives up the heading too. From an allowed input p, let l_i(u) be the smallest value of
barrier i on the plan after u. The slopes of l_i at p, by differences, make it linear, and of the
inputs that keep the linear l_i above the floor, w is the nearest to the proposed one. Points
between p and w are then tried as all others are: what is executed is verified, however wrong the
slopes may be.

w is found by ascent in the multipliers y_i of the dual: w = clip(u + A'y), y_i = max(0, y_i + (c_i
- a_i w)/|a_i|^2), one after the other (Hildreth's method, with the clipped primal of the bounds).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from safe_envs.dynamics.codegen import Components
from safe_envs.proofs.backup_plans import Plans, at_rows

DIFFERENCE = 1e-3
"""Of inputs, in parts of the width of their bounds."""

LEFT = 0.1
"""Part of the room above the floor that the linear model is to leave."""

SWEEPS = 20
"""Of the dual ascent; a rest only makes w another input that is tried."""


def aims(
    plans: Plans,
    law: int,
    x: Components,
    given: tuple[Components, Components],
    floor: float,
) -> Components:
    """Return the inputs w of a law's plans, m components (R,) within their bounds.

    Args:
        plans: that are simulated.
        law: its index.
        x: p components (R,) of the states.
        given: m components (R,) of allowed inputs p, and of the proposed ones.
        floor: below which no barrier may be.
    """
    point, wanted = (np.array(part) for part in given)
    m, size = point.shape
    low, high = (np.array(ends)[:, None] for ends in plans.bounds)
    step = DIFFERENCE * (high - low)
    step = np.where(point + step > high, -step, step)
    tried = np.repeat(point[:, None, :], m + 1, axis=1)
    tried[np.arange(m), np.arange(1, m + 1)] += step
    at = tuple([np.tile(c, m + 1) for c in x])
    _, lows = plans.whole(law, at, tuple(tried.reshape(m, -1)))
    lows = lows.reshape(plans.count, m + 1, size)
    slopes = (lows[:, 1:] - lows[:, :1]) / step
    slopes = np.where(np.isfinite(slopes.sum(axis=1))[:, None], slopes, 0.0)
    room = (1.0 - LEFT) * np.maximum(lows[:, 0] - floor, 0.0)
    needed = (slopes * point).sum(axis=1) - room
    squares = (slopes**2).sum(axis=1)
    counts, squares = squares > 0.0, np.where(squares > 0.0, squares, 1.0)
    found, multipliers = wanted, np.zeros((plans.count, size))
    for _ in range(SWEEPS):
        for i in range(plans.count):
            missing = needed[i] - (slopes[i] * found).sum(axis=0)
            change = np.where(counts[i], missing / squares[i], 0.0)
            multipliers[i] = np.maximum(0.0, multipliers[i] + change)
            found = np.clip(wanted + (slopes * multipliers[:, None]).sum(axis=0), low, high)
    return tuple(found)


_SHARES = (0.75, 0.5, 0.25, 0.0)
"""Points between a backup input, 0, and the proposed one, 1, that are tried at first."""

_PARTS = (0.75, 0.5, 0.25)
"""Points that are then tried between an allowed one and the next."""

_STAGES = (_SHARES, _PARTS, _PARTS)
"""The distance of two points is a quarter of that of the stage before."""

_ON = (1.0, *_PARTS)
"""Points that are tried from an allowed input on towards one that the slopes of the plans show."""


class LastResort(NamedTuple):
    """The inputs of the laws with the best plans; arrays (B,).

    Attributes:
        action: m components.
        heights: the smallest value of each barrier on the plan.
        slack: by how much each barrier is violated there.
        good: whether none is, and the terminal set is reached.
    """

    action: Components
    heights: Components
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
        nearest, found, law = np.inf, None, -1
        for j, begin in enumerate(self._plans.inputs_of_one(x)):
            reached = self._on_segment(x, begin, wanted)
            if reached is not None:
                away = sum((a - b) ** 2 for a, b in zip(reached[0], wanted, strict=True))
                if away < nearest:
                    nearest, found, law = away, reached, j
        if found is None or len(wanted) == 1:
            return found
        at, point, end = [tuple(np.array([c]) for c in each) for each in (x, found[0], wanted)]
        with np.errstate(all="ignore"):
            point, height = self._on(at, point, end, np.array([found[1]]), np.array([law]))
        return [c.item() for c in point], height.item()

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
                if tried.allowed:
                    found, share = (point, tried.height), at
                    break
            if found is None:
                break
            width *= _PARTS[-1]
        return found

    def of_batch(
        self, x: Components, wanted: Components
    ) -> tuple[Components, np.ndarray, np.ndarray]:
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
            segments = [at_rows(each, rows) for each in (at, begin, end)]
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
        law = away.reshape(laws, size).argmin(axis=0)
        chosen = law * size + np.arange(size)
        point, height, found = at_rows(points, chosen), lowest[chosen], away[chosen] < np.inf
        if len(point) > 1:
            point, height = self._on(x, point, wanted, height, np.where(found, law, -1))
        return point, height, found

    def _on(
        self,
        x: Components,
        point: Components,
        wanted: Components,
        height: np.ndarray,
        law: np.ndarray,
    ) -> tuple[Components, np.ndarray]:
        """Go on from allowed inputs as `slope_search` says."""
        table, height = np.array(point), height.copy()
        for j in range(len(self._plans.laws)):
            rows = np.flatnonzero(law == j)
            if not rows.size:
                continue
            at, begin, end = [at_rows(each, rows) for each in (x, point, wanted)]
            aim = aims(self._plans, j, at, (begin, end), self._floor)
            kept, low, part = self._tried((at, begin, aim), np.zeros(rows.size), 1.0, _ON)
            nearer = self._between(begin, aim, part)
            table[:, rows[kept]] = np.array(nearer)[:, kept]
            height[rows[kept]] = low[kept]
        return tuple(table), height

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
        """Try points of segments."""
        size, count = len(share), len(parts)
        at, begin, end = [_repeated(each, count) for each in segments]
        shares = np.concatenate([share + width * part for part in parts])
        found = self._plans.kept_after(at, self._between(begin, end, shares), self._floor)
        kept, low = found.allowed.reshape(count, size), found.height.reshape(count, size)
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
