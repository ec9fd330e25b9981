"""What tests of pictures share."""

from __future__ import annotations

import numpy as np

from safe_envs.rendering import style

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


def written(monkeypatch) -> list[str]:
    """All that is written on canvases from now on."""
    from safe_envs.rendering.canvas import Canvas

    texts, write = [], Canvas.text

    def kept(self, text, *arguments, **options):
        texts.append(text)
        return write(self, text, *arguments, **options)

    monkeypatch.setattr(Canvas, "text", kept)
    return texts
