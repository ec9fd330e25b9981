"""The chains and conditions of a problem, compiled for many states at once."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np

from safe_envs.codegen import compile_function, stacked
from safe_envs.problem import SafetyProblem
from wrappers.conditions import SRCBF, Condition
from wrappers.safety_filter import SafetyFilter

_ROUNDING = 1e-9
_EDGE = 1e-9


class Formulas:
    """The chains and conditions of a problem, compiled; arrays (B, n) of states in, arrays out.

    Attributes:
        problem: whose they are.
        conditions: one for each barrier.
        knowledge: what they know, "model" or "plant".
        safety_filter: which meets them, or says by how much it cannot.
        stages: the chain b_0..b_(r-1) of each barrier, as slices of all of them.

    Args:
        problem: whose barriers, box and system are taken.
        conditions: one for each barrier.
        knowledge: "model" or "plant".

    Raises:
        ConfigurationError: an argument is out of its range.
        RelativeDegreeError: a condition does not suit a barrier.
    """

    def __init__(self, problem: SafetyProblem, conditions: Sequence[Condition], knowledge: str) -> None:
        self.problem, self.conditions, self.knowledge = problem, tuple(conditions), knowledge
        self.safety_filter = SafetyFilter.for_problem(problem, self.conditions, knowledge)
        self.system = self.safety_filter.model
        self._constraints = self.safety_filter.constraints
        self._low, self._high = np.array(problem.box).T
        ends = np.cumsum([len(c.chain) for c in self._constraints]).tolist()
        self.stages = tuple(slice(end - len(c.chain), end) for end, c in zip(ends, self._constraints, strict=True))

    @property
    def first_order(self) -> bool:
        """Whether all relative degrees are 1, so that the intersection of the C_j is C itself."""
        return self.stages[-1].stop == len(self.stages)

    @property
    def barriers(self) -> list[int]:
        """Which functions of the chain are the barriers themselves."""
        return [stage.start for stage in self.stages]

    @property
    def noisy(self) -> bool:
        """Whether the plant has noise."""
        plant = self.problem.plant
        return not plant.numeric(plant.diffusion).is_zero_matrix

    @property
    def certain(self) -> bool:
        """Whether the conditions, where they can be met, keep every path and not only some: without noise, or SRCBF."""
        return not self.noisy or all(isinstance(c, SRCBF) for c in self.conditions)

    @property
    def expressions(self) -> list[Any]:
        """All that is asked of a state."""
        return [*self._chain_expressions(), *self._row_expressions()]

    def _chain_expressions(self) -> list[Any]:
        return [e for c in self._constraints for e in c.chain]

    def _row_expressions(self) -> list[Any]:
        return [e for c in self._constraints for e in (*c.coefficient, c.offset - (c.demand or 0))]

    @cached_property
    def _chain(self) -> Any:
        return self._compiled(self._chain_expressions())

    @cached_property
    def _rows(self) -> Any:
        return self._compiled(self._row_expressions())

    def _compiled(self, expressions: Sequence[Any]) -> Any:
        function = compile_function(self.system.states, [self.system.numeric(e) for e in expressions], "arrays")

        def values(x: np.ndarray) -> np.ndarray:
            with np.errstate(all="ignore"):
                return stacked(function(*np.ascontiguousarray(x.T)), len(x))

        return values

    def chain(self, x: np.ndarray) -> np.ndarray:
        """b_0..b_(r-1) of every barrier, one barrier after the other, shape (B, sum of the r)."""
        return self._chain(x)

    def barrier_level(self, x: np.ndarray) -> np.ndarray:
        """Nonnegative in C, a hair from its edge, where reciprocal conditions have no value."""
        return self.chain(x)[:, self.barriers].min(axis=1) - _EDGE

    def kept_level(self, x: np.ndarray) -> np.ndarray:
        """Nonnegative in the intersection of the C_j, a hair from its edge."""
        return self.chain(x).min(axis=1) - _EDGE

    def leading(self, x: np.ndarray) -> np.ndarray:
        """Half of the range of L_g b_(r-1) u over the box, for each barrier, shape (B, k)."""
        a = self._rows(x).reshape(len(x), len(self.stages), -1)[:, :, :-1]
        return (abs(a) * (self._high - self._low) / 2.0).sum(axis=2)

    def missed(self, x: np.ndarray) -> np.ndarray:
        """By how much each condition is missed at best, shape (B, k); what several miss together only where none has to alone.

        The filter takes long to share out a violation among several conditions: see `slack` for what it makes of it. Where
        none is missed, to rounding, minus the margin that the best action would have for that condition alone: the nearer to
        0, the nearer to being missed.
        """
        rows = self._rows(x).reshape(len(x), len(self.stages), -1)
        a, b = rows[:, :, :-1], rows[:, :, -1]
        most = np.maximum(a * self._low, a * self._high).sum(axis=2)
        spare, rounding = b + most, _ROUNDING * (abs(most) + abs(b))
        found = np.where(abs(spare) > rounding, -spare, 0.0)
        unsettled = np.ones(len(x), dtype=bool) if found.shape[1] == 1 else (found <= 0.0).all(axis=1)
        if unsettled.any():
            slack = self.slack(x[unsettled])
            found[unsettled] = np.where(slack > rounding[unsettled], slack, np.minimum(found[unsettled], 0.0))
        return found

    def slack(self, x: np.ndarray) -> np.ndarray:
        """By how much the filter misses each condition, shape (B, k)."""
        return self.safety_filter.filter(x, np.broadcast_to(self._low, (len(x), len(self._low)))).slack
