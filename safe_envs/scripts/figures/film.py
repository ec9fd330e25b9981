"""Sequences of pictures as a video, an animation or a still."""

from __future__ import annotations

import errno
import itertools
import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from safe_envs.errors import ConfigurationError, install_extra
from safe_envs.files import require_writable, write_atomically

SUFFIXES = (".mp4", ".gif", ".png")
"""What can be written."""

_MOST_A_SECOND = {".mp4": 60.0, ".gif": 50.0, ".png": math.inf}
_MOST_IN_GIF = 600
_COLORS = 256


def require_film(path: Path) -> None:
    """Check, before any work, that a film can be written to a path.

    Raises:
        ConfigurationError: its suffix is none of `SUFFIXES`, or there can be no such file.
        gymnasium.error.DependencyNotInstalled: what draws, or what writes such files, is missing.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise ConfigurationError(
            f"--out {path} ends in {path.suffix!r}; give a file that ends in {', '.join(SUFFIXES)}"
        )
    require_writable(path)
    from safe_envs.rendering.viewer import require_pygame

    require_pygame()
    if path.suffix.lower() == ".mp4":
        _video_writer()


def steps_a_frame(path: Path, dt: float, steps: int) -> int:
    """Return the control periods from one frame to the next, for a film in real time.

    Args:
        path: of the film: a .gif shows at most 50 frames a second and 600 in all, a .mp4 60 a
            second.
        dt: control period in s.
        steps: of the longest episode.

    Returns:
        At least 1.
    """
    suffix = path.suffix.lower()
    fewest = math.ceil(1.0 / (_MOST_A_SECOND[suffix] * dt) - 1e-9)
    return max(fewest, math.ceil(steps / _MOST_IN_GIF) if suffix == ".gif" else 1, 1)


def write_film(path: Path, frames: Iterable[np.ndarray], seconds: float) -> int:
    """Write frames one by one, the whole file or none; of a .png the last frame alone.

    Args:
        path: of the film.
        frames: at least one, uint8 of shape (height, width, 3), all of one size.
        seconds: from one frame to the next.

    Returns:
        How many frames the file has.

    Raises:
        ConfigurationError: see `require_film`.
    """
    counted = _Counted(frames)
    write = {".mp4": _write_video, ".gif": _write_animation, ".png": _write_still}[
        path.suffix.lower()
    ]
    write_atomically(path, lambda part: write(part, iter(counted), seconds))
    return 1 if path.suffix.lower() == ".png" else counted.count


class _Counted:
    def __init__(self, frames: Iterable[np.ndarray]) -> None:
        self._frames, self.count = frames, 0

    def __iter__(self) -> Iterator[np.ndarray]:
        for frame in self._frames:
            self.count += 1
            yield frame


def _video_writer() -> Any:
    try:
        from moviepy.video.io.ffmpeg_writer import FFMPEG_VideoWriter
    except ImportError as error:
        raise gym.error.DependencyNotInstalled(
            f"a .mp4 needs moviepy: {install_extra('render')}; or write a .gif"
        ) from error
    return FFMPEG_VideoWriter


def _write_video(path: Path, frames: Iterator[np.ndarray], seconds: float) -> None:
    first = next(frames)
    height, width, _ = first.shape
    writer = _video_writer()(str(path), (width, height), 1.0 / seconds)
    process, stopped = (
        writer.proc,
        OSError(errno.EIO, "ffmpeg stopped before the end, as for want of room"),
    )
    try:
        for frame in itertools.chain([first], frames):
            try:
                writer.write_frame(frame)
            except OSError as error:
                raise stopped from error
    finally:
        writer.close()
    # The library does not check how ffmpeg ended, which may have failed after the last frame.
    if process.returncode != 0:
        raise stopped


def _write_animation(path: Path, frames: Iterator[np.ndarray], seconds: float) -> None:
    from PIL import Image

    first = next(frames)
    palette, shown, lengths = _palette(first), _durations(seconds), []

    def reduced(pixels: np.ndarray) -> Image.Image:
        # The number of frames is unknown: the library looks up how long a frame is shown after it
        # has taken the frame.
        lengths.append(next(shown))
        return Image.fromarray(pixels).quantize(palette=palette, dither=Image.Dither.NONE)

    reduced(first).save(
        path,
        save_all=True,
        append_images=(reduced(frame) for frame in frames),
        duration=lengths,
        loop=0,
    )


def _durations(seconds: float) -> Iterator[int]:
    """Yield how long each frame of an animation is shown, in ms."""
    # The format counts in hundredths of a second. The ends of frames are rounded, not their
    # lengths, so that errors do not add up.
    end = 0
    for k in itertools.count(1):
        start, end = end, max(end + 1, round(100 * k * seconds))
        yield 10 * (end - start)


def _write_still(path: Path, frames: Iterator[np.ndarray], seconds: float) -> None:
    from PIL import Image

    last = next(frames)
    for last in frames:  # noqa: B007
        pass
    Image.fromarray(last).save(path)


def _palette(frame: np.ndarray) -> Any:
    """Return colours for all frames: those of a frame, and all that later ones may have."""
    from PIL import Image

    from safe_envs.rendering import style

    named = [
        c
        for name, c in vars(style).items()
        if name.isupper() and isinstance(c, tuple) and len(c) == 3 and name != "SIZE"
    ]
    swatches = [
        style.mix(c, under, share)
        for c in named
        for under in (style.PAPER, style.INK)
        for share in (1.0, 0.75, 0.5, 0.25)
    ]
    strip = np.repeat(np.repeat(np.array(swatches, dtype=np.uint8)[None], 24, axis=0), 24, axis=1)
    width = frame.shape[1]
    rows = [strip[:, k : k + width] for k in range(0, strip.shape[1], width)]
    rows[-1] = np.pad(rows[-1], ((0, 0), (0, width - rows[-1].shape[1]), (0, 0)), mode="edge")
    return Image.fromarray(np.concatenate([frame, *rows])).quantize(_COLORS)
