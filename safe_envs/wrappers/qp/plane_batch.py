"""`safe_envs.wrappers.qp.plane` for a batch of states, with masks in place of branches.

The states that violate the constraint in turn are gathered and moved onto its line, so that the
number of NumPy calls grows with the number of constraints and not with the batch. Every number
comes from the same operations in the same order as for one state.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from safe_envs.wrappers.qp.min_slack import is_unique, least_violating
from safe_envs.wrappers.qp.rounding import ROUNDING, ArrayAnswer, Arrays, Entries, stack, tolerances


class Plane(NamedTuple):
    """Problems of B states; pairs of inputs in front.

    Attributes:
        a: coefficients, shape (2, k, B).
        b: offsets, shape (k, B).
        v: proposals, shape (2, B).
        low: lower bounds, shape (2, B).
        high: upper bounds, shape (2, B).
        w: positive weights, shape (2, B).
    """

    a: np.ndarray
    b: np.ndarray
    v: np.ndarray
    low: np.ndarray
    high: np.ndarray
    w: np.ndarray

    def take(self, states: np.ndarray) -> Plane:
        """Return some states of the batch."""
        return Plane(*[part[..., states] for part in self])

    def clip(self, u: np.ndarray) -> np.ndarray:
        """Return inputs (2, B) clipped to their bounds."""
        return np.minimum(np.maximum(u, self.low), self.high)

    def margin(self, u: np.ndarray) -> np.ndarray:
        """Return the margins (k, B) at inputs (2, B)."""
        return self.a[0] * u[0] + self.a[1] * u[1] + self.b

    def scale(self, u: np.ndarray, away: np.ndarray | float = 0.0) -> np.ndarray:
        """Return how far each input can go (2, B).

        It goes to its bound, or as far as u and `away` in the metric of the objective.

        Args:
            u: inputs, shape (2, B).
            away: how far more, shape (B,).
        """
        root = np.sqrt(self.w)
        reach = root[0] * np.abs(u[0]) + root[1] * np.abs(u[1]) + away
        return np.minimum(np.maximum(-self.low, self.high), reach / root)

    def met(self, u: np.ndarray, margin: np.ndarray) -> np.ndarray:
        """Return whether all constraints are met (B,).

        Args:
            u: inputs, shape (2, B).
            margin: the constraints' there, shape (k, B).
        """
        return (margin >= -tolerances(self.a, self.b, u)).all(axis=0)

    def binds(self, u: np.ndarray, margin: np.ndarray) -> np.ndarray:
        """Return whether a margin exceeds zero by no more than rounding (k, B).

        Args:
            u: inputs, shape (2, B).
            margin: the constraints' there, shape (k, B).
        """
        s1, s2 = self.scale(u)
        return (margin <= 0.0) | (
            margin <= ROUNDING * (np.abs(self.b) + np.abs(self.a[0]) * s1 + np.abs(self.a[1]) * s2)
        )


@np.errstate(all="ignore")
def project_arrays(
    a: Sequence[Entries],
    b: Entries,
    v: Arrays,
    low: Entries,
    high: Entries,
    w: Entries,
    otherwise: Callable[[Sequence[np.ndarray]], ArrayAnswer],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Project the inputs of B states.

    Args:
        a: k constraints of two coefficients, each a float or an array (B,).
        b: k offsets, likewise.
        v: two arrays (B,) of proposed inputs.
        low: two lower bounds, each a float or an array (B,).
        high: two upper bounds, likewise.
        w: two positive weights, likewise.
        otherwise: finds inputs, margins and whether constraints can be met, from all of these in
            arrays, where the constraints cannot be met, or by rounding only.

    Returns:
        Inputs (2, B), margins (k, B), constraints that bind or cannot be met (k, B), and whether
        all constraints can be met (B,).
    """
    size = len(v[0])
    a_of_input = np.array([stack([row[j] for row in a], size) for j in (0, 1)])
    plane = Plane(a_of_input, stack(b, size), *[stack(pair, size) for pair in (v, low, high, w)])
    u = plane.clip(plane.v)
    margin = plane.margin(u)
    active, feasible = np.zeros(margin.shape, dtype=bool), np.ones(size, dtype=bool)
    acting = np.flatnonzero((margin < 0.0).any(axis=0))
    if acting.size:
        part = plane.take(acting)
        moved, met = _nearest(part)
        reached = part.margin(moved)
        met &= part.met(moved, reached)
        unmet = np.flatnonzero(~met)
        if unmet.size:
            rows, *others = part.take(unmet)
            least, missed, _, met[unmet] = otherwise([np.swapaxes(rows, 0, 1), *others])
            moved[:, unmet], reached[:, unmet] = least, missed
        u[:, acting], margin[:, acting], feasible[acting] = moved, reached, met
        active[:, acting] = part.binds(moved, reached)
    return u, margin, active, feasible


def project_single(
    a: np.ndarray,
    b: np.ndarray,
    v: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    w: np.ndarray,
    priority: np.ndarray,
) -> np.ndarray:
    """Return the nearest inputs (2,) of those that violate the constraints of one state least.

    Args:
        a: constraints, shape (k, 2).
        b: offsets, shape (k,).
        v: proposed inputs, shape (2,).
        low: lower bounds, shape (2,).
        high: upper bounds, shape (2,).
        w: positive weights, shape (2,).
        priority: positive weights of the squared slacks, shape (k,).
    """
    plane = Plane(a.T[:, :, None], *[part[:, None] for part in (b, v, low, high, w)])
    u, met = _nearest(plane)
    if not (met & plane.met(u, plane.margin(u))).all():
        u = _nearest_of_least_violating(plane, priority)
    return u[:, 0]


