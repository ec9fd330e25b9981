"""Pictures of envs: what they show, and of what; videos of Stable-Baselines3."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.vec_env import VecVideoRecorder

from safe_envs import ConfigurationError, SafeEnv, SafeVectorEnv
from safe_envs.agents import make_sb3_env
from safe_envs.rendering import style
from safe_envs.wrappers import SafetyFilterVectorWrapper, SafetyFilterWrapper
from tests.conftest import problem_of
from tests.rendering.drawn import DUBINS, FILTER_STATUS, PANEL, SAFETY_STATUS, SCENE, shown, stepped
from tests.wrappers.cases import SWING

pytestmark = pytest.mark.slow


def test_every_env_is_drawn(env_id):
    env = SafeEnv(problem_of(env_id), render_mode="rgb_array")
    env.reset(seed=1)
    first = env.render()
    assert first.shape == (540, 960, 3)
    assert first.dtype == np.uint8
    assert first.flags.writeable
    env = stepped(env)
    second = env.render()
    assert (first[:, SCENE] != second[:, SCENE]).any(), (
        "the scene does not show that the state has moved"
    )
    assert (first[:, PANEL] != second[:, PANEL]).any(), (
        "the panel does not show that time has passed"
    )
    np.testing.assert_array_equal(
        stepped(SafeEnv(problem_of(env_id), render_mode="rgb_array")).render(), second
    )
    # An episode that begins has neither a trail nor a past of h.
    env.reset(seed=1)
    np.testing.assert_array_equal(env.render(), first)
    ringed = "Obstacle" in env_id or "Reach" in env_id
    edges = style.VIOLATION if ringed else style.EDGE
    for color in (edges, style.INK):
        assert shown(first[:, SCENE], color) > 0


def test_a_vector_env_draws_what_the_scalar_one_draws(env_id):
    problem = problem_of(env_id)
    envs = stepped(SafeVectorEnv(problem, 2, render_mode="rgb_array"), 3)
    frames = envs.render()
    assert len(frames) == 2
    for i, frame in enumerate(frames):
        env = SafeEnv(problem, render_mode="rgb_array")
        env.reset(seed=1 + i)
        for _ in range(3):
            env.step(np.full(env.action_space.shape, 0.5, dtype=np.float32))
        np.testing.assert_array_equal(frame, env.render())


def test_a_reset_in_the_step_leaves_no_trace():
    problem = problem_of(DUBINS, horizon=0.1)
    envs = SafetyFilterVectorWrapper(
        SafeVectorEnv(problem, 1, "SameStep", render_mode="rgb_array"), "scbf"
    )
    envs.reset(seed=0)
    for _ in range(2):
        envs.step(np.ones((1, 1), dtype=np.float32))
    (frame,) = envs.render()
    env = SafetyFilterWrapper(SafeEnv(problem, render_mode="rgb_array"), "scbf")
    env.reset(options={"state": envs.unwrapped.state[0]})
    np.testing.assert_array_equal(frame, env.render())


def color_of(info):
    """The colour in which the panel says what a filter did."""
    if not info["feasible"]:
        return style.INFEASIBLE
    return style.INTERVENING if info["intervention"] else None


def test_warning_colors_say_what_the_filter_does():
    inner = gym.make(DUBINS, render_mode="rgb_array", start=[2.5, 0.0, 0.0])
    env = SafetyFilterWrapper(inner, "scbf")
    env.reset(seed=0)
    assert shown(env.render(), style.INTERVENING) == 0
    seen = set()
    for _ in range(60):
        *_, info = env.step(np.zeros(1, dtype=np.float32))
        frame, expected = env.render(), color_of(info)
        for color in (style.INFEASIBLE, style.INTERVENING):
            assert (shown(frame[FILTER_STATUS], color) > 1000) == (color == expected)
        if expected is not None:  # the bar of the action has that colour, too
            assert shown(frame[:148, PANEL], expected) < shown(frame[:, PANEL], expected)
        assert (shown(frame[SAFETY_STATUS], style.VIOLATION) > 1000) == info["violation"]
        seen.add(expected)
    assert {style.INTERVENING, style.INFEASIBLE} <= seen


def test_without_a_filter_there_is_no_nominal_action():
    env = SafeEnv(problem_of(DUBINS), render_mode="rgb_array")
    bare = stepped(env, 1).render()
    filtered = SafetyFilterWrapper(gym.make(DUBINS, render_mode="rgb_array"), "szcbf:alpha=9,9")
    assert (stepped(filtered, 1).render()[170:210, PANEL] != bare[170:210, PANEL]).any()


@pytest.mark.parametrize("mode", ["ansi", "rgb", 3, "human"])
def test_unknown_modes_are_named(mode):
    with pytest.raises(ConfigurationError, match="rgb_array"):
        SafeVectorEnv(problem_of(DUBINS), 2, render_mode=mode)
    if mode != "human":
        with pytest.raises(ConfigurationError, match="rgb_array"):
            SafeEnv(problem_of(DUBINS), render_mode=mode)


@pytest.mark.parametrize("count", [None, 2])
def test_there_is_nothing_to_draw_without_a_mode_or_before_a_reset(count):
    def made(mode):
        problem = problem_of(DUBINS)
        return (
            SafeEnv(problem, render_mode=mode)
            if count is None
            else SafeVectorEnv(problem, count, render_mode=mode)
        )

    with pytest.raises(gym.error.ResetNeeded):
        made("rgb_array").render()
    env = made(None)
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="without a render mode"):
        assert env.render() is None


def test_a_filter_over_another_env_is_shown_beside_its_picture():
    text = "cbf:alpha=2:sampling_margin=15"
    env = SafetyFilterWrapper(gym.make("Pendulum-v1", render_mode="rgb_array"), text, **SWING)
    env.reset(seed=1)
    frames, colors = [], set()
    for _ in range(60):
        *_, info = env.step([2.0])
        frames.append(env.render())
        assert frames[-1].shape == (540, 960, 3)
        color = color_of(info)
        colors.add(color)
        assert color is None or shown(frames[-1][FILTER_STATUS], color)
    assert colors >= {None, style.INTERVENING}
    assert (frames[0][:, SCENE] != frames[-1][:, SCENE]).any()
    envs = gym.make_vec("Pendulum-v1", 2, "sync", vector_kwargs=None, render_mode="rgb_array")
    batch = SafetyFilterVectorWrapper(envs, text, **SWING)
    batch.reset(seed=1)
    for _ in range(60):
        batch.step(np.full((2, 1), 2.0, dtype=np.float32))
    np.testing.assert_array_equal(batch.render()[0], frames[-1])


def test_info_is_the_same_with_and_without_pictures():
    infos = []
    for mode in (None, "rgb_array"):
        env = SafetyFilterWrapper(gym.make(DUBINS, render_mode=mode), "scbf")
        _, at_reset = env.reset(seed=0)
        infos.append([at_reset, env.step(np.zeros(1, dtype=np.float32))[4]])
    for bare, drawn in zip(*infos, strict=True):
        assert list(bare) == list(drawn)
        for key, value in bare.items():
            np.testing.assert_array_equal(value, drawn[key])


# Videos by Stable-Baselines3; for those of Gymnasium see tests/wrappers/test_wrapper_order.py.


def frames_in(path) -> list[np.ndarray]:
    import imageio_ffmpeg

    reader = imageio_ffmpeg.read_frames(str(path))
    width, height = next(reader)["size"]
    return [np.frombuffer(frame, dtype=np.uint8).reshape(height, width, 3) for frame in reader]


@pytest.mark.filterwarnings(
    "ignore::SyntaxWarning", "ignore::DeprecationWarning", "ignore::ResourceWarning"
)
def test_stable_baselines3_records_a_video(tmp_path):
    envs = make_sb3_env(DUBINS, 2, "scbf", render_mode="rgb_array", seed=0)
    recorder = VecVideoRecorder(envs, str(tmp_path), lambda _: True, video_length=3)
    assert recorder.frames_per_sec == 20
    recorder.reset()
    for _ in range(4):
        recorder.step(np.zeros((2, 1), dtype=np.float32))
    recorder.close()
    frames = frames_in(next(iter(tmp_path.glob("*.mp4"))))
    assert frames[0].shape[:2] in ((1080, 960), (540, 1920))
    assert len(frames) >= 3
