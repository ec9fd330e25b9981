"""The one place where tests open the programs of filters: decisions as compiled code makes them."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from safe_envs.engine.formulas import Source
from safe_envs.engine.program import Program
from safe_envs.engine.slots import Data, Input, State, decide
from safe_envs.filters.decision_source import filter_source, unfiltered_source
from safe_envs.wrappers import SafetyFilter


class Decision(NamedTuple):
    """What a program decides for one state: inputs (m,), the proposal that constraints changed
    (m,), whether any constraint acts, whether all are met, slacks (k,), the barrier that acts,
    and whether all numbers are finite."""

    action: np.ndarray
    proposed: np.ndarray
    active: bool
    feasible: bool
    slack: np.ndarray
    cause: int
    sound: bool


def decided(x: State, u: Input, data: np.ndarray, work: np.ndarray) -> tuple:
    return decide(x, u, data, work)


@functools.lru_cache(maxsize=64)
def _function(source: Source, compiled: bool) -> Callable[..., tuple]:
    program = Program("filter", [decided], source)
    return (program.compiled() if compiled else program.plain())["decided"]


def decision_of(
    safety_filter: SafetyFilter | int, *, compiled: bool = False
) -> Callable[[Any, Any], Decision]:
    """The decision of a filter in programs, of a state (n,) and a proposal (m,); of a number of
    inputs without a filter. Executed as Python unless it is compiled."""
    data = Data()
    if isinstance(safety_filter, int):
        source = unfiltered_source(safety_filter)
    else:
        source = filter_source(safety_filter.qp, data)
    function, numbers = _function(source, compiled), data.array()
    work = np.full(source.work, np.nan)  # which holds nothing that may be read

    def decision(state: Any, proposal: Any) -> Decision:
        given = tuple(map(float, state)), tuple(map(float, proposal))
        with np.errstate(all="ignore"):
            action, proposed, active, feasible, slack, cause, sound = function(
                *given, numbers, work
            )
        return Decision(
            np.array(action), np.array(proposed), active, feasible, np.array(slack), cause, sound
        )

    return decision
