"""Certified bounds of the value at starts: a proved step of look-ahead, less what a check took off.

By propositions 2 and 3 the look-ahead takes the place of the envelope at the first instant, so that
only the deficits of the later ones count.
"""

from __future__ import annotations

import numpy as np

from safe_envs.dynamics.codegen import Components
from safe_envs.dynamics.intervals import interval_function
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.value.look_ahead import LookAhead
from safe_envs.wrappers.value.proved_chain import ProvedChain
from safe_envs.wrappers.value.reduction import reduced
from safe_envs.wrappers.value.scanned_inputs import scanned_inputs
from safe_envs.wrappers.value.table import ValueTable
from safe_envs.wrappers.value.table_check import TableCheck

_UNIT = 2.0**-52
_LITTLE_WORK = 20_000_000
"""Images of starts under boxes of inputs that take some seconds."""


class ProvedStarts:
    """Bounds the value at starts, for certain.

    Args:
        table: of the problem.
        problem: the problem.
        check: of the table.
        look_ahead: of the table, which proposes inputs.

    Attributes:
        most_starts: for which bounds take some seconds.
        noise_boxes: number of boxes into which the noise of a step is divided.
    """

    def __init__(
        self, table: ValueTable, problem: SafetyProblem, check: TableCheck, look_ahead: LookAhead
    ) -> None:
        settings = table.settings
        small = reduced(problem, settings.knowledge, settings.intervals, settings.specification)
        self._chain = ProvedChain(small, settings.leaving, table.grid)
        self._scanned = scanned_inputs(small.box, settings.inputs)
        expressions = [c.expression for c in small.coordinates]
        self._coordinates = interval_function(problem.plant.states, expressions)
        self._check, self._look_ahead = check, look_ahead
        after, sets = table.lower[max(1 - table.first, 0)], self._chain.sets
        self._below = self._chain.ahead(after, sets.inside, 1)
        self._above = None
        if check.upper is not None:
            after = table.upper[max(1 - table.first, 0)]
            self._above = self._chain.ahead(after, sets.touches, -1)
        self.noise_boxes = look_ahead.noise_boxes
        work = len(self._scanned.values) * self.noise_boxes * self._chain.step.scenarios
        self.most_starts = max(1000, _LITTLE_WORK // work)

    def start_bounds(self, x: Components) -> tuple[np.ndarray, np.ndarray]:
        """Return certified bounds of the value at starts; the upper one is 1 where unchecked.

        Args:
            x: n components of the states, (B,).

        Returns:
            Lower and upper bounds, shape (B,).
        """
        count = len(x[0])
        found = self._coordinates(x)
        low = [np.broadcast_to(q.low, count) for q in found]
        high = [np.broadcast_to(q.high, count) for q in found]
        inside, touches, _, _ = self._chain.sets.read(low, high)
        proposed = self._look_ahead.scanned(np.zeros(count, dtype=np.int64), x).argmax(axis=1)
        images = self._chain.images((low, high), self._scanned.ends[0])
        lower = self._chain.bounds(self._below, images, np.arange(count), proposed)
        lower = np.where(inside, _less(lower, self._check.later[0]), 0.0)
        upper = np.ones(count)
        taken = self._check.later[1]
        if self._above is not None and taken is not None:
            images = self._chain.images((low, high), self._scanned.boxes[0])
            largest = np.zeros(count)
            for u in range(len(self._scanned.values)):
                chosen = np.full(count, u)
                bound = -self._chain.bounds(self._above, images, np.arange(count), chosen)
                np.maximum(largest, bound, out=largest)
            upper = np.where(touches, -_less(-largest, taken), 0.0)
        return lower.clip(0.0, 1.0), upper.clip(0.0, 1.0)


def _less(bounds: np.ndarray, taken: float) -> np.ndarray:
    found = bounds - taken
    return found - np.abs(found) * _UNIT
