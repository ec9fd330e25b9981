from __future__ import annotations

import json
import sys

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from safe_envs import SafeEnv
from safe_envs.agents.policies.registry import make_policy
from safe_envs.errors import ConfigurationError
from safe_envs.rendering import style
from safe_envs.scripts.cli import app
from safe_envs.scripts.figures.film import steps_a_frame, write_film
from safe_envs.scripts.render import frames_of, split_filters
from safe_envs.scripts.reports.installation import packages
from safe_envs.wrappers import SafetyFilterWrapper
from tests.conftest import problem_of
from tests.scripts.conftest import words_of

pytestmark = pytest.mark.slow


def render(*arguments):
    return CliRunner().invoke(app, words_of("render", *arguments))


def drawn(path) -> list[np.ndarray]:
    with Image.open(path) as image:
        frames = []
        for k in range(getattr(image, "n_frames", 1)):
            image.seek(k)
            frames.append(np.asarray(image.convert("RGB")))
    return frames


def test_a_still_of_two_filters(tmp_path):
    out = tmp_path / "end.png"
    line = f"safe_envs/DubinsDisk-v0 --horizon 2 --start 0,0.1,0 --out {out}"
    result = render(line, "--compare none,hocbf:alpha=2,8")
    assert result.exit_code == 0, result.output
    assert "none: violation at" in result.output
    assert "hocbf:alpha=2,8: " in result.output
    (both,) = drawn(out)
    assert both.shape == (540, 1920, 3)
    bare = both[:, :960]
    assert (bare[110:130, 790:930] == style.VIOLATION).all(axis=-1).sum() > 500, (
        "the still does not say that the end is unsafe"
    )
    assert (np.abs(bare[:, :600].astype(int) - style.VIOLATION).sum(axis=-1) < 60).sum() > 50, (
        "neither the trail nor a mark shows the violation"
    )
    assert render(line, "--filter none").exit_code == 0
    np.testing.assert_array_equal(drawn(out)[0][:, :960], bare)


@pytest.mark.slow
@pytest.mark.filterwarnings(
    "ignore::SyntaxWarning", "ignore::DeprecationWarning", "ignore::ResourceWarning"
)
def test_an_episode_as_video_and_animation(tmp_path):
    line = "safe_envs/Scalar-v0 --horizon 0.1 --policy random --noise 0.5"
    video, animation = tmp_path / "run.mp4", tmp_path / "run.gif"
    for out in (video, animation):
        result = render(line, "--out", out)
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
        assert np.abs(ours.astype(int) - theirs).mean() < 8.0, (
            "video and animation show different things"
        )


def test_filters_are_divided_at_their_names():
    assert split_filters("none,scbf") == ["none", "scbf"]
    assert split_filters("hocbf:alpha=2,8,none, scbf:sampling_margin=first-order") == [
        "hocbf:alpha=2,8",
        "none",
        "scbf:sampling_margin=first-order",
    ]
    assert split_filters("hocbf:alpha=2,8+cbf:alpha=1,scbf,scbf") == [
        "hocbf:alpha=2,8+cbf:alpha=1",
        "scbf",
    ]
    for text in ("", ",scbf"):
        with pytest.raises(ConfigurationError, match="names no filter"):
            split_filters(text)


def test_films_run_in_real_time(tmp_path):
    out = {suffix: tmp_path / f"run{suffix}" for suffix in (".mp4", ".gif")}
    assert [steps_a_frame(out[s], 0.05, 100) for s in out] == [1, 1]
    assert [steps_a_frame(out[s], 0.01, 100) for s in out] == [2, 2]
    assert [steps_a_frame(out[s], 0.001, 100) for s in out] == [17, 20]
    assert [steps_a_frame(out[s], 0.05, 6000) for s in out] == [1, 10]


@pytest.mark.parametrize("seconds", [0.02, 0.025, 0.0333, 0.1])
def test_animations_run_in_real_time(tmp_path, seconds):
    out = tmp_path / "run.gif"
    frames = (np.full((6, 6, 3), 40 * k, dtype=np.uint8) for k in range(7))
    assert write_film(out, frames, seconds) == 7
    with Image.open(out) as image:
        lengths = []
        for k in range(image.n_frames):
            image.seek(k)
            lengths.append(image.info["duration"])
    ends = np.cumsum(lengths)
    assert len(ends) == 7
    assert np.abs(ends - 1000 * seconds * np.arange(1, 8)).max() <= 5.0 + 1e-6


