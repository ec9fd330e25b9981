"""Branch and bound over boxes of states, with the enclosures of a statement."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np

from safe_envs.wrappers.verification.bisection import axis_of, middle_of
from safe_envs.wrappers.verification.statements import Enclosures, Statement

_BATCH = 4096
_TRIED = 128
_NARROW = 1e-6
_FAR = 1e12


@dataclass(frozen=True)
class Budget:
    """What a judgement may cost.

    Attributes:
        boxes: most boxes that are looked at.
        seconds: most processor time.
    """

    boxes: int = 2_000_000
    seconds: float = 20.0


class BranchAndBound:
    """Boxes that are left, with upper bounds of what is to be at most a target.

    Attributes:
        best: largest value that was certainly met in the region.
        best_state: where that is.
        guide: largest value that was met next to the region, where no state is certainly in it.
        boxes: number of boxes that were looked at.
        margin: by how much the largest value may be missed, where there is no target.
    """

    def __init__(self, statement: Statement, budget: Budget, target: float | None = None) -> None:
        self._statement, self._budget, self._target = statement, budget, target
        self._program = statement.program
        low, high = statement.ends
        self._low, self._high = low[:, None], high[:, None]
        self._upper = np.array([math.inf])
        self._width = high - low
        self._settled = -math.inf
        self._stuck: np.ndarray | None = None
        self._begun = time.process_time()
        self.best, self.best_state, self.boxes = -math.inf, None, 0
        self.guide = -math.inf
        self.margin = 0.0

    @property
    def open_boxes(self) -> int:
        """Number of boxes that are left."""
        return self._low.shape[1]

    @property
    def widest_open(self) -> np.ndarray:
        """The box that bisection does not help, or whose bound is worst, shape (2, n)."""
        worst = int(self._upper.argmax())
        open_ = np.array([self._low[:, worst], self._high[:, worst]])
        return open_ if self._stuck is None else self._stuck

    @property
    def upper(self) -> float:
        """Bound over all boxes, settled and left."""
        return max(self._settled, self.best, float(self._upper.max(initial=-math.inf)))

    @property
    def exhausted(self) -> str:
        """Why the search has to end, in words; empty where it need not."""
        if self.boxes >= self._budget.boxes:
            return f"{self._left} after {self.boxes} boxes; allow more, or a larger margin"
        if time.process_time() - self._begun > self._budget.seconds:
            return f"{self._left} after {self._budget.seconds:g} s; allow more, or a larger margin"
        return ""

    @property
    def _left(self) -> str:
        return f"{self._statement.name}: {self.open_boxes} boxes are left"

    @property
    def _enough(self) -> float:
        """Bound at which a box is settled."""
        return (
            self._target if self._target is not None else self.margin + max(self.best, self.guide)
        )

    def tried(self, x: np.ndarray) -> bool:
        """Look at states in the box, shape (n, B), and return whether one refutes the statement."""
        low, high = (end[:, None] for end in self._statement.ends)
        x = x[:, ((low <= x) & (x <= high)).all(axis=0)]
        if not x.size:
            return False
        found = self._program(x, x)
        value = -found.claim.range.high
        value = np.where(found.inside & np.isfinite(value), value, -np.inf)
        if found.zeros:
            value = np.full_like(value, -np.inf)  # No number is certainly 0.
        first = int(value.argmax())
        if value[first] > self.best:
            self.best, self.best_state = float(value[first]), x[:, first].copy()
        return self._target is not None and self.best > 0.0

    def settle_some(self) -> str:
        """Look at a batch of boxes, and bisect what is left of them.

        Returns:
            Why no further bisection helps, in words; empty where it may.
        """
        low, high = self._taken()
        found = self._program(low, high)
        self.boxes += low.shape[1]
        upper = -found.claim.range.low
        open_ = ~found.outside & ~((upper <= self._enough) & found.smooth)
        self._note_settled(upper[~found.outside & ~open_])
        if not open_.any():
            return ""
        # Centers of forms tell which middles are probably in the region.
        likely = open_.copy()
        for form in found.region:
            likely &= form.center > 0.0
        value = np.where(likely, -found.claim.center, -np.inf)
        chosen = np.argsort(-value)[:_TRIED]
        chosen = chosen[open_[chosen]]
        middle = middle_of(low[:, chosen], high[:, chosen])
        if self.tried(middle):
            return ""
        if found.zeros:
            if self._target is None:
                self._look_near_zeros(middle, low, high, found, chosen)
            elif self._crosses(low, high, found, chosen):
                return ""
        return self._bisect(low, high, upper, found, open_)

    def _taken(self) -> tuple[np.ndarray, np.ndarray]:
        """Take boxes: the last ones, which are the smallest; the worst ones without a target."""
        count = min(_BATCH, self.open_boxes)
        if self._target is None and self.open_boxes > count:
            order = np.argsort(self._upper, kind="stable")
            self._low, self._high = self._low[:, order], self._high[:, order]
            self._upper = self._upper[order]
        low, high = self._low[:, -count:], self._high[:, -count:]
        self._low, self._high = self._low[:, :-count], self._high[:, :-count]
        self._upper = self._upper[:-count]
        if self._target is None:
            done = self._upper <= self._enough
            self._note_settled(self._upper[done])
            self._low, self._high = self._low[:, ~done], self._high[:, ~done]
            self._upper = self._upper[~done]
        return low, high

    def _note_settled(self, upper: np.ndarray) -> None:
        self._settled = max(self._settled, float(upper.max(initial=-math.inf)))

    def _look_near_zeros(
        self,
        middle: np.ndarray,
        low: np.ndarray,
        high: np.ndarray,
        found: Enclosures,
        chosen: np.ndarray,
    ) -> None:
        """Move states towards the zeros by a step of Newton's method, for a guide only."""
        x = middle
        for zero in found.zeros:
            slopes = zero.slopes[:, chosen]
            with np.errstate(all="ignore"):
                step = zero.center[chosen] / (slopes * slopes).sum(axis=0)
                x = x - np.nan_to_num(slopes * step, posinf=0.0, neginf=0.0) * 0.5 * (
                    high[:, chosen] - low[:, chosen]
                )
        x = np.clip(x, low[:, chosen], high[:, chosen])
        near = self._program(x, x)
        small = (high[:, chosen] - low[:, chosen] <= 0.05 * self._width[:, None]).all(axis=0)
        size = [
            np.abs(z.center) <= 1e-2 * np.abs(w.slopes[:, chosen]).sum(axis=0)
            for z, w in zip(near.zeros, found.zeros, strict=True)
        ]
        usable = near.inside & small & np.logical_and.reduce(size)
        values = np.where(usable, -near.claim.center, -np.inf)
        self.guide = max(self.guide, float(values.max(initial=-math.inf)))

    def _crosses(
        self, low: np.ndarray, high: np.ndarray, found: Enclosures, chosen: np.ndarray
    ) -> bool:
        """Return whether the claim fails on a whole box across which a zero is crossed.

        One of the expressions that are 0 in the region is continuous, and takes both signs there.
        """
        if len(found.zeros) != 1:
            return False
        fails = found.inside & (found.claim.range.high < 0.0) & np.isfinite(found.claim.range.low)
        fails &= found.zeros[0].smooth
        for i in chosen[fails[chosen]].tolist():
            upward = found.zeros[0].slopes[:, i] >= 0.0
            ends = np.stack(
                [
                    np.where(upward, high[:, i], low[:, i]),
                    np.where(upward, low[:, i], high[:, i]),
                ],
                axis=1,
            )
            (zero,) = self._program(ends, ends).zeros
            if zero.range.low[0] > 0.0 and zero.range.high[1] < 0.0:
                self.best = float(-found.claim.range.high[i])
                self.best_state = middle_of(low[:, [i]], high[:, [i]])[:, 0]
                return True
        return False

    def _bisect(
        self,
        low: np.ndarray,
        high: np.ndarray,
        upper: np.ndarray,
        found: Enclosures,
        open_: np.ndarray,
    ) -> str:
        """Put the halves of boxes back; return why that is of no use, in words."""
        low, high, upper = low[:, open_], high[:, open_], upper[open_]
        forms = (found.claim, *found.region, *found.zeros)
        axis = axis_of(low, high, self._width, forms, open_)
        at = np.arange(len(axis))
        middle = middle_of(low, high)[axis, at]
        stuck = (middle <= low[axis, at]) | (middle >= high[axis, at]) | (np.abs(middle) > _FAR)
        with np.errstate(invalid="ignore"):
            narrow = ((high - low) <= _NARROW * np.minimum(self._width, 1.0)[:, None]).all(axis=0)
        rough = narrow & ~found.smooth[open_] & found.inside[open_]
        for form in found.zeros:
            rough |= narrow & ~form.smooth[open_]
        below, above = high.copy(), low.copy()
        below[axis, at], above[axis, at] = middle, middle
        if (stuck | rough).any():
            i = int((stuck | rough).argmax())
            self._stuck = np.array([low[:, i], high[:, i]])
            self._leave(low, high, upper)  # All: a bound is over all that are left.
            return self._why_stuck(bool(rough[i]), bool(found.smooth[open_][i]))
        self._leave(low, below, upper)
        self._leave(above, high, upper)
        return ""

    def _leave(self, low: np.ndarray, high: np.ndarray, upper: np.ndarray) -> None:
        """Add boxes to those that are left."""
        self._low = np.concatenate([self._low, low], axis=1)
        self._high = np.concatenate([self._high, high], axis=1)
        self._upper = np.concatenate([self._upper, upper])

    def _why_stuck(self, rough: bool, smooth: bool) -> str:
        name, (low, high) = self._statement.name, self.widest_open
        near = ", ".join(
            f"{s} = {a:.6g}" if np.isfinite(b - a) else f"{s} from {a:.3g} to {b:.3g}"
            for s, a, b in zip(self._statement.states, low, high, strict=True)
        )
        if rough or not smooth:
            return (
                f"{name}: not {self._asked} near {near}, where evaluation meets a kink, a jump, a"
                " pole, or the edge of a domain"
            )
        if not np.isfinite(high - low).all() or max(abs(low).max(), abs(high).max()) > _FAR:
            return f"{name}: the region has no end, {near}"
        return f"{name}: equal to rounding near {near}; a larger margin would tell"

    @property
    def _asked(self) -> str:
        return "twice continuously differentiable" if self._statement.smooth else "continuous"
