"""Videos by Stable-Baselines3; for those of Gymnasium see tests/wrappers/test_wrapper_order.py."""

from __future__ import annotations

import numpy as np
import pytest
from stable_baselines3.common.vec_env import VecVideoRecorder

from safe_envs.agents import make_sb3_env
from tests.rendering.drawn import DUBINS

pytestmark = pytest.mark.slow


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
