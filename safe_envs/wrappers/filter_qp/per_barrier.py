"""Decisions with an entry for each barrier, where some barriers have several constraints."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from safe_envs.dynamics.codegen import Flavour
from safe_envs.wrappers.filter_qp.decision import FilterDecision
from safe_envs.wrappers.filter_qp.qp import FilterQP


class PerBarrier:
    """Solves a QP: of the constraints of a barrier, the one that is violated most counts.

    Args:
        solve: returns the decision in components, with an entry for each constraint.
        qp: the QP.
        flavour: of the components.
    """

    def __init__(
        self, solve: Callable[..., FilterDecision], qp: FilterQP, flavour: Flavour
    ) -> None:
        self._solve, self._members = solve, qp.members
        self._owners = np.array([*qp.owners, -1])
        arrays = flavour == "arrays"
        self._smaller: Any = np.minimum if arrays else min
        self._larger: Any = np.maximum if arrays else max

    def __call__(self, *given: Any) -> FilterDecision:
        """Return the decision; see `FilterQPSolver.solve`."""
        found = self._solve(*given)
        cause: Any = self._owners[found.cause]
        return found._replace(
            margin=self._reduced(self._smaller, found.margin),
            active=self._reduced(self._larger, found.active),
            slack=self._reduced(self._larger, found.slack),
            cause=cause if isinstance(found.cause, np.ndarray) else int(cause),
        )

    def _reduced(self, of_two: Callable[..., Any], entries: Sequence[Any]) -> list[Any]:
        return [functools.reduce(of_two, [entries[i] for i in each]) for each in self._members]