def straightforward(
    env_id: str, seed: int, filter_name: str | None = None, knowledge: str = "model", **options
):
    """What an env of the seed does under the random policy: the minimum h, and where and when it
    ended and was unsafe first."""
    problem = problem_of(env_id, **options)
    env = (
        SafeEnv(problem)
        if filter_name is None
        else SafetyFilterWrapper(SafeEnv(problem), filter_name, knowledge)
    )
    actor = make_policy("random", problem, False)
    actor.begin(range(1), seed)
    observation, info = env.reset(seed=seed)
    violated, steps, state, ended = 0.0 if info["cost"] else None, 0, None, False
    while not ended:
        actions, state = actor.predict(
            observation[None], state, np.array([steps == 0]), deterministic=True
        )
        observation, _, terminated, truncated, info = env.step(actions[0])
        steps += 1
        ended = terminated or truncated or steps >= problem.steps
        violated = steps * problem.dt if violated is None and info["cost"] else violated
    return {"violated_at": violated, "h_min": info["h_min"], "seconds": steps * problem.dt}


def episodes(tmp_path, *arguments) -> list[dict]:
    """The random policy's episodes, from the JSON of a still."""
    found = tmp_path / "found.json"
    result = render(*arguments, "--policy random --out", tmp_path / "end.png", "--json", found)
    assert result.exit_code == 0, result.output
    return json.loads(found.read_text())["episodes"]


@pytest.mark.parametrize("seed", [0, 3])
def test_episodes_are_those_of_the_seed(tmp_path, seed):
    line = "Scalar-v0 --filter none --noise 1 --horizon 0.5 --start 0 --seed"
    (found,) = episodes(tmp_path, line, seed)
    expected = straightforward("safe_envs/Scalar-v0", seed, noise=1.0, horizon=0.5, start=[0.0])
    assert {key: found[key] for key in expected} == pytest.approx(expected)
    assert expected["h_min"] < 0.999, "the actions have no part in it"


def test_the_first_violation_is_at_its_step(tmp_path):
    line = "Scalar-v0 --filter none --start 0.9 --noise 2 --horizon 0.5"
    (found,) = episodes(tmp_path, line)
    expected = straightforward("safe_envs/Scalar-v0", 0, start=[0.9], noise=2.0, horizon=0.5)
    assert expected["violated_at"] > 0.01
    assert found["violated_at"] == pytest.approx(expected["violated_at"])
    (found,) = episodes(tmp_path, "Scalar-v0 --filter none --start 1.5 --horizon 0.05")
    assert found["violated_at"] == 0.0


def test_each_episode_has_a_policy_of_its_own(tmp_path):
    line = "safe_envs/Scalar-v0 --noise 1 --horizon 0.3 --seed 2"
    both = episodes(tmp_path, line, "--compare none,scbf")
    assert both == [episodes(tmp_path, line, "--filter", name)[0] for name in ("none", "scbf")]


class Counted:
    """Stands in for a run of so many steps, with the step as its picture."""

    def __init__(self, steps: int) -> None:
        self.k, self._steps = 0, steps

    @property
    def ended(self) -> bool:
        return self.k == self._steps

    def step(self) -> None:
        self.k += not self.ended

    def frame(self) -> np.ndarray:
        return np.full((1, 1, 3), self.k)


@pytest.mark.parametrize(
    ("every", "expected"), [(1, [0, 1, 2, 3, 4, 5]), (2, [0, 2, 4, 5]), (5, [0, 5]), (9, [0, 5])]
)
def test_a_film_has_the_start_and_the_end(every, expected):
    told = []
    frames = list(frames_of([Counted(5), Counted(3)], every, 5, told.append))
    assert [frame[0, 0, 0] for frame in frames] == expected
    assert [frame[0, 1, 0] for frame in frames] == [min(k, 3) for k in expected]
    assert told == pytest.approx([0.2, 0.4, 0.6, 0.8, 1.0])


def test_missing_moviepy_says_what_to_install(tmp_path, monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == "moviepy"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "moviepy", None)
    # Before any work: what else is wrong comes up later.
    result = render("safe_envs/Scalar-v0", "--start", "1e9", "--out", str(tmp_path / "a.mp4"))
    assert 'pip install --editable ".[render]"' in str(result.exception)


def test_missing_pygame_is_said_before_any_work(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    result = render("safe_envs/Scalar-v0", "--start", "1e9", "--out", str(tmp_path / "a.png"))
    assert 'drawing needs pygame-ce: pip install --editable ".[render]"' in str(result.exception)
    # The doctor reads the metadata, which have pygame-ce.
    assert next(check for check in packages() if check.name == "pygame-ce").ok


def test_the_doctor_finds_the_other_pygame(monkeypatch):
    import pygame

    monkeypatch.delattr(pygame.draw, "aacircle")
    (check,) = (check for check in packages() if check.name == "pygame-ce")
    assert check.ok is False
    assert "what is imported is pygame" in check.found
    assert check.advice.startswith("pip uninstall pygame pygame-ce")
