"""Wrappers of Gymnasium and Stable-Baselines3 above and below a filter, as in the guide's table.

The filter over a wrapped env is compared with the filter over the env itself, on equal proposals.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import wrappers
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize

import safe_envs  # noqa: F401  (registers the ids)
from safe_envs.agents import make_sb3_env
from safe_envs.errors import ConfigurationError, InvalidInputError, SystemDefinitionWarning
from safe_envs.plugins import load_object
from safe_envs.wrappers import SafetyFilterWrapper

ROOT = Path(__file__).parents[3]
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
def test_sticky_actions_above_the_filter_are_filtered_in_every_period(made: Any):
    env = ACTIONS["StickyAction"](made())
    assert all(info["barrier"].min() >= 0.0 for info in steps(env))
    assert len(executed(env)) == STEPS


@pytest.mark.parametrize("made", [own, third_party])
def test_discrete_actions_above_the_filter_are_filtered(made: Any):
    env = ACTIONS["DiscretizeAction"](made())
    env.reset(seed=0)
    found = [env.step(env.action_space.n - 1)[-1]["safe_action"] for _ in range(STEPS)]
    # The last of five equal parts of the range is represented by its middle.
    np.testing.assert_array_equal(found, executed(made(), share=0.8))


@pytest.mark.parametrize("made", [own, third_party])
def test_an_env_that_resets_itself_above_the_filter_begins_new_episodes(made: Any):
    env = wrappers.Autoreset(wrappers.TimeLimit(made(), 3))
    kept = [info.get("episode_cost") for info in steps(env, count=3)]
    *_, info = env.step(env_high(env))
    assert len(kept) == 3
    assert info["episode_interventions"] == 0


@pytest.mark.parametrize("name", REPEATS)
@pytest.mark.parametrize("made", [own, third_party])
def test_skipped_frames_above_the_filter_are_filtered_in_every_period(name: str, made: Any):
    env = REPEATS[name](made())
    *_, last = steps(env, count=STEPS // 2)
    *_, expected = steps(made())
    assert last["episode_interventions"] == expected["episode_interventions"]


@pytest.mark.parametrize("name", [*SAME, *SIGHT])
def test_below_the_filter_of_an_env_of_this_project_observations_do_not_matter(name: str):
    below = own({**SAME, **SIGHT}[name])
    # Through a wrapper the action goes to [-1, 1] and back, which rounds it.
    np.testing.assert_allclose(executed(below), executed(own()), rtol=1e-9)


@pytest.mark.parametrize("name", ["RescaleAction", "StickyAction"])
def test_below_the_filter_of_an_env_of_this_project_changed_actions_are_an_error(name: str):
    with pytest.raises(ConfigurationError, match="changed the safe action"):
        executed(own(ACTIONS[name]))


@pytest.mark.parametrize("name", REPEATS)
def test_below_the_filter_of_an_env_of_this_project_repeated_actions_are_an_error(name: str):
    with pytest.raises(ConfigurationError, match="below the filter repeats steps"):
        executed(own(REPEATS[name]))


def test_below_the_filter_an_env_that_resets_itself_is_an_error():
    env = own(lambda env: wrappers.Autoreset(wrappers.TimeLimit(env, 3)))
    *_, _ = steps(env, count=3)
    with pytest.raises(ConfigurationError, match="starts episodes by itself"):
        env.step(np.zeros(1))
    with pytest.raises(ConfigurationError, match="starts episodes of which the filter"):
        third_party(wrappers.Autoreset)


def test_below_the_filter_discrete_actions_are_refused():
    with pytest.raises(ConfigurationError, match="those of a Box"):
        own(ACTIONS["DiscretizeAction"])
    with (
        pytest.warns(SystemDefinitionWarning, match="unless action_map undoes that"),
        pytest.raises(ConfigurationError, match="bounded Box"),
    ):
        third_party(ACTIONS["DiscretizeAction"])


def test_below_the_filter_clipping_does_nothing_or_is_refused():
    proposals_at_the_bound = executed(own(wrappers.ClipAction), share=0.5)
    np.testing.assert_allclose(proposals_at_the_bound, executed(own()), rtol=1e-9)
    with (
        pytest.warns(SystemDefinitionWarning, match="unless action_map undoes that"),
        pytest.raises(ConfigurationError, match="bounded Box"),
    ):
        third_party(wrappers.ClipAction)


@pytest.mark.parametrize("name", SAME)
def test_below_the_filter_of_a_third_party_env_bystanders_change_nothing(name: str):
    np.testing.assert_array_equal(executed(third_party(SAME[name])), executed(third_party()))


def test_below_the_filter_of_a_third_party_env_observations_have_to_be_undone():
    with pytest.warns(SystemDefinitionWarning, match="unless state_fn undoes that"):
        normalized = third_party(SIGHT["NormalizeObservation"])
    assert not np.array_equal(executed(normalized), executed(third_party()))
    with pytest.warns(SystemDefinitionWarning, match="unless state_fn undoes that"):
        stacked = third_party(SIGHT["FrameStackObservation"])
    with pytest.raises(InvalidInputError, match="state_fn made"):
        stacked.reset(seed=0)
    with pytest.warns(SystemDefinitionWarning, match="unless state_fn undoes that"):
        flat = third_party(SIGHT["FlattenObservation"])
    np.testing.assert_array_equal(executed(flat), executed(third_party()))
    with pytest.warns(SystemDefinitionWarning, match="unless state_fn undoes that"):
        late = third_party(SIGHT["DelayObservation"])
    assert not np.array_equal(executed(late), executed(third_party()))


def test_below_the_filter_of_a_third_party_env_changed_actions_are_executed_unfiltered():
    with pytest.warns(SystemDefinitionWarning, match="unless action_map undoes that"):
        third_party(rescaled)
    with pytest.warns(SystemDefinitionWarning, match="unless action_map undoes that"):
        sticky = third_party(ACTIONS["StickyAction"])
    assert not np.array_equal(executed(sticky), executed(third_party()))


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
