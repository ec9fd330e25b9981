"""A filter's decision and barriers, as the source from which C is written."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from safe_envs.compiled.data import Data
from safe_envs.compiled.formulas import Source, formulas
from safe_envs.wrappers.filter_qp.array_decision import ArrayDecision
from safe_envs.wrappers.filter_qp.decision_kernel import furthest_constraint
from safe_envs.wrappers.filter_qp.decision_text import Body
from safe_envs.wrappers.filter_qp.qp import FilterQP
from safe_envs.wrappers.safety_filter import SafetyFilter

DOCUMENTED = {
    "decide": "Solve the QP of the filter at a state.",
    "barrier_values": "Return the barriers at a state.",
    "filter_values": (
        "Return the constraints at a state: the coefficients and the offset of each, and what"
        " follows."
    ),
}


class FilterProgram(NamedTuple):
    """What the C of a filter is written from.

    Attributes:
        source: the functions `decide` and `barrier_values`.
        data: their numbers.
        proposes: whether the filter pursues a goal of its own, in place of the proposed input.
        partial: numbers of the barriers that may have no value.
    """

    source: Source
    data: Data
    proposes: bool
    partial: tuple[int, ...]


def filter_program(safety_filter: SafetyFilter) -> FilterProgram:
    """Return the functions of a filter, which take the input bounds at run time.

    Args:
        safety_filter: the filter.

    Raises:
        NotCompilableError: Learned terms have no compiled form.
    """
    qp, data = safety_filter.qp, Data()
    model = qp.model
    barriers = [model.numeric(barrier.expression) for barrier, _ in safety_filter.pairs]
    source = _Decision(qp, data).source()
    source += formulas("barrier_values", {"x": qp.symbols}, barriers, data)
    return FilterProgram(source, data, qp.clf is not None, qp.partial_barriers)


class _Decision(ArrayDecision):
    """Writes `decide` with the input bounds as arguments, and all that a decision tells."""

    parameters = "x, u, lowest, highest, data, work"

    def __init__(self, qp: FilterQP, data: Data) -> None:
        super().__init__(qp, data)
        self._body = _WritableBody(data)
        # They depend on the input bounds.
        self._planes = {}

    def _input_bounds(self) -> None:
        low, high = self._ends()
        self._body.vector("low", [*low, "0.0"][: self._m + self._goal])
        if not self._goal:
            self._body.vector("high", high)

    def _ends(self) -> tuple[list[str], list[str]]:
        low, high = ([f"{name}[{j}]" for j in range(self._m)] for name in ("lowest", "highest"))
        return low, high

    def _answer(self) -> None:
        body, k, m = self._body, self._k, self._m
        action = [f"action[{j}]" for j in range(m)]
        margin = [f"margin[{i}]" for i in range(k)]
        if self._single:
            body.add("cause = 0")
        else:
            body.call(
                furthest_constraint,
                f"{m}, a, {self._asked}, proposed, w, inside, active",
                "cause = ",
            )
        parts = {
            "chosen": action,
            "pursued": [f"proposed[{j}]" for j in range(m)],
            "reached": margin,
            "acting": [f"active[{i}]" for i in range(k)],
            "slack": [f"0.0 if feasible else max(-{g}, 0.0)" for g in margin],
        }
        body.add(*(f"{name} = ({''.join(f'{e}, ' for e in es)})" for name, es in parts.items()))
        body.add(f"return {', '.join(parts)}, feasible, cause, sound")


class _WritableBody(Body):
    """Puts constants into the scratch array: functions of C have one kind of array."""

    def constants(self, name: str, numbers: Sequence[float]) -> None:
        self.vector(name, [self.number(value) for value in numbers])
