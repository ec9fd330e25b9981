"""Wrappers of Gymnasium and Stable-Baselines3 above and below a filter, as in the guide's table.

The filter over a wrapped env is compared with the filter over the env itself, on equal proposals.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import wrappers
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize

import safe_envs  # noqa: F401  (registers the ids)
from safe_envs.agents import make_sb3_env
from safe_envs.errors import ConfigurationError, InvalidInputError, SystemDefinitionWarning
from safe_envs.plugins import load_object
from safe_envs.wrappers import SafetyFilterWrapper
from safe_envs.wrappers.layers import doubt_layers

ROOT = Path(__file__).parents[2]
GUIDE = ROOT / "docs" / "guides" / "wrap-an-env.md"
SPEC = load_object(f"{ROOT / 'examples' / 'pendulum_v1.py'}:spec")
STEPS = 30

Wrap = Callable[[Any], Any]


def rescaled(env: Any) -> Any:
    return wrappers.RescaleAction(env, np.float32(-0.5), np.float32(0.5))


def own(wrap: Wrap = lambda env: env, **options: Any) -> Any:
    return SafetyFilterWrapper(wrap(gym.make("safe_envs/Pendulum-v0", **options)), "scbf")


def third_party(wrap: Wrap = lambda env: env, **options: Any) -> Any:
    env = wrap(gym.make("Pendulum-v1", **options))
    return SafetyFilterWrapper(
        env, SPEC.filter, model=SPEC.model, barriers=SPEC.barriers, state_fn=SPEC.state_fn
    )


def steps(env: Any, share: float = 1.0, count: int = STEPS) -> Iterator[dict[str, Any]]:
    """Yield the infos of an episode in which the policy proposes a share of the largest action."""
    env.reset(seed=0)
    for _ in range(count):
        *_, ended, truncated, info = env.step(np.float32(share) * env_high(env))
        yield info
        if ended or truncated:
            return


def env_high(env: Any) -> Any:
    high = env.action_space.high
    return high if np.isfinite(high).all() else np.full_like(high, 2.0)


def executed(env: Any, **options: Any) -> np.ndarray:
    return np.array([info["safe_action"] for info in steps(env, **options)])


SAME: dict[str, Wrap] = {
    "TimeLimit": lambda env: wrappers.TimeLimit(env, STEPS),
    "RecordEpisodeStatistics": wrappers.RecordEpisodeStatistics,
    "NormalizeReward": wrappers.NormalizeReward,
}
"""Wrappers that change neither actions nor what a filter sees."""

SIGHT: dict[str, Wrap] = {
    "FlattenObservation": wrappers.FlattenObservation,
    "NormalizeObservation": wrappers.NormalizeObservation,
    "FrameStackObservation": lambda env: wrappers.FrameStackObservation(env, 3),
    "DelayObservation": lambda env: wrappers.DelayObservation(env, 2),
}
"""Wrappers that change observations."""

ACTIONS: dict[str, Wrap] = {
    "RescaleAction": rescaled,
    "ClipAction": wrappers.ClipAction,
    "StickyAction": lambda env: wrappers.StickyAction(env, 0.5),
    "DiscretizeAction": lambda env: wrappers.DiscretizeAction(env, 5),
}
"""Wrappers that change actions."""

REPEATS: dict[str, Wrap] = {
    "MaxAndSkipObservation": lambda env: wrappers.MaxAndSkipObservation(env, 2),
    "RepeatAction": lambda env: wrappers.RepeatAction(env, 2),
}
"""Wrappers that change how long actions act."""

RESET = "Autoreset"

VECTORS: dict[str, Wrap] = {
    "VecNormalize": VecNormalize,
    "VecFrameStack": lambda envs: VecFrameStack(envs, 3),
}
VIDEO = "RecordVideo"


@pytest.mark.parametrize("name", [*SAME, *SIGHT, "RescaleAction", "ClipAction"])
@pytest.mark.parametrize("made", [own, third_party])
def test_above_the_filter_every_wrapper_leaves_its_decisions_alone(name: str, made: Any):
    above = {**SAME, **SIGHT, **ACTIONS}[name](made())
    np.testing.assert_array_equal(executed(above), executed(made()))


@pytest.mark.parametrize("made", [own, third_party])
def test_changed_actions_above_the_filter_are_filtered_in_every_period(made: Any):
    env = ACTIONS["StickyAction"](made())
    assert all(info["barrier"].min() >= 0.0 for info in steps(env))
    discrete = ACTIONS["DiscretizeAction"](made())
    discrete.reset(seed=0)
    found = [discrete.step(discrete.action_space.n - 1)[-1]["safe_action"] for _ in range(STEPS)]
    # The last of five equal parts of the range is represented by its middle.
    np.testing.assert_array_equal(found, executed(made(), share=0.8))
    *_, expected = steps(made())
    for wrap in REPEATS.values():
        *_, last = steps(wrap(made()), count=STEPS // 2)
        assert last["episode_interventions"] == expected["episode_interventions"]
    fresh = wrappers.Autoreset(wrappers.TimeLimit(made(), 3))
    assert len(list(steps(fresh, count=3))) == 3
    assert fresh.step(env_high(fresh))[-1]["episode_interventions"] == 0


@pytest.mark.parametrize("name", [*SAME, *SIGHT])
def test_below_the_filter_of_an_env_of_this_project_observations_do_not_matter(name: str):
    below = own({**SAME, **SIGHT}[name])
    # Through a wrapper the action goes to [-1, 1] and back, which rounds it.
    np.testing.assert_allclose(executed(below), executed(own()), rtol=1e-9)


@pytest.mark.parametrize(
    ("name", "fragment"),
    [
        *((name, "changed the safe action") for name in ("RescaleAction", "StickyAction")),
        *((name, "repeats steps") for name in REPEATS),
        ("DiscretizeAction", "Box"),
    ],
)
def test_below_the_filter_of_an_env_of_this_project_changed_actions_are_an_error(name, fragment):
    with pytest.raises(ConfigurationError, match=fragment):
        executed(own({**ACTIONS, **REPEATS}[name]))


def test_below_the_filter_an_env_that_resets_itself_is_an_error():
    env = own(lambda env: wrappers.Autoreset(wrappers.TimeLimit(env, 3)))
    *_, _ = steps(env, count=3)
    with pytest.raises(ConfigurationError, match="starts episodes"):
        env.step(np.zeros(1))
    with pytest.raises(ConfigurationError, match="Autoreset"):
        third_party(wrappers.Autoreset)


def test_below_the_filter_clipping_does_nothing_or_is_refused():
    proposals_at_the_bound = executed(own(wrappers.ClipAction), share=0.5)
    np.testing.assert_allclose(proposals_at_the_bound, executed(own()), rtol=1e-9)
    for name in ("ClipAction", "DiscretizeAction"):
        with doubted("action_map"), pytest.raises(ConfigurationError, match="Box"):
            third_party(ACTIONS[name])


def doubted(part: str) -> Any:
    return pytest.warns(SystemDefinitionWarning, match=f"unless {part}")


@pytest.mark.parametrize("name", SAME)
def test_below_the_filter_of_a_third_party_env_bystanders_change_nothing(name: str):
    np.testing.assert_array_equal(executed(third_party(SAME[name])), executed(third_party()))


def test_below_the_filter_of_a_third_party_env_changes_have_to_be_undone():
    expected = executed(third_party())
    for part, wrap, same in (
        ("state_fn", SIGHT["FlattenObservation"], True),
        ("state_fn", SIGHT["NormalizeObservation"], False),
        ("state_fn", SIGHT["DelayObservation"], False),
        ("action_map", ACTIONS["StickyAction"], False),
    ):
        with doubted(part):
            env = third_party(wrap)
        assert np.array_equal(executed(env), expected) == same
    with doubted("action_map"):
        third_party(rescaled)
    with doubted("state_fn"):
        stacked = third_party(SIGHT["FrameStackObservation"])
    with pytest.raises(InvalidInputError, match="state_fn"):
        stacked.reset(seed=0)


@pytest.mark.parametrize(("name", "periods"), [("MaxAndSkipObservation", 2), ("RepeatAction", 15)])
def test_below_the_filter_of_a_third_party_env_repeated_actions_are_unsafe(name: str, periods: int):
    with pytest.warns(SystemDefinitionWarning, match="dt is the time of all repetitions"):
        repeats = third_party(lambda env: getattr(wrappers, name)(env, periods))
    h_min = min(info["h_min"] for info in steps(repeats))
    assert h_min < 0.0 <= min(info["h_min"] for info in steps(third_party()))


@pytest.mark.parametrize("name", VECTORS)
def test_vector_wrappers_above_the_filter_leave_its_decisions_alone(name: str):
    found = []
    for wrap in (VECTORS[name], lambda envs: envs):
        envs = wrap(make_sb3_env("safe_envs/Pendulum-v0", num_envs=2, filter="scbf", seed=0))
        envs.reset()
        ones = np.ones((2, 1), dtype=np.float32)
        found.append([[info["safe_action"] for info in envs.step(ones)[3]] for _ in range(STEPS)])
    np.testing.assert_array_equal(*found)


@pytest.mark.slow
@pytest.mark.parametrize("above", [True, False])
def test_videos_show_the_filtered_episode_from_both_sides(above: bool, tmp_path: Path):
    def recorded(env: Any) -> Any:
        return wrappers.RecordVideo(
            env, str(tmp_path / "videos"), video_length=3, disable_logger=True
        )

    env = (
        recorded(own(render_mode="rgb_array")) if above else own(recorded, render_mode="rgb_array")
    )
    np.testing.assert_allclose(executed(env, count=5), executed(own(), count=5), rtol=1e-9)
    env.close()
    assert len(list(tmp_path.glob("videos/*.mp4"))) == 1


def test_the_guide_has_these_wrappers_and_no_other():
    table = GUIDE.read_text().split("## Order of wrappers")[1].split("\n## ")[0]
    named = set(re.findall(r"`([A-Za-z]+)`", "".join(re.findall(r"^\| (.*?) \|", table, re.M))))
    assert named == {*SAME, *SIGHT, *ACTIONS, *REPEATS, RESET, *VECTORS, VIDEO}


def doubts(env: Any) -> list[str]:
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        doubt_layers(env)
    assert {each.category for each in found} <= {SystemDefinitionWarning}
    return [str(each.message) for each in found]


class Tampers(gym.Wrapper):
    def step(self, action: Any) -> Any:
        return self.env.step(-action)


def test_wrappers_of_others_are_doubted_where_they_have_a_step():
    (text,) = doubts(Tampers(gym.make("Pendulum-v1")))
    assert text.startswith("Tampers")
    assert doubts(gym.Wrapper(Monitor(gym.make("Pendulum-v1")))) == []


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_wrappers_of_the_envs_of_a_batch_are_named_once(mode: Any):
    envs = gym.make_vec("Pendulum-v1", 2, vectorization_mode=mode, wrappers=[rescaled])
    (text,) = doubts(envs)
    envs.close()
    assert "RescaleAction" in text
