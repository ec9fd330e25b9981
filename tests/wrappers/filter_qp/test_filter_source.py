"""The filter as a function of compiled programs: the decisions of `SafetyFilter`."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
import sympy as sp

from safe_envs import (
    RelativeDegreeError,
)
from safe_envs.compiled.data import Data
from safe_envs.compiled.program import Program
from safe_envs.dynamics.codegen import filled
from safe_envs.errors import NotCompilableError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers import SafetyFilter, parse_conditions
from safe_envs.wrappers.filter_qp.filter_source import filter_source
from tests.conftest import problem_of
from tests.wrappers.filter_qp.decision_kernels import decided

x, y, u, w = sp.symbols("x y u w", real=True)

CONDITIONS = (
    "cbf",
    "ecbf",
    "hocbf",
    "hocbf:sampling_margin=first-order",
    "rcbf",
    "srcbf:form=log",
    "szcbf",
    "scbf",
    "scbf:sampling_margin=first-order",
)
OPTIONS = (
    {},
    {"knowledge": "plant", "priorities": (1.0, 5.0, 0.2, 3.0, 2.0)},
    {"objective": "clf"},
)
KINDS = {"idle", "met", "missed"}


def filters_of(problem: SafetyProblem) -> Iterator[SafetyFilter]:
    """Filters of a problem with each of the conditions and options that it allows."""
    for condition, options in itertools.product(CONDITIONS, OPTIONS):
        given: dict[str, Any] = dict(options)
        if "priorities" in given:
            given["priorities"] = given["priorities"][: len(problem.barriers)]
        if "objective" not in given or problem.clf is not None:
            with suppress(RelativeDegreeError):
                yield SafetyFilter.for_problem(
                    problem, parse_conditions(condition, problem), **given
                )


def situations(problem: SafetyProblem, count: int) -> tuple[np.ndarray, np.ndarray]:
    """States in and around the region of a problem, with proposals in and around its box."""
    rng = np.random.default_rng(0)
    found = []
    for ranges, beyond in ((problem.sampling_domain.region, 0.2), (problem.box, 0.5)):
        low, high = np.array(ranges).T
        shares = rng.uniform(-beyond, 1.0 + beyond, (count, len(low)))
        found.append(low + (high - low) * shares)
    return found[0], found[1]


class Decided:
    """A program's decisions at one state after the other."""

    def __init__(self, safety_filter: SafetyFilter, *, compiled: bool = False) -> None:
        data = Data()
        source = filter_source(safety_filter.qp, data)
        program = Program("filter", [decided], source)
        functions = program.compiled() if compiled else program.plain()
        self._decide, self._data = functions["decided"], data.array()
        self._work = np.full(source.work, np.nan)  # which holds nothing that may be read

    def __call__(self, state: Sequence[float], proposal: Sequence[float]) -> tuple:
        return self._decide(tuple(state), tuple(proposal), self._data, self._work)


def check(
    safety_filter: SafetyFilter,
    states: np.ndarray,
    inputs: np.ndarray,
    most: int = 3,
    *,
    compiled: bool = False,
) -> set[str]:
    """Compare decisions with those on a batch, at `most` of each kind; return the kinds."""
    shape = (len(states),)
    found = safety_filter.decide_arrays(tuple(states.T), tuple(inputs.T))
    action, _, active, slack, proposed = [
        np.stack([filled(c, shape) for c in part], axis=1)
        for part in (*found[:3], found.slack, found.proposed)
    ]
    feasible, causes = filled(found.feasible, shape), filled(found.cause, shape)
    kinds = np.where(feasible, np.where(active.any(axis=1), "met", "idle"), "missed")
    decide = Decided(safety_filter, compiled=compiled)
    size = max(abs(bound) for bound in (*safety_filter.qp.low, *safety_filter.qp.high))
    for kind in KINDS:
        for i in np.flatnonzero(kinds == kind)[:most]:
            answer, changed, acts, met, lacks, cause, sound = decide(
                states[i].tolist(), inputs[i].tolist()
            )
            assert sound
            # A batch adds the terms of a sum in another order.
            np.testing.assert_allclose(answer, action[i], rtol=0.0, atol=1e-12 * size)
            np.testing.assert_allclose(changed, proposed[i], rtol=1e-12, atol=1e-12 * size)
            np.testing.assert_allclose(lacks, slack[i], rtol=1e-9, atol=1e-12)
            assert (acts, met) == (active[i].any(), feasible[i])
            assert cause == causes[i] or not acts
    return set(kinds)


def test_a_filter_of_every_id(env_id: str) -> None:
    problem = problem_of(env_id)
    safety_filter = SafetyFilter.for_problem(problem, parse_conditions("scbf", problem))
    if (len(problem.barriers), len(problem.inputs)) == (3, 4):
        with pytest.raises(NotCompilableError, match="3 constraints on 4 inputs need a solver"):
            filter_source(safety_filter.qp, Data())
    else:
        assert check(safety_filter, *situations(problem, 500)) >= {"idle", "met"}


@pytest.mark.oracle
def test_every_filter_of_every_id(env_id: str) -> None:
    problem = problem_of(env_id)
    if (len(problem.barriers), len(problem.inputs)) == (3, 4):
        return
    states, inputs = situations(problem, 2000)
    found = [check(each, states, inputs, most=40) for each in filters_of(problem)]
    assert set().union(*found) == KINDS


@pytest.mark.oracle
def test_compiled_filters_of_every_id(env_id: str) -> None:
    problem = problem_of(env_id)
    if (len(problem.barriers), len(problem.inputs)) == (3, 4):
        return
    safety_filter = SafetyFilter.for_problem(problem, parse_conditions("scbf", problem))
    check(safety_filter, *situations(problem, 2000), most=500, compiled=True)
