"""What a picture remembers of an episode, and how it writes numbers."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from safe_envs import SafeEnv, SafeVectorEnv
from safe_envs.rendering import style
from safe_envs.wrappers import SafetyFilterWrapper
from tests.conftest import problem_of
from tests.rendering.drawn import DUBINS, stepped, written
from tests.wrappers.cases import SWING, rate


def test_a_restored_snapshot_is_what_is_drawn():
    envs = stepped(SafeVectorEnv(problem_of(DUBINS), 2, render_mode="rgb_array"), 4)
    snapshot = envs.snapshot()
    envs.reset(seed=5)
    envs.restore(snapshot)
    assert all(
        history.snapshot.times[-1] == pytest.approx(0.2) for history in envs.viewer._histories
    )
    np.testing.assert_array_equal(envs.viewer._histories[1].snapshot.state, snapshot["state"][1])


def histories(monkeypatch, kept: int, count: int):
    """A history that keeps few states of an episode whose smallest barrier is that of its second
    state."""
    from safe_envs.rendering import snapshot

    monkeypatch.setattr(snapshot, "_KEPT", kept)
    recorded = snapshot.History(problem_of("safe_envs/Scalar-v0"))
    recorded.restart([0.0], 0.0)
    for k in range(1, count):
        recorded.append([9.5 if k == 1 else 0.01 * k], 0.1 * k, None, None)
    return recorded


@pytest.mark.parametrize("count", [9, 10, 11, 23])
def test_a_long_history_keeps_the_latest_states(monkeypatch, count):
    moment = histories(monkeypatch, 5, count).snapshot
    assert min(count, 5) <= len(moment.times) <= 10
    steps = np.arange(count)[-len(moment.times) :]
    np.testing.assert_allclose(moment.times, 0.1 * steps)
    states = np.where(steps == 1, 9.5, 0.01 * steps)
    np.testing.assert_allclose(moment.states[:, 0], states)
    np.testing.assert_allclose(moment.h, 1.0 - states)
    # What is not kept counts all the same.
    assert moment.least == pytest.approx(-8.5)
    np.testing.assert_allclose(moment.violated, [9.5])
    assert moment.violated_at == pytest.approx(0.1)


def test_a_new_episode_forgets_the_least_barrier(monkeypatch):
    recorded = histories(monkeypatch, 5, 3)
    recorded.restart([0.5], 0.0)
    assert recorded.snapshot.least == pytest.approx(0.5)
    assert recorded.snapshot.violated is None


def test_the_panel_says_the_least_of_the_whole_episode(monkeypatch):
    from safe_envs.rendering import snapshot

    monkeypatch.setattr(snapshot, "_KEPT", 4)
    env = SafeEnv(
        problem_of("safe_envs/Scalar-v0", noise=1.0, start=[0.9]), render_mode="rgb_array"
    )
    env.reset(seed=0)
    for _ in range(40):
        *_, info = env.step([-1.0])
    texts = written(monkeypatch)
    env.render()
    assert info["h_min"] < env.viewer._histories[0].snapshot.h.min()
    assert f"least {style.number(info['h_min'])}" in texts


def test_a_decision_is_of_one_step():
    from safe_envs.rendering.viewer import Viewer

    viewer = Viewer(problem_of("safe_envs/Scalar-v0"), "rgb_array", 1)
    history = viewer._histories[0]
    viewer.restart([[0.0]], [0.0], [0])
    viewer.announce([[1.0]], [True], [False])
    viewer.restart([[0.0]], [0.0], [0])
    viewer.advance([[0.0]], [0.1], [[0.5]])
    assert history.snapshot.decision is None
    viewer.announce([[1.0]], [True], [False])
    viewer.advance([[0.0]], [0.2], [[0.5]])
    assert history.snapshot.infeasible
    assert history.snapshot.intervening
    viewer.advance([[0.0]], [0.3], [[0.5]])
    assert history.snapshot.decision is None


@pytest.mark.parametrize("limited", [True, False])
def test_an_env_without_a_limit_of_time_has_no_horizon(monkeypatch, limited):
    bare = gym.make("Pendulum-v1", render_mode="rgb_array")
    view = {**SWING, "barriers": 4 - rate}
    env = SafetyFilterWrapper(bare if limited else bare.unwrapped, "cbf", **view)
    env.reset(seed=0)
    env.step([0.0])
    texts = written(monkeypatch)
    env.render()
    assert "t = 0.05 s" in texts
    assert [text for text in texts if text.startswith("of ")] == (["of 10 s"] if limited else [])
    # The chart shows the whole past, in a range that begins with 100 steps.
    assert ("10 s" if limited else "5 s") in texts
    for _ in range(100):
        env.step([0.0])
    env.render()
    assert texts.count("0 s") == 2
    assert "10 s" in texts[-20:]
