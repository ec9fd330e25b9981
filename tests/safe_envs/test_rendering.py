from __future__ import annotations

import subprocess
import sys
import warnings
from copy import deepcopy

import gymnasium as gym
import numpy as np
import pytest
import sympy as sp
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import RecordVideo
from stable_baselines3.common.vec_env import VecVideoRecorder

from agents import make_sb3_env
from safe_envs import ConfigurationError, ControlAffineSDE, SafeEnv, SafeVectorEnv
from safe_envs.rendering import style
from tests.conftest import problem_of
from wrappers import SafetyFilterVectorWrapper, SafetyFilterWrapper

DUBINS = "safe_envs/StochasticDubins-v0"
SCENE = slice(0, style.SCENE[2])
PANEL = slice(style.SCENE[2] + 1, None)
FILTER_STATUS = (slice(104, 132), slice(620, 780))
SAFETY_STATUS = (slice(104, 132), slice(784, 940))


def shown(frame: np.ndarray, color: tuple[int, int, int]) -> int:
    """How many pixels have exactly a colour."""
    return int((frame == color).all(axis=-1).sum())


def stepped(env, steps: int = 5, action: float = 0.5):
    env.reset(seed=1)
    for _ in range(steps):
        env.step(np.full(env.action_space.shape, action, dtype=np.float32))
    return env


