"""Windows, and pygame under them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import warnings
from copy import deepcopy

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from safe_envs import ConfigurationError, SafeEnv
from tests.conftest import problem_of
from tests.rendering.drawn import DUBINS, stepped

pytestmark = pytest.mark.slow


@pytest.fixture
def no_display(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


@pytest.mark.usefixtures("no_display")
def test_the_checker_accepts_both_modes(env_id):
    with warnings.catch_warnings():
        warnings.filterwarnings(
            "ignore",
            message=".*(Box action space|observation space (min|max)imum|not having a spec).*",
        )
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


@pytest.mark.skipif(os.name != "posix", reason="processes are ended otherwise there")
def test_a_window_leaves_the_signals_of_the_program_alone():
    code = (
        "import gymnasium as gym, os, signal, time, safe_envs\n"
        f"gym.make({DUBINS!r}, render_mode='human').reset()\n"
        "os.kill(os.getpid(), signal.SIGTERM)\n"
        "time.sleep(1)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "SDL_VIDEODRIVER": "dummy"},
        timeout=60,
        check=False,
    )
    assert done.returncode == -signal.SIGTERM


@pytest.mark.usefixtures("no_display")
def test_each_env_has_a_window_of_its_own():
    import pygame

    first, second = (
        stepped(gym.make(DUBINS, render_mode="human", dt=0.001, start=start), 1)
        for start in ([0.0] * 3, [3.0] * 3)
    )
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
def test_windows_that_ended_do_not_end_new_ones():
    import pygame

    envs = [stepped(gym.make(DUBINS, render_mode="human", dt=0.001), 1) for _ in range(3)]
    for _ in range(25):
        # SDL likes to give a new window the address of one that ended.
        pygame.quit()
        for env in envs:
            env.step(np.zeros(1, dtype=np.float32))
    for env in envs:
        env.close()


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


@pytest.mark.parametrize("missing", [True, False])
def test_without_the_right_pygame_it_is_said_what_to_install(monkeypatch, missing):
    import pygame

    env = stepped(SafeEnv(problem_of(DUBINS), render_mode="rgb_array"), 1)
    if missing:
        monkeypatch.setitem(sys.modules, "pygame", None)
    else:  # the other one
        monkeypatch.delattr(pygame.draw, "aacircle")
    with pytest.raises(gym.error.DependencyNotInstalled, match=r"\.\[render\]"):
        env.render()
