"""Where the engines differ in a flag, rounding decides: the step lies at a threshold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pytest

from safe_envs import RelativeDegreeError
from safe_envs.agents import make_policy
from safe_envs.engine.formulas import Source
from safe_envs.engine.program import Program
from safe_envs.engine.slots import Data
from safe_envs.envs.simulation import Simulation
from safe_envs.envs.spaces import center_and_half_width
from safe_envs.envs.world_source import world_source
from safe_envs.errors import NotCompilableError
from safe_envs.filters.decision_source import filter_source
from safe_envs.problem.problem import SafetyProblem
from safe_envs.proofs.safe_set import draw_starts
from safe_envs.wrappers import SafetyFilter
from tests.agents.evaluation.step_kernels import take_steps
from tests.conftest import problem_of

FLAGS = ("active", "intervention", "feasible", "violation", "end")
NEAR = 1e-12
CLOSE = 1e-10
ROWS = 2000


@dataclass
class Steps:
    """Steps from many states, by both engines."""

    problem: SafetyProblem
    safety_filter: SafetyFilter

    def __post_init__(self):
        self.simulation = Simulation(self.problem, "arrays")
        self.channels = self.simulation.integrator.channels
        data, n, m = Data(), self.problem.plant.n, len(self.problem.inputs)
        source = world_source(self.problem, data) + filter_source(self.safety_filter.qp, data)
        for name, width in (("state_at", n), ("input_at", m)):
            row = "".join(f"table[row, {i}], " for i in range(width))
            source += Source(f"def {name}(table, row):\n    return ({row})\n")
        self.program = Program(f"steps of {self.problem.name}", (take_steps,), source)
        self.data, self.work = data.array(), np.empty(max(source.work, 1))

    def by_numpy(self, x: np.ndarray, u: np.ndarray, draws: np.ndarray):
        """The actions, the states after the steps, and the flags."""
        states, inputs = (tuple(np.ascontiguousarray(a.T)) for a in (x, u))
        with np.errstate(all="ignore"):
            decision = self.safety_filter.decide_arrays(states, inputs)
            y = self.simulation.integrator.step(states, decision.action, draws.T)
            flags = np.zeros((len(x), len(FLAGS)), dtype=bool)
            flags[:, 0] = np.any(np.atleast_2d(decision.active), axis=0)
            for action, wanted in zip(decision.action, decision.proposed, strict=True):
                flags[:, 1] |= flags[:, 0] & (action != wanted)
            flags[:, 2] = decision.feasible
            flags[:, 3:] = self.at_the_end(y, decision.action)
        return np.stack(decision.action, axis=1), np.stack(y, axis=1), flags

    def at_the_end(self, y: Sequence[np.ndarray], action: Sequence[np.ndarray]) -> np.ndarray:
        """Whether states violate, and whether they end an episode."""
        _, barriers, _, outside, goal = self.simulation.measure(tuple(y), action, 0.0)
        violation = np.min(np.broadcast_arrays(*barriers), axis=0) <= 0.0
        ends = (outside > 0.0) | (self.problem.goal is not None and goal >= 0.0)
        return np.stack(np.broadcast_arrays(violation, ends, y[0])[:2], axis=1)

    def by_program(self, x: np.ndarray, u: np.ndarray, draws: np.ndarray, step):
        moved, actions, flags = np.empty_like(x), np.empty_like(u), np.zeros((len(x), 6), bool)
        step(x, u, np.ravel(draws), moved, actions, flags, self.data, self.work)
        return actions, moved, flags

    def lies_at_a_threshold(self, x, u, draws, flag: int, rng: np.random.Generator) -> bool:
        """Whether moving all numbers of a step by parts of 1e-12 changes a flag of NumPy."""
        count = 500

        def around(numbers):
            scale = NEAR * np.maximum(abs(numbers), 1.0)
            return numbers + scale * rng.uniform(-1.0, 1.0, (count, len(numbers)))

        return len(set(self.by_numpy(around(x), around(u), around(draws))[2][:, flag])) > 1


def compare(steps: Steps, rounds: int, step, seed: int = 0) -> list[tuple[str, np.ndarray]]:
    """Take steps by both engines from states of NumPy's trajectories; return what differs."""
    problem, rng = steps.problem, np.random.default_rng(seed)
    policy = make_policy("nominal", problem)
    center, half = map(np.array, center_and_half_width(problem))
    fresh = draw_starts(problem, ROWS, seed)
    x, age, differing = fresh.copy(), np.zeros(ROWS, dtype=int), []
    for _ in range(rounds):
        features = steps.simulation.measure(tuple(x.T), tuple(center), 0.0)[0]
        seen = np.stack([np.broadcast_to(f, ROWS) for f in features], axis=1).astype(np.float32)
        wanted = np.where(
            rng.random((ROWS, 1)) < 0.5,
            np.clip(policy.predict(seen)[0], -1.0, 1.0),
            rng.uniform(-1.0, 1.0, (ROWS, len(center))),
        )
        u, draws = center + half * wanted, rng.standard_normal((ROWS, steps.channels))
        actions, y, flags = steps.by_numpy(x, u, draws)
        actions_too, y_too, flags_too = steps.by_program(x, u, draws, step)
        assert flags_too[:, 5].all()
        apart = flags != flags_too[:, :5]
        for row, flag in np.argwhere(apart):
            assert steps.lies_at_a_threshold(x[row], u[row], draws[row], flag, rng), (
                FLAGS[flag],
                x[row].tolist(),
                u[row].tolist(),
            )
            differing.append((FLAGS[flag], x[row]))
        alike = ~apart[:, :3].any(axis=1)
        for ours, theirs, scale in ((actions_too, actions, half), (y_too, y, 1.0 + abs(y))):
            assert (abs(ours - theirs) <= CLOSE * scale)[alike].all()
        age += 1
        again = flags[:, 4] | ~np.isfinite(y).all(axis=1) | (age >= problem.steps)
        again |= rng.random(ROWS) < 0.01
        x, age = np.where(again[:, None], fresh, y), np.where(again, 0, age)
    return differing


