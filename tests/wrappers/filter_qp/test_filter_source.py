"""The filter as a function of compiled programs: the decisions of `SafetyFilter`."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import sympy as sp

from safe_envs import (
    CLF,
    Barrier,
    ControlAffineSDE,
    NumericalError,
    RelativeDegreeError,
)
from safe_envs.dynamics.codegen import filled
from safe_envs.engine.formulas import Source, formulas
from safe_envs.engine.program import Program
from safe_envs.engine.slots import Data
from safe_envs.filters.conditions.base import AffineConstraint
from safe_envs.filters.conditions.bayesian import BayesianSCBF
from safe_envs.filters.conditions.learned import DDSCBF, LearnedHOCBF
from safe_envs.filters.decision_source import filter_source, unfiltered_source
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers import (
    CBF,
    RCBF,
    SRCBF,
    SafetyFilter,
    SafetyFilterVectorWrapper,
    parse_conditions,
)
from tests.conftest import problem_of
from tests.wrappers.filter_qp.decision_kernels import decided
from tests.wrappers.learned import Terms

x, y, z, s, u, v, w = sp.symbols("x y z s u v w", real=True)

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
        with np.errstate(all="ignore"):
            return self._decide(tuple(state), tuple(proposal), self._data, self._work)


def check(
    safety_filter: SafetyFilter,
    states: np.ndarray,
    inputs: np.ndarray,
    most: int = 3,
    *,
    compiled: bool = False,
) -> set[str]:
    """Compare decisions with those on a batch, at `most` of each kind; return the kinds.

    In plain Python they are those on one state, to the bit, but for sines, which programs compute
    by themselves, for sums of three products and more: these are added in another way by NumPy
    in networks, and by Python 3.12, and for two inputs that cannot meet several constraints: there
    each has a method of its own.
    """
    shape = (len(states),)
    found = safety_filter.decide_arrays(tuple(states.T), tuple(inputs.T))
    action, _, active, slack, proposed = [
        np.stack([filled(c, shape) for c in part], axis=1)
        for part in (*found[:3], found.slack, found.proposed)
    ]
    feasible, causes = filled(found.feasible, shape), filled(found.cause, shape)
    kinds = np.where(feasible, np.where(active.any(axis=1), "met", "idle"), "missed")
    decide = Decided(safety_filter, compiled=compiled)
    by_solver = len(safety_filter.qp.low) + (safety_filter.qp.clf is not None) > 2
    several = len(safety_filter.qp.constraints) + (safety_filter.qp.clf is not None) > 1
    has_networks = not all(isinstance(term, Terms) for term in safety_filter.qp.terms)
    has_sines = any(
        e.has(sp.sin, sp.cos, sp.atan2)
        for constraint in safety_filter.qp.constraints
        for e in map(sp.sympify, (*constraint.coefficient, constraint.offset))
    )
    size = max(abs(bound) for bound in (*safety_filter.qp.low, *safety_filter.qp.high))
    for kind in KINDS:
        for i in np.flatnonzero(kinds == kind)[:most]:
            situation = states[i].tolist(), inputs[i].tolist()
            answer, changed, acts, met, lacks, cause, sound = decide(*situation)
            assert sound
            own_method = several and kind == "missed"
            if not (compiled or has_networks or by_solver or has_sines or own_method):
                single = safety_filter.decide_floats(*situation)
                assert (answer, lacks) == (tuple(single.action), tuple(single.slack))
            # A batch adds the terms of a sum in another order.
            error = (1e-10 if by_solver else 1e-12) * size
            np.testing.assert_allclose(answer, action[i], rtol=0.0, atol=error)
            np.testing.assert_allclose(changed, proposed[i], rtol=1e-12, atol=1e-12 * size)
            np.testing.assert_allclose(lacks, slack[i], rtol=1e-9, atol=1e-12)
            assert (acts, met) == (active[i].any(), feasible[i])
            assert cause == causes[i] or not acts
    return set(kinds)


def test_a_filter_of_every_id(env_id: str) -> None:
    problem = problem_of(env_id)
    safety_filter = SafetyFilter.for_problem(problem, parse_conditions("scbf", problem))
    found = check(safety_filter, *situations(problem, 500))
    assert "met" in found
    assert len(found) > 1


def test_decisions_on_the_way_of_a_filtered_quadrotor() -> None:
    env_id = "safe_envs/QuadrotorLimits-v0"
    problem = problem_of(env_id)
    safety_filter = SafetyFilter.for_problem(problem, parse_conditions("hocbf", problem))
    env: Any = SafetyFilterVectorWrapper(gym.make_vec(env_id, num_envs=10, noise=0.1), "hocbf")
    env.reset(seed=0)
    rng, states, inputs = np.random.default_rng(0), [], []
    low, high = np.array(problem.box).T
    for _ in range(40):
        actions = np.clip(rng.normal(0.1, 0.7, env.action_space.shape), -1.0, 1.0)
        states.append(np.array(env.unwrapped.state))
        inputs.append(low + (high - low) * (actions + 1.0) / 2.0)
        env.step(actions.astype(np.float32))
    found = check(safety_filter, np.concatenate(states), np.concatenate(inputs), most=25)
    assert found >= {"idle", "met"}


@pytest.mark.oracle
def test_every_filter_of_every_id(env_id: str) -> None:
    problem = problem_of(env_id)
    states, inputs = situations(problem, 2000)
    found = [check(each, states, inputs, most=40) for each in filters_of(problem)]
    assert set().union(*found) == KINDS


@pytest.mark.oracle
def test_a_compiled_filter_of_every_id(env_id: str) -> None:
    problem = problem_of(env_id)
    safety_filter = SafetyFilter.for_problem(problem, parse_conditions("scbf", problem))
    check(safety_filter, *situations(problem, 2000), most=500, compiled=True)


@dataclass(frozen=True)
class Doubtful(CBF):
    """A constraint that is known up to an error, whose form is as given."""

    form: tuple[Any, ...] = ()

    def derived(self, model: ControlAffineSDE, barrier: Barrier) -> AffineConstraint:
        form = tuple(map(sp.sympify, self.form))
        return replace(super().derived(model, barrier), uncertainty=form)


@dataclass(frozen=True)
class Corrected(CBF):
    """A constraint with learned terms in its coefficients and its offset."""

    learned: Any = None

    def derived(self, model: ControlAffineSDE, barrier: Barrier) -> AffineConstraint:
        found = super().derived(model, barrier)
        slope, *more = self.learned.symbols
        return replace(
            found,
            coefficient=tuple(c * slope for c in found.coefficient),
            offset=found.offset + sum(more),
            terms=self.learned,
        )


class Measured(Terms):
    """Given functions in the place of a network, which programs have, too."""

    def __init__(self, system: ControlAffineSDE, expressions: Sequence[Any]) -> None:
        super().__init__(system, 1, expressions)
        self._formulas = {"x": system.states}, expressions

    def source(self, name: str, data: Data) -> Source:
        inner = formulas(f"{name}_inner", *self._formulas, data)
        return inner + Source(
            f"def {name}(x, data, work):\n    work[0] = 7.0\n    return {name}_inner(x, data)\n",
            work=1,
        )


def integrators(m: int) -> ControlAffineSDE:
    """A state for each of up to three inputs, and one more that falls, with noise in the first."""
    states, inputs = (*(x, y, z)[:m], s), (u, v, w)[:m]
    gains = [[1 if i == j else 0 for j in range(m)] for i in range(m)] + [[0] * m]
    return ControlAffineSDE(states, inputs, [0] * m + [-s], gains, [0.3] + [0] * m)


CURVED, STEEP, SLANTED = 2 - x**2 + 0.3 * s * x, 1 + 2 * x + s**2, 1 - x * s + s
ROUND, TILTED, ACROSS = 2 - x**2 - y**2, 1 + x + 0.5 * y + x * y, 1.5 - y + 0.2 * s * x
EARLY = {"sampling_margin": "first-order"}
ONE = Measured(integrators(1), [1.2 + sp.sin(x), 0.1 * s])
OTHER = Measured(integrators(1), [1 - s**2 / 9, x, s])
CASES: dict[str, tuple[int, list[tuple[Any, Any]], dict[str, Any]]] = {
    "one reciprocal": (1, [(CURVED, SRCBF(0.7))], {}),
    "one sampled": (1, [(CURVED, CBF(1.0, **EARLY))], {}),
    "one on three inputs": (3, [(CURVED + y - z**2, CBF(1.0))], {"weights": (1.0, 3.0, 0.5)}),
    "several on three": (
        3,
        [(ROUND - z**2, CBF(1.0)), (TILTED + z, CBF(2.0, **EARLY)), (ACROSS - z, CBF(0.5))],
        {"weights": (5.0, 0.2, 1.0)},
    ),
    "reciprocal among several on three": (
        3,
        [(ROUND - z**2, CBF(1.0)), (TILTED + z, RCBF(2.0)), (ACROSS - z, CBF(0.5))],
        {},
    ),
    "reciprocal on three": (3, [(CURVED + y - z**2, RCBF(1.0))], {"weights": (1.0, 3.0, 0.5)}),
    "sampled on three": (3, [(CURVED + y - z**2, CBF(1.0, **EARLY))], {}),
    "several": (1, [(CURVED, CBF(1.0)), (STEEP, CBF(0.5)), (SLANTED, CBF(2.0, **EARLY))], {}),
    "early reciprocal": (1, [(CURVED, RCBF(1.0, **EARLY)), (STEEP, CBF(1.0, **EARLY))], {}),
    "several reciprocal": (1, [(CURVED, RCBF(1.0)), (STEEP, CBF(0.5)), (SLANTED, SRCBF(2.0))], {}),
    "plane": (
        2,
        [(ROUND, CBF(1.0)), (TILTED, CBF(2.0, **EARLY)), (ACROSS, CBF(0.5))],
        {"weights": (5.0, 0.2)},
    ),
    "reciprocal in a plane": (
        2,
        [(ROUND, RCBF(1.0)), (TILTED, SRCBF(1.0)), (ACROSS, CBF(0.5))],
        {},
    ),
    "goal": (1, [(CURVED, CBF(1.0))], {"clf": CLF((x - 3) ** 2, input_weight=0.5)}),
    "goal of several": (
        1,
        [(CURVED, RCBF(1.0)), (STEEP, Doubtful(0.5, form=(x**2, 0, 0.1))), (SLANTED, CBF(2.0))],
        {"clf": CLF((x - 1) ** 2 + s**2, slack_weight=4.0)},
    ),
    "goal on two": (2, [(ROUND, CBF(1.0))], {"clf": CLF((x - 3) ** 2 + y**2)}),
    "goal of several on two": (
        2,
        [(ROUND, RCBF(1.0)), (TILTED, CBF(2.0, **EARLY)), (ACROSS, CBF(0.5))],
        {"clf": CLF((x - 1) ** 2 + (y + s) ** 2, slack_weight=4.0)},
    ),
    "uncertain": (1, [(CURVED, Doubtful(1.0, form=(0.1, 0.02, 0.3)))], {}),
    "several uncertain": (
        1,
        [(CURVED, CBF(1.0, **EARLY)), (STEEP, Doubtful(0.5, form=(0.1 + x**2, 0.05, 0.3)))],
        {},
    ),
    "plane above": (2, [(ROUND, Doubtful(1.0, form=(0.1, 0, 0, 0.2, 0.1, 0.2)))], {}),
    "planes above": (
        2,
        [
            (ROUND, Doubtful(1.0, form=(0.1, 0, 0, 0.2, 0.1, 0.2))),
            (TILTED, Doubtful(1.0, form=(x**2, x * s / 4, 0, 0.2 + s**2, 0.1, 0.2))),
        ],
        {},
    ),
    "minimum": (1, [(sp.Min(CURVED, STEEP), CBF(1.0)), (SLANTED, CBF(2.0, **EARLY))], {}),
    "reciprocal minimum": (2, [(sp.Min(ROUND, TILTED), RCBF(1.0)), (ACROSS, CBF(0.5))], {}),
    "maximum": (1, [(sp.Max(CURVED, SLANTED), CBF(1.0))], {}),
    "maximum in a plane": (
        2,
        [(TILTED, CBF(2.0, **EARLY)), (sp.Max(ROUND, ACROSS, -x), CBF(1.0))],
        {"weights": (5.0, 0.2)},
    ),
    "maxima on three": (
        3,
        [(sp.Min(sp.Max(ROUND, -z), TILTED + z), CBF(1.0)), (sp.Max(CURVED, z), CBF(0.5))],
        {},
    ),
    "goal of a maximum": (1, [(sp.Max(CURVED, SLANTED), CBF(1.0))], {"clf": CLF((x - 3) ** 2)}),
    "learned": (1, [(CURVED, Corrected(1.0, learned=ONE))], {}),
    "several learned": (
        1,
        [
            (CURVED, Corrected(1.0, learned=ONE, **EARLY)),
            (STEEP, Corrected(0.5, learned=OTHER)),
            (SLANTED, Corrected(2.0, learned=ONE)),
        ],
        {},
    ),
}


def case_of(name: str) -> tuple[SafetyFilter, np.ndarray, np.ndarray]:
    """A filter, states, and proposals."""
    m, pairs, options = CASES[name]
    rng = np.random.default_rng(1)
    safety_filter = SafetyFilter(
        integrators(m),
        [(Barrier(h, name=f"h_{i}"), condition) for i, (h, condition) in enumerate(pairs)],
        bounds=[(-1.0, 1.5), (-2.0, 0.5), (-1.0, 1.0)][:m],
        priorities=[1.0, 4.0, 0.3][: len(pairs)],
        dt=0.05,
        **options,
    )
    return safety_filter, 1.5 * rng.normal(size=(300, m + 1)), 2.0 * rng.normal(size=(300, m))


@pytest.mark.parametrize("name", CASES)
def test_everything_that_a_filter_may_have(name: str) -> None:
    assert check(*case_of(name), most=8) == KINDS


@pytest.mark.parametrize("name", CASES)
def test_numbers_that_are_not_finite_are_told(name: str) -> None:
    safety_filter, states, inputs = case_of(name)
    decide = Decided(safety_filter)
    for state, proposal in (
        (np.full_like(states[0], 1e200), inputs[0]),
        (states[0], np.full_like(inputs[0], math.nan)),
    ):
        with pytest.raises(NumericalError):
            safety_filter.decide_arrays(tuple(state[:, None]), tuple(proposal[:, None]))
        *_, sound = decide(state.tolist(), proposal.tolist())
        assert not sound


@pytest.mark.parametrize(
    ("problem", "learned", "condition"),
    [
        ("disk", "residual", LearnedHOCBF),
        ("top", "network", DDSCBF),
        pytest.param("gap", "diffusion", DDSCBF, marks=pytest.mark.oracle),
        pytest.param("cubic", "posterior", BayesianSCBF, marks=pytest.mark.oracle),
    ],
)
def test_learned_filters(
    problem: str, learned: str, condition: Any, request: pytest.FixtureRequest
) -> None:
    tried, model = request.getfixturevalue(problem), request.getfixturevalue(learned)
    settings = {"confidence": 0.9} if condition is BayesianSCBF else {}
    found = condition.from_learned(model, tried.gains_of(0), **settings)
    safety_filter = SafetyFilter.for_problem(tried, found)
    assert check(safety_filter, *situations(tried, 500), most=8) >= {"idle", "met"}


@pytest.mark.oracle
@pytest.mark.parametrize("name", ["goal of several", "several learned", "planes above"])
def test_everything_compiled(name: str) -> None:
    assert check(*case_of(name), most=200, compiled=True) == KINDS


def test_filters_that_differ_in_their_numbers_share_a_program() -> None:
    one = SafetyFilter(integrators(1), [(Barrier(CURVED), CBF(1.3))], bounds=[(-1.0, 1.0)])
    other = SafetyFilter(integrators(1), [(Barrier(CURVED), CBF(2.7))], bounds=[(-2.0, 3.0)])
    texts = {filter_source(each.qp, Data()).text for each in (one, other)}
    assert len(texts) == 1


def test_without_a_filter_every_input_passes() -> None:
    decide = Program("none", [decided], unfiltered_source(2)).plain()["decided"]
    found = decide((1.0,), (0.3, 7.0), np.empty(0), np.empty(0))
    assert found == ((0.3, 7.0), (0.3, 7.0), False, True, (0.0,), 0, True)


def test_what_no_input_changes_is_the_cause_where_nothing_else_acts() -> None:
    system = ControlAffineSDE((x, y), (u, v), [0, 0], np.eye(2, dtype=int), [0, 0])
    barriers = [9 + y, -1 - x**2, -2 - x**2]
    # Flat and met; two flat and unmet; with a steep one that acts; all of them steep.
    states = np.array([[0.0, 0.0], [0.0, 1.0], [0.0, -8.5], [0.5, 0.0]])
    inputs = np.array([[1.0, 1.0], [0.0, 0.0], [0.0, -1.0], [0.0, 0.0]])
    for conditions in ("cbf", ["srcbf" if i == 0 else "cbf" for i in range(3)]):
        safety_filter = SafetyFilter(system, barriers, conditions, (-1, 1))
        found = safety_filter.filter(states, inputs)
        assert found.active[:, 1:].all()
        wanted = [1, 1, 0 if found.active[2, 0] else 1, 2]
        assert found.cause.tolist() == wanted
        assert isinstance(conditions, list) or found.active[2, 0]
        ones = zip(states, inputs, strict=True)
        assert [safety_filter.filter(*one).cause for one in ones] == wanted
        decide = Decided(safety_filter)
        ones = zip(states.tolist(), inputs.tolist(), strict=True)
        assert [decide(*one)[5] for one in ones] == wanted
