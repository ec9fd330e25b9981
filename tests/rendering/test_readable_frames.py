"""All that is written in a frame can be read: it is whole, on no line, and nothing covers it."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from safe_envs.rendering.scenes.top_view import TopView
from tests.readable import unreadable
from tests.rendering.readable_frames import frame_texts

UNREADABLE = "is on a line"


def played(env_id: str, steps: int):
    """An env after some steps with random inputs, which has never been drawn."""
    env = gym.make(env_id, render_mode="rgb_array").unwrapped
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(steps):
        *_, terminated, truncated, _ = env.step(
            rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
        )
        if terminated or truncated:
            break
    return env


@pytest.mark.parametrize("steps", [0, 40])
def test_every_text_of_a_frame_can_be_read(env_id, steps):
    texts, without, covered = frame_texts(lambda: played(env_id, steps))
    assert len(texts) > 10
    assert unreadable(texts, without) + covered == []


@pytest.mark.parametrize("method", ["text", "label"])
def test_the_check_finds_a_text_on_a_line_and_one_that_is_cut_off(monkeypatch, method):
    draw = TopView.draw

    def crossed(self, canvas, snapshot):
        draw(self, canvas, snapshot)
        canvas.line((80, 100), (400, 100), (0, 0, 0), 3)
        getattr(canvas, method)("crossed", (200, 94), (0, 0, 0))
        getattr(canvas, method)("cut off", (-10, 300), (0, 0, 0))

    monkeypatch.setattr(TopView, "draw", crossed)
    texts, without, _ = frame_texts(lambda: played("safe_envs/DubinsDisk-v0", 0))
    found = unreadable(texts, without)
    assert any("'crossed'" in each and UNREADABLE in each for each in found) == (method == "text")
    assert any("'cut off' is cut off" in each for each in found)