@pytest.fixture
def no_display(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


def test_every_env_is_drawn(env_id):
    env = SafeEnv(problem_of(env_id), render_mode="rgb_array")
    env.reset(seed=1)
    first = env.render()
    assert first.shape == (540, 960, 3)
    assert first.dtype == np.uint8
    assert first.flags.writeable
    env = stepped(env)
    second = env.render()
    assert (first[:, SCENE] != second[:, SCENE]).any(), "the scene does not show that the state has moved"
    assert (first[:, PANEL] != second[:, PANEL]).any(), "the panel does not show that time has passed"
    np.testing.assert_array_equal(stepped(SafeEnv(problem_of(env_id), render_mode="rgb_array")).render(), second)
    # An episode that begins has neither a trail nor a past of h.
    env.reset(seed=1)
    np.testing.assert_array_equal(env.render(), first)
    edges = style.VIOLATION if "Obstacle" in env_id else style.EDGE
    for color in (edges, style.INK):
        assert shown(first[:, SCENE], color) > 0


@pytest.mark.usefixtures("no_display")
def test_the_checker_accepts_both_modes(env_id):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*(Box action space|observation space (min|max)imum|not having a spec).*")
        check_env(gym.make(env_id, dt=0.01, horizon=0.1).unwrapped, skip_close_check=True)


def on_screen(env) -> np.ndarray:
    import pygame

    return pygame.surfarray.array3d(env.unwrapped.viewer._window._window.get_surface())


@pytest.mark.usefixtures("no_display")
def test_the_window_follows_the_steps():
    env = gym.make(DUBINS, render_mode="human", dt=0.001, horizon=1.0)
    import pygame

    stepped(env, 2)
    before = on_screen(env)
    assert before.shape == (960, 540, 3)
    env.step(np.ones(1, dtype=np.float32))
    assert (on_screen(env) != before).any()
    assert env.render() is None
    assert env.metadata["render_fps"] == 1000
    env.close()
    assert not pygame.display.get_init()
    env.close()


@pytest.mark.usefixtures("no_display")
def test_each_env_has_a_window_of_its_own():
    import pygame

    first, second = (stepped(gym.make(DUBINS, render_mode="human", dt=0.001, start=start), 1) for start in ([0.0] * 3, [3.0] * 3))
    assert (on_screen(first) != on_screen(second)).any()
    first.close()
    stepped(second, 1)
    assert pygame.display.get_init()
    # As Gymnasium's own envs do when they close.
    pygame.quit()
    stepped(second, 1)
    before = on_screen(second)
    pygame.quit()
    second.close()
    second.close()
    second.render()
    np.testing.assert_array_equal(on_screen(second), before)
    second.close()
    assert not pygame.display.get_init()


@pytest.mark.usefixtures("no_display")
def test_a_window_leaves_the_display_to_others():
    import pygame

    env = stepped(gym.make(DUBINS, render_mode="human", dt=0.001), 1)
    theirs = pygame.display.set_mode((20, 20))
    env.close()
    theirs.fill((1, 2, 3))
    pygame.display.quit()


@pytest.mark.usefixtures("no_display")
def test_a_copy_of_an_env_opens_its_window_when_it_draws():
    env = stepped(SafeEnv(problem_of(DUBINS, dt=0.001), render_mode="human"), 2)
    copied = deepcopy(env)
    assert copied.viewer._window is None
    before = on_screen(env)
    copied.step([1.0])
    assert copied.viewer._window is not None
    np.testing.assert_array_equal(on_screen(env), before)
    env.step([1.0])
    np.testing.assert_array_equal(on_screen(copied), on_screen(env))
    env.close()
    copied.close()


def test_pictures_outlive_a_quit_of_pygame():
    import pygame

    env = stepped(SafeEnv(problem_of(DUBINS), render_mode="rgb_array"), 1)
    before = env.render()
    for quits in (pygame.font.quit, pygame.quit):
        quits()
        # What was written before is kept; letters that were not need a font.
        env.viewer.caption = f"{quits.__module__} has quit"
        assert (env.render() != before).any()
        env.viewer.caption = ""
        np.testing.assert_array_equal(env.render(), before)


def test_no_display_is_an_error(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "none such")
    env = SafeEnv(problem_of(DUBINS), render_mode="human")
    with pytest.raises(ConfigurationError, match="rgb_array"):
        env.reset(seed=0)


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
    envs = SafetyFilterVectorWrapper(SafeVectorEnv(problem, 1, "SameStep", render_mode="rgb_array"), "scbf")
    envs.reset(seed=0)
    for _ in range(2):
        envs.step(np.ones((1, 1), dtype=np.float32))
    (frame,) = envs.render()
    env = SafeEnv(problem, render_mode="rgb_array")
    env.reset(options=None)
    env._x = tuple(float(x[0]) for x in envs.unwrapped.components)
    env.viewer.restart([env._x], [0.0], [0])
    env.viewer.caption = "scbf"
    np.testing.assert_array_equal(frame, env.render())


def test_a_restored_snapshot_is_what_is_drawn():
    envs = stepped(SafeVectorEnv(problem_of(DUBINS), 2, render_mode="rgb_array"), 4)
    snapshot = envs.snapshot()
    envs.reset(seed=5)
    envs.restore(snapshot)
    assert all(history.moment.times[-1] == pytest.approx(0.2) for history in envs.viewer._histories)
    np.testing.assert_array_equal(envs.viewer._histories[1].moment.state, snapshot["state"][1])


def test_warning_colors_say_what_the_filter_does():
    env = SafetyFilterWrapper(gym.make(DUBINS, render_mode="rgb_array", start=[2.5, 0.0, 0.0]), "scbf")
    env.reset(seed=0)
    assert shown(env.render(), style.INTERVENING) == 0
    seen = set()
    for _ in range(60):
        _, _, _, _, info = env.step(np.zeros(1, dtype=np.float32))
        frame = env.render()
        status = frame[FILTER_STATUS]
        expected = style.INFEASIBLE if not info["feasible"] else style.INTERVENING if info["intervention"] else None
        for color in (style.INFEASIBLE, style.INTERVENING):
            assert (shown(status, color) > 1000) == (color == expected)
        if expected is not None:
            assert shown(frame[:148, PANEL], expected) < shown(frame[:, PANEL], expected), "the bar of the action has another colour"
        assert (shown(frame[SAFETY_STATUS], style.VIOLATION) > 1000) == info["violation"]
        seen.add(expected)
    assert style.INTERVENING in seen
    assert style.INFEASIBLE in seen


def test_without_a_filter_there_is_no_nominal_action():
    env = SafeEnv(problem_of(DUBINS), render_mode="rgb_array")
    bare = stepped(env, 1).render()
    filtered = SafetyFilterWrapper(gym.make(DUBINS, render_mode="rgb_array"), "szcbf:alphas=9,9")
    assert (stepped(filtered, 1).render()[170:210, PANEL] != bare[170:210, PANEL]).any()
    moment = env.viewer._histories[0].moment
    assert moment.decision is None
    assert moment.executed is not None


def histories(monkeypatch, kept: int, count: int):
    """A history that keeps few states of an episode whose smallest barrier is that of its second state."""
    from safe_envs.rendering import history

    monkeypatch.setattr(history, "_KEPT", kept)
    recorded = history.History(problem_of("safe_envs/Scalar-v0"))
    recorded.restart([0.0], 0.0)
    for k in range(1, count):
        recorded.append([9.5 if k == 1 else 0.01 * k], 0.1 * k, None, None)
    return recorded


@pytest.mark.parametrize("count", [9, 10, 11, 23])
def test_a_long_history_keeps_the_latest_states(monkeypatch, count):
    moment = histories(monkeypatch, 5, count).moment
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
    assert recorded.moment.least == pytest.approx(0.5)
    assert recorded.moment.violated is None


def test_the_panel_says_the_least_of_the_whole_episode(monkeypatch):
    from safe_envs.rendering import history

    monkeypatch.setattr(history, "_KEPT", 4)
    env = SafeEnv(problem_of("safe_envs/Scalar-v0", noise=1.0, start=[0.9]), render_mode="rgb_array")
    env.reset(seed=0)
    for _ in range(40):
        *_, info = env.step([-1.0])
    texts = written(monkeypatch)
    env.render()
    assert info["h_min"] < env.viewer._histories[0].moment.h.min()
    assert f"least {style.number(info['h_min'])}" in texts


def test_a_decision_is_of_one_step():
    from safe_envs.rendering.viewer import Viewer

    viewer = Viewer(problem_of("safe_envs/Scalar-v0"), "rgb_array", 1)
    history = viewer._histories[0]
    viewer.restart([[0.0]], [0.0], [0])
    viewer.announce([[1.0]], [True], [False])
    viewer.restart([[0.0]], [0.0], [0])
    viewer.advance([[0.0]], [0.1], [[0.5]])
    assert history.moment.decision is None
    viewer.announce([[1.0]], [True], [False])
    viewer.advance([[0.0]], [0.2], [[0.5]])
    assert history.moment.infeasible
    assert history.moment.intervening
    viewer.advance([[0.0]], [0.3], [[0.5]])
    assert history.moment.decision is None


@pytest.mark.parametrize(
    ("value", "scale", "text"),
    [
        (0.0, 0.0, "0.00"),
        (-0.004123, 0.0, "\u22120.00412"),
        (0.5, 0.0, "0.500"),
        (12.34, 0.0, "12.3"),
        (0.0123, 5.0, "0.01"),
        (0.0123, 0.02, "0.0123"),
        (0.004, 5.0, "0.00"),
        (1234.0, 0.0, "1\u202f234"),
        (-0.00012, 0.0, "\u22121.20\u00d710⁻⁴"),
    ],
)
def test_numbers_have_three_digits_that_count(value, scale, text):
    assert style.number(value, scale) == text


def test_trails_of_endless_episodes_are_bounded():
    env = SafeEnv(problem_of("safe_envs/Scalar-v0", noise=0.0, start=[0.0]), render_mode="rgb_array")
    env.reset(seed=0)
    for _ in range(12_000):
        env.step([0.0])
    moment = env.viewer._histories[0].moment
    assert 5000 <= len(moment.times) <= 10_000
    assert moment.times[-1] == pytest.approx(120.0)
    assert env.render().shape == (540, 960, 3)


@pytest.mark.parametrize("mode", ["ansi", "rgb", 3])
def test_unknown_modes_are_named(mode):
    problem = problem_of(DUBINS)
    with pytest.raises(ConfigurationError, match=r"allowed: None, 'human', 'rgb_array'"):
        SafeEnv(problem, render_mode=mode)
    with pytest.raises(ConfigurationError, match=r"allowed: None, 'rgb_array'"):
        SafeVectorEnv(problem, 2, render_mode=mode)


def test_a_window_for_a_batch_is_refused():
    with pytest.raises(ConfigurationError, match="make a scalar one"):
        gym.make_vec(DUBINS, 2, render_mode="human")


def test_no_mode_draws_nothing(env_id):
    problem = problem_of(env_id)
    for env in (SafeEnv(problem), SafeVectorEnv(problem, 2)):
        env.reset(seed=0)
        with pytest.warns(UserWarning, match="without a render mode"):
            assert env.render() is None


def test_there_is_nothing_to_draw_before_a_reset():
    for env in (SafeEnv(problem_of(DUBINS), render_mode="rgb_array"), SafeVectorEnv(problem_of(DUBINS), 2, render_mode="rgb_array")):
        with pytest.raises(gym.error.ResetNeeded):
            env.render()


def test_missing_pygame_says_what_to_install(monkeypatch):
    env = stepped(SafeEnv(problem_of(DUBINS), render_mode="rgb_array"), 1)
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(gym.error.DependencyNotInstalled, match=r'pip install "safe-envs\[render\]"'):
        env.render()


def test_the_other_pygame_is_refused(monkeypatch):
    import pygame

    monkeypatch.delattr(pygame.draw, "aacircle")
    env = stepped(SafeEnv(problem_of(DUBINS), render_mode="rgb_array"), 1)
    with pytest.raises(gym.error.DependencyNotInstalled, match=r'pip uninstall pygame.*pip install "safe-envs\[render\]"'):
        env.render()


def written(monkeypatch) -> list[str]:
    """All that is written on canvases from now on."""
    from safe_envs.rendering.canvas import Canvas

    texts, write = [], Canvas.text

    def kept(self, text, *arguments, **options):
        texts.append(text)
        return write(self, text, *arguments, **options)

    monkeypatch.setattr(Canvas, "text", kept)
    return texts


@pytest.mark.parametrize("limited", [True, False])
def test_an_env_without_a_limit_of_time_has_no_horizon(monkeypatch, limited):
    bare = gym.make("Pendulum-v1", render_mode="rgb_array")
    theta, rate, torque = sp.symbols("theta rate torque", real=True)
    model = ControlAffineSDE((theta, rate), (torque,), [rate, 15 * sp.sin(theta)], [0, 3], [0, 0])
    env = SafetyFilterWrapper(bare if limited else bare.unwrapped, "cbf", model=model, barriers=4 - rate, state_fn=lambda seen: seen[:2])
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


def test_a_filter_over_another_env_is_shown_beside_its_picture():
    theta, rate, torque = sp.symbols("theta rate torque", real=True)
    view = {
        "model": ControlAffineSDE((theta, rate), (torque,), [rate, 15 * sp.sin(theta)], [0, 3], [0, 0]),
        "barriers": 4 - rate**2 + 30 * (1 - sp.cos(theta)),
        "state_fn": lambda seen: np.stack([np.arctan2(seen[..., 1], seen[..., 0]), seen[..., 2]], axis=-1),
    }
    env = SafetyFilterWrapper(gym.make("Pendulum-v1", render_mode="rgb_array"), "cbf:alpha=2:sampling_margin=15", **view)
    env.reset(seed=1)
    frames, colors = [], set()
    for _ in range(60):
        *_, info = env.step([2.0])
        frames.append(env.render())
        assert frames[-1].shape == (540, 960, 3)
        color = style.INFEASIBLE if not info["feasible"] else style.INTERVENING if info["intervention"] else None
        colors.add(color)
        assert color is None or shown(frames[-1][FILTER_STATUS], color)
    assert colors >= {None, style.INTERVENING}
    assert (frames[0][:, SCENE] != frames[-1][:, SCENE]).any()
    envs = gym.make_vec("Pendulum-v1", 2, "sync", vector_kwargs=None, render_mode="rgb_array")
    batch = SafetyFilterVectorWrapper(envs, "cbf:alpha=2:sampling_margin=15", **view)
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


def frames_in(path) -> list[np.ndarray]:
    import imageio_ffmpeg

    reader = imageio_ffmpeg.read_frames(str(path))
    width, height = next(reader)["size"]
    return [np.frombuffer(frame, dtype=np.uint8).reshape(height, width, 3) for frame in reader]


@pytest.mark.filterwarnings("ignore::SyntaxWarning", "ignore::DeprecationWarning", "ignore::ResourceWarning")
def test_gymnasium_records_a_video(tmp_path):
    env = RecordVideo(SafetyFilterWrapper(gym.make(DUBINS, render_mode="rgb_array"), "scbf"), str(tmp_path / "videos"), video_length=4)
    stepped(env, 4)
    env.close()
    (video,) = (tmp_path / "videos").glob("*.mp4")
    frames = frames_in(video)
    assert len(frames) >= 4
    assert frames[0].shape == (540, 960, 3)


@pytest.mark.filterwarnings("ignore::SyntaxWarning", "ignore::DeprecationWarning", "ignore::ResourceWarning")
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


def test_pygame_is_not_imported_before_something_is_drawn():
    code = (
        "import sys, safe_envs, gymnasium as gym\n"
        "from safe_envs import SafeEnv\n"
        "env = SafeEnv(gym.make('safe_envs/Scalar-v0').unwrapped.problem, render_mode='rgb_array')\n"
        "env.reset(seed=0)\n"
        "assert 'pygame' not in sys.modules\n"
        "env.render()\n"
        "assert 'pygame' in sys.modules\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