def steps_of(problem: SafetyProblem, text: str) -> Steps:
    return Steps(problem, SafetyFilter.for_problem(problem, text))


def test_steps_as_plain_python():
    steps = steps_of(problem_of("safe_envs/StochasticDubins-v0"), "scbf")
    step = steps.program.plain()["take_steps"]
    assert compare(steps, 1, step) == []
    # The comparison notices another constraint.
    steps.data = 1.001 * steps.data
    with pytest.raises(AssertionError):
        compare(steps, 1, step)


def test_thresholds_are_recognised():
    steps = steps_of(problem_of("safe_envs/Scalar-v0"), "cbf")
    x, draws = np.array([0.9]), np.zeros(1)
    ((edge,),), _, ((active, *_),) = steps.by_numpy(x[None], np.array([[1.0]]), draws[None])
    assert active
    rng = np.random.default_rng(0)
    for off, near in ((0.0, True), (1e-9, False), (-1e-9, False)):
        assert steps.lies_at_a_threshold(x, np.array([edge + off]), draws, 0, rng) == near


@pytest.mark.oracle
@pytest.mark.parametrize("text", ["its own", "cbf", "hocbf", "scbf"])
def test_engines_differ_at_thresholds_alone(env_id, text, capsys):
    problem = problem_of(env_id)
    text = problem.filter if text == "its own" else text
    try:
        steps = steps_of(problem, text)
    except (RelativeDegreeError, NotCompilableError) as error:
        pytest.skip(str(error))
    # Where NumPy needs a solver it takes a millisecond a step.
    by_solver = len(problem.inputs) > 2 and len(problem.barriers) > 1
    count = 20_000 if by_solver else 1_000_000
    differing = compare(steps, count // ROWS, steps.program.compiled()["take_steps"])
    with capsys.disabled():
        print(f"{problem.name}, {text}: {len(differing)} flags of {count:,} steps differ")
        for flag, x in differing[:10]:
            print(f"  {flag} at {x.tolist()}")
