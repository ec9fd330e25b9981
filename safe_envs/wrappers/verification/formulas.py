"""The chains and conditions of a problem, compiled for many states at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from safe_envs.dynamics.lie import quadratic_variation_rate
from safe_envs.dynamics.tables import tabulated
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.conditions import Condition
from safe_envs.wrappers.conditions.parts import with_parts
from safe_envs.wrappers.verification.filter_of_formulas import filter_of_formulas
from safe_envs.wrappers.verification.safe_set import region_of
from safe_envs.wrappers.verification.search import Region

_ROUNDING = 1e-9
_EDGE = 1e-9
_ZERO = 1e-12
_EPSILONS = 64 * np.finfo(float).eps
_SIZES_LOG2 = 10
_STEP, _NEARLY = 1e-6, 1e-6


class Formulas:
    """The chains and conditions of a problem, compiled; arrays (B, n) of states in, arrays out.

    Attributes:
        safety_filter: which meets the conditions, or tells by how much it cannot.
        stages: the chain b_0..b_(r-1) of each barrier, as slices of all of them.

    Args:
        problem: whose barriers, input bounds and system are taken. A barrier that is a minimum
            counts as the barriers that it is the least of.
        conditions: one for each barrier.
        knowledge: "model" or "plant".

    Raises:
        ConfigurationError: an argument is out of its range, or a barrier is a maximum.
        RelativeDegreeError: a condition does not suit a barrier.
    """

    def __init__(
        self, problem: SafetyProblem, conditions: Sequence[Condition], knowledge: str
    ) -> None:
        self.problem, self.conditions = with_parts(problem, conditions)
        self.knowledge = knowledge
        self.safety_filter = filter_of_formulas(self.problem, self.conditions, knowledge)
        self.system = self.safety_filter.model
        self._constraints = self.safety_filter.constraints
        self._low, self._high = np.array(problem.box).T
        self._rest = np.clip(0.0, self._low, self._high)
        ends = np.cumsum([len(c.chain) for c in self._constraints]).tolist()
        self.stages = tuple(
            slice(end - len(c.chain), end) for end, c in zip(ends, self._constraints, strict=True)
        )

    @property
    def first_order(self) -> bool:
        """Whether all relative degrees are 1, so that the invariant set is C itself."""
        return self.stages[-1].stop == len(self.stages)

    @cached_property
    def names(self) -> list[str]:
        """Names of all chain functions: h, b_1, ...; with the barrier's if there are several."""
        several = len(self.stages) > 1
        return [
            barrier.name if j == 0 else f"b_{j}" + f" of {barrier.name}" * several
            for barrier, stage in zip(self.problem.barriers, self.stages, strict=True)
            for j in range(stage.stop - stage.start)
        ]

    @property
    def barriers(self) -> list[int]:
        """Indices of the barriers themselves among the chain functions."""
        return [stage.start for stage in self.stages]

    @property
    def noisy(self) -> bool:
        """Whether the plant has noise."""
        return self.problem.plant.noisy

    @property
    def certain(self) -> bool:
        """Whether the conditions, where they can be met, keep every path and not only some."""
        return not self.noisy or all(c.almost_sure for c in self.conditions)

    @property
    def expressions(self) -> list[Any]:
        """All functions of the state that a verification evaluates."""
        return [*self.chain_expressions, *self._constraint_expressions()]

    @property
    def chain_expressions(self) -> list[Any]:
        """b_0..b_(r-1) of each barrier, one after the other."""
        return [e for c in self._constraints for e in c.chain]

    def _constraint_expressions(self) -> list[Any]:
        return [e for c in self._constraints for e in (*c.coefficient, c.offset - (c.demand or 0))]

    @cached_property
    def chain(self) -> Callable[[np.ndarray], np.ndarray]:
        """States (B, n) to b_0..b_(r-1) of each barrier, one after the other, (B, sum of the r)."""
        return self._compiled(self.chain_expressions)

    @cached_property
    def _constraints_compiled(self) -> Any:
        return self._compiled(self._constraint_expressions())

    def _compiled(self, expressions: Sequence[Any]) -> Any:
        function = tabulated(self.system.states, [self.system.numeric(e) for e in expressions])

        def values(x: np.ndarray) -> np.ndarray:
            with np.errstate(all="ignore"):
                return function(x)

        return values

    @cached_property
    def variation_rates(self) -> Callable[[np.ndarray], np.ndarray]:
        """States (B, n) to |sigma' grad h|^2 of each barrier, the variance of h per s, (B, k)."""
        barriers = [c.chain[0] for c in self._constraints]
        return self._compiled([quadratic_variation_rate(self.system, h) for h in barriers])

    @cached_property
    def region(self) -> Region:
        """The workspace, with a finite range for what it leaves unbounded."""
        return region_of(self.problem, self.system, self.expressions)

    @cached_property
    def _sizes(self) -> tuple[np.ndarray, np.ndarray]:
        """Typical sizes over the workspace: of each b_j, and of each offset b, shape (k,)."""
        x = self.region.draw(_SIZES_LOG2, np.random.default_rng(0))
        return _typical(self.chain(x)), _typical(
            self._constraints_compiled(x).reshape(len(x), len(self.stages), -1)[:, :, -1]
        )

    @cached_property
    def _edges(self) -> np.ndarray:
        """Width of the strip of each b_j where a reciprocal condition has no value; else 0."""
        reciprocal = [c.demand is not None for c in self._constraints for _ in c.chain]
        return np.where(reciprocal, _EDGE * self._sizes[0], 0.0)

    def barrier_level(self, x: np.ndarray) -> np.ndarray:
        """Return a level (B,) that is nonnegative in C."""
        return (self.chain(x) - self._edges)[:, self.barriers].min(axis=1)

    def invariant_level(self, x: np.ndarray) -> np.ndarray:
        """Return a level (B,) that is nonnegative in the invariant set."""
        return (self.chain(x) - self._edges).min(axis=1)

    @property
    def independent(self) -> bool:
        """Whether no input appears in two conditions, so that each can be met by itself."""
        uses = [{j for j, a in enumerate(c.coefficient) if a != 0} for c in self._constraints]
        return sum(map(len, uses)) == len(set().union(*uses))

    @property
    def joint(self) -> bool:
        """Whether the joint shortfall is exact: one condition, independent ones, or one input."""
        # Sampling margins decide how the filter distributes a violation, by the nominal action.
        sampled = any(c.change is not None for c in self._constraints)
        return self.independent or (self.problem.plant.m == 1 and not sampled)

    def _changes(self, x: np.ndarray) -> np.ndarray:
        """Return the change of each a, to first order, over states that rounding cannot tell."""
        found, width = 0.0, self.region.high - self.region.low
        for step in np.diag(_STEP * width):
            ahead, behind = (self._entries(x + sign * step)[:, :, :-1] for sign in (1.0, -1.0))
            slope = np.nan_to_num(abs(ahead - behind), posinf=0.0)
            found = found + slope * (_EPSILONS / (2.0 * _STEP))
        return np.asarray(found)

    def _entries(self, x: np.ndarray) -> np.ndarray:
        return self._constraints_compiled(x).reshape(len(x), len(self.stages), -1)

    @cached_property
    def _nearly_zero(self) -> np.ndarray:
        """Sizes below which an a may be 0 but for rounding, shape (k, m)."""
        x = self.region.draw(_SIZES_LOG2, np.random.default_rng(0))
        return _NEARLY * _typical(self._entries(x)[:, :, :-1])

    def constraints_at(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return a (B, k, m) and b (B, k) of the constraints a u + b >= 0.

        An a that is 0 to rounding is 0: within input bounds that are wide enough, rounding would
        meet any condition.
        """
        found = self._entries(x)
        a = found[:, :, :-1]
        small = (abs(a) <= self._nearly_zero).any(axis=(1, 2))
        if small.any():
            a = a.copy()
            a[small] = np.where(abs(a[small]) <= self._changes(x[small]), 0.0, a[small])
        return a, found[:, :, -1]

    def defined(self, x: np.ndarray) -> np.ndarray:
        """Return whether the conditions have finite values, shape (B,)."""
        return np.isfinite(self._constraints_compiled(x)).all(axis=1)

    def control_authority(self, x: np.ndarray) -> np.ndarray:
        """Return half of the range of L_g b_(r-1) u over the input bounds, shape (B, k)."""
        return (abs(self.constraints_at(x)[0]) * (self._high - self._low) / 2.0).sum(axis=2)

    def reach(self, x: np.ndarray) -> float:
        """Return the part of the input bounds, at most 1, that matters as much as the offset b."""
        a, b = self.constraints_at(x)
        with np.errstate(all="ignore"):
            ratio = np.nanmedian(abs(b + a @ self._rest), axis=0) / np.nanmedian(
                self.control_authority(x), axis=0
            )
        ratio = ratio[(ratio > 0.0) & np.isfinite(ratio)]
        return min(1.0, float(ratio.min())) if ratio.size else 1.0

    def own_shortfall(self, x: np.ndarray, reach: float = 1.0) -> np.ndarray:
        """Return by how much the action that is best for a condition alone violates it.

        Where the condition can be met, to rounding, it is minus the margin of that action.

        Args:
            x: states, shape (B, n).
            reach: part of the input bounds that is allowed, about the action next to 0.

        Returns:
            Amounts for each condition, shape (B, k).
        """
        a, b = self.constraints_at(x)
        low, high = self._ends(reach)
        most = np.maximum(a * low, a * high).sum(axis=2)
        spare, rounding = b + most, _ROUNDING * (abs(most) + abs(b)) + _ZERO * self._sizes[1]
        return np.where(abs(spare) > rounding, -spare, 0.0)

    def shortfall(self, x: np.ndarray, reach: float = 1.0) -> np.ndarray:
        """Return by how much the worst condition is violated at best.

        Where all can be met, it is minus the best common margin. Where several conditions share the
        inputs, the filter decides how a violation is distributed.

        Args:
            x: states, shape (B, n).
            reach: see `own_shortfall`; below 1 the violation of the worst condition is least.

        Returns:
            Amounts, shape (B,); NaN where a condition is undefined.
        """
        own = self.own_shortfall(x, reach).max(axis=1)
        if self.independent:
            return own
        found = self._common(x, reach) if self.joint else own
        unsettled = (found > 0.0 if self.joint else found <= 0.0) & (reach == 1.0) & self.defined(x)
        if unsettled.any():
            slack = self.slack(x[unsettled]).max(axis=1)
            rounding = _ROUNDING * abs(self.constraints_at(x[unsettled])[1]).max(axis=1)
            found[unsettled] = np.where(
                slack > rounding, np.maximum(slack, found[unsettled]), found[unsettled]
            )
        return found

    def _ends(self, reach: float) -> tuple[np.ndarray, np.ndarray]:
        return self._rest + reach * (self._low - self._rest), self._rest + reach * (
            self._high - self._rest
        )

    def _common(self, x: np.ndarray, reach: float) -> np.ndarray:
        """Return minus the best common margin of several conditions on one input, shape (B,)."""
        # The smallest margin is concave and piecewise linear in the input: it is largest where two
        # of them cross, or at a bound of the input.
        a, b = self.constraints_at(x)
        a = a[:, :, 0]
        low, high = (end[0] for end in self._ends(reach))
        i, j = np.triu_indices(len(self.stages), 1)
        with np.errstate(all="ignore"):
            crossings = (b[:, j] - b[:, i]) / (a[:, i] - a[:, j])
        tried = np.clip(np.nan_to_num(crossings, nan=low, posinf=high, neginf=low), low, high)
        tried = np.concatenate([tried, np.broadcast_to([low, high], (len(x), 2))], axis=1)
        margins = a[:, :, None] * tried[:, None, :] + b[:, :, None]
        rounding = (
            _ROUNDING * (abs(a[:, :, None] * tried[:, None, :]) + abs(b[:, :, None]))
            + _ZERO * self._sizes[1][:, None]
        )
        return -np.where(abs(margins) > rounding, margins, 0.0).min(axis=1).max(axis=1)

    def slack(self, x: np.ndarray) -> np.ndarray:
        """Return by how much the filter violates each condition, shape (B, k)."""
        rest = np.broadcast_to(self._rest, (len(x), len(self._rest)))
        return self.safety_filter.filter(x, rest).slack


def _typical(values: np.ndarray) -> np.ndarray:
    """Return the medians of sizes that are neither 0 nor undefined, over the first axis; else 1."""
    sizes = np.where(np.isfinite(values) & (values != 0.0), abs(values), np.nan)
    empty = np.isnan(sizes).all(axis=0)
    return np.where(empty, 1.0, np.nanmedian(np.where(empty, 1.0, sizes), axis=0))