def _nearest_of_least_violating(plane: Plane, priority: np.ndarray) -> np.ndarray:
    """Return the action nearest to v of those with the least sum of squared slacks.

    All of these have the same slacks.
    """
    u = least_violating(plane.a, plane.b, plane.low, plane.high, priority, plane.clip(plane.v))
    several = np.flatnonzero(~is_unique(plane.a, plane.b, u))
    if several.size:
        part, least = plane.take(several), u[:, several]
        line = -(part.a[0] * least[0] + part.a[1] * least[1])
        nearest, met = _nearest(part._replace(b=np.maximum(part.b, line)))
        # A step of rounding size would only move an input off the end of its interval.
        away = (np.abs(nearest - least) > ROUNDING * part.scale(least)).any(axis=0)
        u[:, several] = np.where(met & away, nearest, least)
    return u


def _nearest(plane: Plane) -> tuple[np.ndarray, np.ndarray]:
    """Return minimisers (2, B), undefined where constraints cannot be met, and whether they can."""
    u = plane.clip(plane.v)
    met = np.ones(u.shape[1], dtype=bool)
    for i, (a1, a2, b) in enumerate(zip(*plane.a, plane.b, strict=True)):
        first, second = a1 * u[0], a2 * u[1]
        miss = first + second + b
        states = np.flatnonzero(
            (miss < -ROUNDING * (np.abs(first) + np.abs(second) + np.abs(b))) & met
        )
        if states.size:
            part = plane.take(states)
            part = part._replace(a=part.a[:, : i + 1], b=part.b[: i + 1])
            u[:, states], met[states] = _onto_line(part, u[:, states], miss[states])
    return u, met


def _onto_line(plane: Plane, u: np.ndarray, miss: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return minimisers (2, B) on the line of the last constraint, which u violates.

    Returns:
        These, and whether the constraints before and the input bounds leave any (B,).
    """
    first, second = np.abs(plane.a[:, -1])
    root = np.sqrt(plane.w)
    steepness = first / root[0] + second / root[1]
    s1, s2 = plane.scale(u, -np.where(steepness > 0.0, miss / steepness, miss))
    steep = first * s1 >= second * s2
    (rp, rf), (vp, vf), (lp, lf), (hp, hf), (wp, wf) = [
        (np.where(steep, *pair), np.where(steep, *pair[::-1]))
        for pair in (plane.a, plane.v, plane.low, plane.high, plane.w)
    ]
    alpha, beta = -plane.b[-1] / rp[-1], -rf[-1] / rp[-1]
    box = np.ones((2, len(alpha)))
    box[1] = -1.0
    before = _OnLine.of(
        np.concatenate([rp[:-1], box]),
        np.concatenate([rf[:-1], 0.0 * box]),
        np.concatenate([plane.b[:-1], [-lp, hp]]),
        alpha,
        beta,
    )
    aim = vf + wp * beta * (vp - alpha - beta * vf) / (wf + wp * beta * beta)
    lo, hi = before.interval(lf, hf, 0.0)
    free = np.minimum(np.maximum(aim, lo), hi)
    met = lo <= hi
    if not met.all():
        between = np.minimum(np.maximum(aim, hi), lo)
        lo, hi = before.interval(lf, hf, ROUNDING)
        free = np.where(met, free, np.minimum(np.maximum(between, lo), hi))
        met |= (lo <= hi) & before.holds(free)
    met &= before.crosses
    pivot = np.minimum(np.maximum(alpha + beta * free, lp), hp)
    return np.array([np.where(steep, pivot, free), np.where(steep, free, pivot)]), met


class _OnLine(NamedTuple):
    """Constraints slope * u_f + offset >= 0 along a line (k, B), with the sizes of their terms."""

    slope: np.ndarray
    offset: np.ndarray
    slope_terms: np.ndarray
    offset_terms: np.ndarray
    parallel: np.ndarray

    @classmethod
    def of(
        cls, rp: np.ndarray, rf: np.ndarray, rb: np.ndarray, alpha: np.ndarray, beta: np.ndarray
    ) -> _OnLine:
        turn, shift = rp * beta, rp * alpha
        slope = rf + turn
        parallel = np.abs(slope) <= ROUNDING * np.abs(rf)
        return cls(
            slope, rb + shift, np.abs(rf) + np.abs(turn), np.abs(rb) + np.abs(shift), parallel
        )

    @property
    def crosses(self) -> np.ndarray:
        """Whether no constraint lies parallel to the line on its wrong side (B,)."""
        return np.all(~self.parallel | (self.offset >= -ROUNDING * self.offset_terms), axis=0)

    def interval(
        self, lo: np.ndarray, hi: np.ndarray, relative: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return what the constraints leave of [lo, hi] if each may miss by part of its terms."""
        offset = self.offset
        if relative:
            offset = offset + relative * (
                self.offset_terms + self.slope_terms * np.abs(offset / self.slope)
            )
        end = -offset / self.slope
        lo = np.maximum(lo, np.where((self.slope > 0.0) & ~self.parallel, end, -np.inf).max(axis=0))
        return lo, np.minimum(
            hi, np.where((self.slope < 0.0) & ~self.parallel, end, np.inf).min(axis=0)
        )

    def holds(self, free: np.ndarray) -> np.ndarray:
        """Whether every constraint is met up to rounding where the free input is as given (B,)."""
        terms = self.offset_terms + self.slope_terms * np.abs(free)
        return np.all(self.slope * free + self.offset >= -2.0 * ROUNDING * terms, axis=0)
