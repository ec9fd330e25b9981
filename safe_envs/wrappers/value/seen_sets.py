"""The signs by which an env judges states, in its own floating-point numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from safe_envs.dynamics.codegen import Components, compile_function
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.value.reduction import ReducedProblem


class SeenSets:
    """Judges states as the env does; in exact arithmetic a sign might be another one.

    Args:
        problem: with the barriers.
        small: the problem in few coordinates.
        leaving: see `ValueSettings`.
    """

    def __init__(self, problem: SafetyProblem, small: ReducedProblem, leaving: str) -> None:
        self._reduced = small
        barriers = [problem.plant.numeric(each.expression) for each in problem.barriers]
        self._barriers: Any = compile_function(problem.plant.states, barriers, "arrays")
        self._leaves: Any = None
        if leaving == "violation" and small.outside.free_symbols:
            symbols = (*small.symbols, *small.known)
            self._leaves = compile_function(symbols, (small.outside,), "arrays")

    def are_safe(self, k: np.ndarray, x: Components, q: Sequence[np.ndarray]) -> np.ndarray:
        """Return whether states are safe, in the workspace where leaving it is a violation.

        Args:
            k: control instants, int array (B,).
            x: n components of the states, (B,).
            q: their coordinates, arrays (B,).
        """
        found = np.ones(len(k), dtype=bool)
        with np.errstate(all="ignore"):
            for h in self._barriers(*x):
                found = found & (h > 0.0)
            if self._leaves is not None:
                known = [each[k * self._reduced.substeps] for each in self._reduced.known.values()]
                found = found & (self._leaves(*q, *known)[0] <= 0.0)
        return found
