"""The values of the barriers that a filter keeps."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import Flavour, compile_function
from safe_envs.dynamics.defined import defined_arrays
from safe_envs.errors import NumericalError
from safe_envs.wrappers.conditions import AffineConstraint
from safe_envs.wrappers.conditions.parts import Pairs
from safe_envs.wrappers.filter_qp.component_filter import ComponentFilter
from safe_envs.wrappers.filter_qp.qp import FilterQP


class BarrierValues:
    """The part of a `SafetyFilter` that evaluates its barriers."""

    pairs: Pairs
    parts: Pairs
    constraints: tuple[AffineConstraint, ...]
    qp: FilterQP
    undefined: Callable[..., NumericalError]

    def by_constraint(self) -> Any:
        """Return the filter with an entry for each constraint in its decisions.

        Of itself, decisions have one for each barrier, which may have several constraints.
        """
        if not self.qp.owners:
            return self
        found: Any = copy.copy(self)
        found.pairs = self.parts
        names = [barrier.name for barrier, _ in self.parts]
        ComponentFilter.__init__(found, replace(self.qp, owners=()), names)
        for name in ("_barriers_floats", "_barriers_arrays"):
            vars(found).pop(name, None)
        return found.warm_up()

    @cached_property
    def _barriers_floats(self) -> Any:
        return self._compile_barriers("floats")

    @cached_property
    def _barriers_arrays(self) -> Any:
        return self._compile_barriers("arrays")

    def _compile_barriers(self, flavour: Flavour) -> Any:
        # A condition with a belief keeps the barrier of that.
        kept = [
            barrier.expression
            if c.belief is None
            else sp.Min(*[self.constraints[i].chain[0] for i in members])
            for (barrier, c), members in zip(self.pairs, self.qp.members, strict=True)
        ]
        expressions = [self.qp.model.numeric(h) for h in kept]
        return compile_function(self.qp.symbols, expressions, flavour)

    def barriers_at(self, values: Sequence[Any]) -> Sequence[Any]:
        """Return the barriers at a batch, as numbers or arrays (B,).

        Args:
            values: of the symbols of `qp`, arrays (B,).
        """
        return defined_arrays(self._barriers_arrays(*values))

    def _defined(self, barrier: np.ndarray, x: Sequence[Any]) -> np.ndarray:
        """Return barriers (B, k) at states, -inf where one has no value; raise on overflow."""
        bad = ~np.isfinite(barrier)
        partial = self.qp.partial_barriers
        lost = [i for i in range(bad.shape[1]) if i not in partial and bad[:, i].any()]
        if lost:
            at = int(bad[:, lost[0]].argmax())
            raise self.undefined("the barrier", [float(np.atleast_1d(c)[at]) for c in x], lost[:1])
        return np.where(bad, -np.inf, barrier)
