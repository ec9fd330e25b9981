from __future__ import annotations

import sys

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from safe_envs.errors import ConfigurationError
from safe_envs.rendering import style
from scripts.cli import app
from scripts.film import steps_a_frame
from scripts.render import split_filters


def render(*arguments: str):
    return CliRunner().invoke(app, ["render", *arguments])


def drawn(path) -> list[np.ndarray]:
    with Image.open(path) as image:
        frames = []
        for k in range(getattr(image, "n_frames", 1)):
            image.seek(k)
            frames.append(np.asarray(image.convert("RGB")))
    return frames


def test_a_still_of_two_filters(tmp_path):
    out = tmp_path / "end.png"
    arguments = ("safe_envs/DubinsDisk-v0", "--horizon", "2", "--start", "0,0.1,0", "--out", str(out))
    result = render(*arguments, "--compare", "none,hocbf:p=2,8")
    assert result.exit_code == 0, result.output
    assert "none: violation at" in result.output
    assert "hocbf:p=2,8: " in result.output
    (both,) = drawn(out)
    assert both.shape == (540, 1920, 3)
    bare = both[:, :960]
    assert (bare[110:130, 790:930] == style.VIOLATION).all(axis=-1).sum() > 500, "the still does not say that the end is unsafe"
    assert (np.abs(bare[:, :600].astype(int) - style.VIOLATION).sum(axis=-1) < 60).sum() > 50, (
        "neither the trail nor a mark shows the violation"
    )
    assert render(*arguments, "--filter", "none").exit_code == 0
    np.testing.assert_array_equal(drawn(out)[0][:, :960], bare)


@pytest.mark.filterwarnings("ignore::SyntaxWarning", "ignore::DeprecationWarning", "ignore::ResourceWarning")
def test_an_episode_as_video_and_animation(tmp_path):
    arguments = ("safe_envs/Scalar-v0", "--horizon", "0.1", "--policy", "random", "--noise", "0.5")
    video, animation = tmp_path / "run.mp4", tmp_path / "run.gif"
    for out in (video, animation):
        result = render(*arguments, "--out", str(out))
        assert result.exit_code == 0, result.output
        assert f"{out}: 6 frames, 0.12 s" in result.output
    frames = drawn(animation)
    assert len(frames) == 6
    assert frames[0].shape == (540, 960, 3)
    with Image.open(animation) as image:
        assert image.info["duration"] == 20
    assert (frames[0] != frames[-1]).any()
    reader = imageio_ffmpeg.read_frames(str(video))
    head = next(reader)
    assert head["size"] == (960, 540)
    assert head["fps"] == 50.0
    played = [np.frombuffer(frame, dtype=np.uint8).reshape(540, 960, 3) for frame in reader]
    assert len(played) == 6
    for ours, theirs in zip(played, frames, strict=True):
        assert np.abs(ours.astype(int) - theirs).mean() < 8.0, "video and animation show different things"


def test_filters_are_divided_at_their_names():
    assert split_filters("none,scbf") == ["none", "scbf"]
    assert split_filters("hocbf:p=2,8,none, scbf:sampling_margin=first-order") == [
        "hocbf:p=2,8",
        "none",
        "scbf:sampling_margin=first-order",
    ]
    assert split_filters("hocbf:p=2,8+cbf:alpha=1,scbf,scbf") == ["hocbf:p=2,8+cbf:alpha=1", "scbf"]
    for text in ("", ",scbf"):
        with pytest.raises(ConfigurationError, match="names no filter"):
            split_filters(text)


def test_films_run_in_real_time(tmp_path):
    out = {suffix: tmp_path / f"run{suffix}" for suffix in (".mp4", ".gif")}
    assert [steps_a_frame(out[s], 0.05, 100) for s in out] == [1, 1]
    assert [steps_a_frame(out[s], 0.01, 100) for s in out] == [2, 2]
    assert [steps_a_frame(out[s], 0.001, 100) for s in out] == [17, 20]
    assert [steps_a_frame(out[s], 0.05, 6000) for s in out] == [1, 10]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--out", "run.avi"), "ends in '.avi'"),
        (("--out", "missing/run.png"), "does not exist"),
        (("--out", "run.png", "--filter", "scfb"), "did you mean 'scbf'"),
        (("--out", "run.png", "--filter", "scbf", "--compare", "none"), "give one of them"),
        (("--out", "run.png", "--policy", "nominall"), "unknown policy"),
        (("--out", "run.png", "--knowledge", "oracle"), "knowledge = 'oracle'"),
        (("--out", "run.png", "--seed", "-1"), "seed = -1"),
        (("--out", "run.gif", "--learned", "run.gif"), "would overwrite"),
    ],
)
def test_mistakes_are_named_and_leave_no_file(tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    result = render("safe_envs/CubicSDEDisk-v0", *arguments)
    assert isinstance(result.exception, ConfigurationError)
    assert message in str(result.exception)
    assert list(tmp_path.iterdir()) == []


def test_missing_moviepy_says_what_to_install(tmp_path, monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == "moviepy"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "moviepy", None)
    result = render("safe_envs/Scalar-v0", "--out", str(tmp_path / "run.mp4"))
    assert 'pip install "safe-envs[render]"' in str(result.exception)
