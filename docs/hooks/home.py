"""The animation of the home page: one policy on the same noise, without and behind a filter.

The files are kept in `docs/assets`, where the README shows them too. To draw them again:
`python docs/hooks/home.py`.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import matplotlib as mpl
import numpy as np
from PIL import Image, ImageDraw, ImageFont
from runs import ROOT

from safe_envs.registry import make_problem
from safe_envs.rendering.style import INK, PAPER, SCENE
from safe_envs.scripts.figures.film import write_film
from safe_envs.scripts.render import frames_of, make_runs

ENV_ID, SEED, EVERY = "safe_envs/StochasticDubins-v0", 0, 1
"""What is drawn, and the control periods from one frame to the next."""

SHOWN = {"none": "no filter", "promise:p=0.99": "promise filter, p = 0.99"}
"""Titles by filter, from left to right."""

_WIDTH, _TITLE, _GAP = 440, 32, 8
"""Width of a scene, height of its title and space between two scenes, in pixels."""


def write_animation(folder: Path) -> None:
    """Write `compare.gif`, and its last frame as `compare.png`.

    Args:
        folder: in which the files are written.
    """
    problem = make_problem(ENV_ID)
    runs = make_runs(
        problem, list(SHOWN), "nominal", trust=False, seed=SEED, knowledge="model", learned=()
    )
    frames = list(_composed(frames_of(runs, EVERY, problem.steps, None)))
    frames += [frames[-1]] * round(1.5 / (EVERY * problem.dt))  # a pause before it begins again
    for suffix in (".gif", ".png"):
        write_film(folder / f"compare{suffix}", frames, EVERY * problem.dt)


def _composed(frames: Iterator[np.ndarray]) -> Iterator[np.ndarray]:
    """Yield the scenes of frames, without their panels, next to each other under their titles."""
    font = ImageFont.truetype(Path(mpl.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf", 17)
    left, top, width, height = (round(side) for side in SCENE)
    small = _WIDTH, _WIDTH * height // width
    size = len(SHOWN) * (_WIDTH + _GAP) - _GAP, _TITLE + small[1]
    for frame in frames:
        scenes = np.split(frame, len(SHOWN), axis=1)
        sheet = Image.new("RGB", size, PAPER)
        draw = ImageDraw.Draw(sheet)
        for k, (name, scene) in enumerate(zip(SHOWN, scenes, strict=True)):
            x = k * (_WIDTH + _GAP)
            cut = Image.fromarray(scene[top : top + height, left : left + width])
            sheet.paste(cut.resize(small, Image.Resampling.LANCZOS), (x, _TITLE))
            draw.text((x + _WIDTH / 2, _TITLE / 2), SHOWN[name], INK, font, anchor="mm")
        yield np.asarray(sheet)


if __name__ == "__main__":
    write_animation(ROOT / "docs" / "assets")
