"""A barrier without a value is not safe: nowhere does it end a run, and nowhere does it count as
safe."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import sympy as sp
import torch

from safe_envs import (
    Barrier,
    ControlAffineSDE,
    NumericalError,
    SafeEnv,
    SafeVectorEnv,
    define_problem,
)
from safe_envs.agents import evaluate
from safe_envs.agents.rare_events.estimate import estimate_rare
from safe_envs.filters.decision_log import DecisionLog
from safe_envs.filters.torch_layer import TorchFilter
from safe_envs.problem.named_sets import NamedSets
from safe_envs.proofs.feasibility import verify
from safe_envs.values.look_ahead import draw_starts
from safe_envs.wrappers import (
    SafetyFilter,
    SafetyFilterVectorWrapper,
    SafetyFilterWrapper,
    parse_conditions,
)

p, v, a = sp.symbols("p v a", real=True)
LOST, KEPT, EDGE = [1.3, 0.2], [-1.0, 0.3], [1.0, 0.4]


def stop(h=None, **changes):
    """A vehicle before a wall at p = 1, whose barrier is the speed that it may have there."""
    return define_problem(
        ControlAffineSDE.from_rate((p, v), (a,), [v, a], diffusion=[0, sp.Rational(1, 20)]),
        sp.sqrt(2 * (1 - p)) - v if h is None else h,
        **{
            "input_bounds": (-1.0, 1.0),
            "start": [(-1.0, 1.3), (0.0, 1.5)],
            "dt": 0.1,
            "horizon": 1.0,
            "nominal": 1.0,
            "gains": (2.0,),
            "workspace": {p: (-3.0, 1.5), v: (-3.0, 3.0)},
            **changes,
        },
    )


@pytest.fixture(scope="module")
def problem():
    return stop()


def test_episodes_go_on_and_are_violated(problem):
    states = np.array([LOST, KEPT, EDGE])
    env = SafeVectorEnv(problem, 3, engine="numpy")
    batch = [env.reset(seed=4, options={"state": states})[1]]
    batch += [env.step(np.full((3, 1), 0.5))[-1] for _ in range(6)]
    for i, state in enumerate(states):
        env = SafeEnv(problem)
        infos = [env.reset(seed=4 + i, options={"state": state})[1]]
        infos += [env.step([0.5])[-1] for _ in range(6)]
        for info, ours in zip(infos, batch, strict=True):
            for key, value in info.items():
                assert value == pytest.approx(ours[key][i])
    barrier, h_min, cost = [
        np.array([i[k] for i in batch]) for k in ("barrier", "h_min", "episode_cost")
    ]
    assert (barrier[:, 0, 0] == -math.inf).all()
    assert (h_min[:, 0] == -math.inf).all()
    assert cost[:, 0].tolist() == [1, 2, 3, 4, 5, 6, 7]
    assert (cost[:, 1] == 0.0).all()
    assert barrier[0, 2, 0] == -0.4  # which has a value, and its slope has none
    assert barrier[-1, 2, 0] == -math.inf


@pytest.mark.parametrize(
    "condition", ["cbf", "szcbf", "scbf", "rcbf", "cbf:sampling_margin=first-order"]
)
@pytest.mark.parametrize("h", [None, sp.log(2 - p - v)])
def test_a_filter_executes_the_clipped_proposal_and_is_not_feasible(condition, h):
    problem = stop(h)
    safety_filter = SafetyFilter.for_problem(problem, condition)
    lost = [1.9, 0.4]
    states, inputs = np.array([KEPT, lost, lost, lost]), np.array([[3.0], [0.3], [7.0], [-7.0]])
    found = safety_filter.filter(states, inputs)
    for i in range(4):
        single = safety_filter.filter(states[i], inputs[i])
        assert single.action == pytest.approx(found.action[i])
        assert single.feasible == found.feasible[i]
        assert (single.barrier, single.cause) == (pytest.approx(found.barrier[i]), found.cause[i])
    assert found.action[1:, 0].tolist() == [0.3, 1.0, -1.0]
    assert found.feasible.tolist() == [True, False, False, False]
    assert found.barrier[1:, 0].tolist() == [-math.inf] * 3
    assert found.cause[1:].tolist() == [0, 0, 0]
    assert found.slack[:, 0].tolist() == [0.0, math.inf, math.inf, math.inf]
    assert found.margin[1:, 0].tolist() == [-math.inf] * 3


def test_the_other_barriers_are_kept():
    system = ControlAffineSDE.from_rate((p, v), (a,), [v, a])
    barriers = [Barrier(sp.log(1 - p), "wall"), Barrier(2 - v, "speed")]
    safety_filter = SafetyFilter(system, barriers, ["hocbf:alpha=1,1", "cbf"], (-9, 9))
    for state, proposal in (([1.5, 1.5], [5.0]), ([[1.5, 1.5]], [[5.0]])):
        found = safety_filter.filter(state, proposal)
        assert np.ravel(found.action) == pytest.approx([0.5])
        assert not np.any(found.feasible)
        assert np.ravel(found.slack) == pytest.approx([math.inf, 0.0], abs=1e-12)


def test_an_error_names_the_barrier_and_the_state():
    system = ControlAffineSDE.from_rate((p, v), (a,), [v, a])
    pole = ControlAffineSDE((p, v), (a,), [v, 1 / p], [0, 1], [0, 0])
    barriers = [Barrier(4 - v, "speed"), Barrier(9 - p, "place")]
    safety_filter = SafetyFilter(pole, barriers, ["cbf", "hocbf:alpha=1,1"], (-9, 9))
    for state in ([0.0, 1.0], [[1.0, 1.0], [0.0, 1.0]]):
        with pytest.raises(NumericalError) as error:
            safety_filter.filter(state, np.zeros((*np.shape(state)[:-1], 1)))
        assert "on speed, place has no finite value at p = 0, v = 1" in str(error.value)
    overflowing = SafetyFilter(
        system, [barriers[0], Barrier(9 - p**3 / 1e9, "cube")], ["cbf", "hocbf:alpha=1,1"], (-9, 9)
    )
    with pytest.raises(NumericalError, match=r"on cube has no finite value at p = 1e\+120"):
        overflowing.filter([1e120, 0.0], [0.0])


@pytest.mark.slow
def test_filtered_envs_agree_in_every_engine(problem):
    states = np.array([LOST, KEPT, EDGE])
    batches = [
        SafetyFilterVectorWrapper(SafeVectorEnv(problem, 3, engine=engine), "cbf")
        for engine in ("numpy", "compiled")
    ]
    infos = [env.reset(seed=1, options={"state": states})[1] for env in batches]
    for k in range(4):
        for key, value in infos[0].items():
            np.testing.assert_allclose(value, infos[1][key], rtol=1e-12)
            assert not np.isnan(value).any()
        infos = [env.step(np.full((3, 1), 0.4 * k))[-1] for env in batches]
        assert infos[0]["feasible"][:2].tolist() == [False, True]
        assert infos[0]["safe_action"][0] == min(0.4 * k, 1.0)


def test_a_wrapped_env_says_so_and_is_drawn(problem):
    env = SafetyFilterWrapper(SafeEnv(problem, render_mode="rgb_array"), "cbf")
    env.reset(seed=1, options={"state": LOST})
    info = env.step([1.0])[-1]
    assert (info["feasible"], info["h_min"]) == (False, -math.inf)
    assert env.render().ndim == 3


def test_evaluations_count_violations(problem):
    given = {"filters": ["none", "cbf"], "episodes": 60, "bounds": False, "engine": "numpy"}
    free, kept = evaluate(problem, **given).rows
    assert 30 < free.violations > kept.violations
    assert free.min_h_median == -math.inf
    assert json.loads(json.dumps(free.as_dict(), allow_nan=False))["min_h_median"] is None


@pytest.mark.oracle
def test_evaluations_agree_in_every_engine(problem):
    given = {"filters": "cbf", "episodes": 60, "bounds": False, "monitoring": "continuous"}
    rows = [evaluate(problem, engine=e, **given).rows[0] for e in ("numpy", "compiled")]
    for key in ("safe", "violations", "infeasible_rate", "min_h_p05", "effort_mean"):
        assert getattr(rows[0], key) == pytest.approx(getattr(rows[1], key), rel=1e-9)


def test_starts_without_a_value_are_drawn_again(problem):
    drawn = np.array(draw_starts(problem, 500, 0))
    assert (2 * (1 - drawn[0]) >= drawn[1] ** 2).all()
    env = SafeEnv(problem)
    assert all(env.reset(seed=seed)[1]["h_min"] > 0.0 for seed in range(200))


def test_verify_and_rare_events(problem):
    assert verify(problem, parse_conditions("cbf", problem), samples=500).part.share > 0.0
    found = estimate_rare(problem, filters=["cbf"], repetitions=10, particles=20)
    assert 0.0 < found.rows[0].probability < 1.0


def test_third_party_envs_are_monitored():
    spec = {
        "model": ControlAffineSDE((p, v), (a,), [v, 9.81 * sp.sin(p)], [0, 1], [0, 0]),
        "barriers": sp.sqrt(1 - p**2 / 4) - v / 8,
        "state_fn": lambda o: np.stack([np.arctan2(o[..., 1], o[..., 0]), o[..., 2]], axis=-1),
        "dt": 0.05,
    }
    one = SafetyFilterWrapper(gym.make("Pendulum-v1"), "cbf", **spec)
    batch = SafetyFilterVectorWrapper(gym.make_vec("Pendulum-v1", 2), "cbf", **spec)
    one.reset(seed=0)
    batch.reset(seed=0)
    for _ in range(60):
        info, infos = one.step([0.0])[-1], batch.step(np.zeros((2, 1), dtype=np.float32))[-1]
        assert infos["barrier"][0] == pytest.approx(info["barrier"])
        assert infos["feasible"][0] == info["feasible"]
    assert info["h_min"] == -math.inf
    assert 0 < info["episode_infeasible"] < 60


def test_sets_logs_and_gradients(problem):
    values = NamedSets(problem, ["safe"]).values(tuple(np.array([LOST, KEPT]).T))
    assert values[0, 0] == -math.inf < values[0, 1]
    safety_filter = SafetyFilter.for_problem(problem, "cbf")
    log = DecisionLog.for_filter(safety_filter)
    log.add(0.0, LOST, safety_filter.filter(LOST, [0.5]))
    assert log.h_min == -math.inf
    states = torch.tensor([LOST, KEPT], dtype=torch.float64, requires_grad=True)
    found = TorchFilter(safety_filter)(states, torch.tensor([[0.5], [0.5]]).double(), True)
    found.action.sum().backward()
    assert found.differentiable.tolist() == [False, True]
    assert bool(states.grad.isfinite().all())


def test_what_else_has_no_value_ends_a_run_and_is_named(problem):
    spoilt = replace(problem, reward=sp.sqrt(1 - p))
    for env, states in (
        (SafeEnv(spoilt), LOST),
        (SafeVectorEnv(spoilt, 2, engine="numpy"), np.array([KEPT, LOST])),
    ):
        with pytest.raises(NumericalError, match=r"the reward of .* value at p = 1\.3, v = 0\.2"):
            env.reset(seed=0, options={"state": states})
