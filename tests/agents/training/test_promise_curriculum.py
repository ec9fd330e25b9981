"""A promise filter whose probability rises in the training."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from safe_envs import ConfigurationError
from safe_envs.agents.training import vec_env
from safe_envs.agents.training.config import PromiseCurriculum, Training
from safe_envs.agents.training.trainer import TrainingSession, train
from safe_envs.agents.training.vec_env import SafeVecEnv, make_sb3_env
from tests.values.guesses import SCALAR, guess

PROMISE = "promise:p=0.97"
HORIZON = {"horizon": 0.2}  # 20 steps


@pytest.fixture(autouse=True)
def guessed(monkeypatch):
    """Envs of a training with a guess as their table."""
    torch.set_num_threads(1)

    def make(env_id, num_envs, text, **options):
        text = guess(**HORIZON) if text == PROMISE else text
        return make_sb3_env(env_id, num_envs, text, **options)

    monkeypatch.setattr("safe_envs.agents.training.vec_env.make_sb3_env", make)


def training(**changes):
    given = {"filter": PROMISE, "n_timesteps": 512, "eval_freq": 128, "num_envs": 4}
    settings = {"n_steps": 16, "batch_size": 64, "n_epochs": 1}
    return Training.of(SCALAR, "ppo", options=HORIZON, settings=settings, **{**given, **changes})


def test_p_rises_linearly_to_that_of_the_filter():
    curriculum = PromiseCurriculum.of(0.5, 0.5, "promise:p=0.9", 1000)
    assert curriculum == PromiseCurriculum(0.5, 0.9, 500.0)
    assert [curriculum.at(n) for n in (0, 500, 1000, 1100)] == [0.5, 0.9, 0.9, 0.9]
    assert curriculum.at(250) == pytest.approx(0.7)
    assert PromiseCurriculum.of(None, 0.5, "scbf", 1000) is None
    values = [PromiseCurriculum.of(0.1, 1.0, "promise:p=0.7", 7).at(n) for n in range(9)]
    assert values == sorted(values)
    assert values[-1] == 0.7


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"filter": "scbf"}, "promise filter"),
        ({"filter": None}, "promise filter"),
        ({"promise_curriculum": 0.97}, "promise_curriculum"),
        ({"promise_curriculum": 0.0}, "promise_curriculum"),
        ({"promise_curriculum": float("nan")}, "JSON"),
        ({"promise_curriculum": True}, "promise_curriculum"),
        ({"promise_curriculum": "half"}, "promise_curriculum"),
        ({"curriculum_part": 0.0}, "curriculum_part"),
        ({"curriculum_part": 1.5}, "curriculum_part"),
    ],
)
def test_wrong_curricula_are_refused(changes, word):
    with pytest.raises(ConfigurationError, match=word):
        training(**{"promise_curriculum": 0.5, **changes})


def test_each_episode_keeps_the_p_it_began_with():
    envs = make_sb3_env(SCALAR, 3, guess(**HORIZON), **HORIZON)
    envs.env_method("ask_promise", 0.5)
    envs.seed(0)
    envs.reset()
    memory = envs.env._filter
    np.testing.assert_array_equal(memory.levels, np.full(3, 0.5))
    other = make_sb3_env(SCALAR, 3, guess(0.5, **HORIZON), **HORIZON)
    other.seed(0)
    other.reset()
    rng = np.random.default_rng(0)
    for k in range(40):
        if k == 5:
            envs.env_method("ask_promise", 0.9)
        action = rng.uniform(-1.0, 1.0, (3, 1))
        *_, done, infos = envs.step(action)
        *_, theirs = other.step(action)
        if k < 20:  # in the first episode all is as behind the filter that is made for 0.5
            assert [i["safe_action"] for i in infos] == [i["safe_action"] for i in theirs]
            assert [i["promise"] for i in infos] == [i["promise"] for i in theirs]
        if done.all():
            starts = [info["promise"] for info in envs.reset_infos]
            assert starts == pytest.approx(np.full(3, 0.9)) or max(starts) <= 0.9
            assert max(starts) > 0.5
            break
    assert k == 19


def test_what_may_be_asked():
    envs = make_sb3_env(SCALAR, 2, guess(**HORIZON), **HORIZON)
    for wrong in (0.0, 0.98, float("nan")):
        with pytest.raises(ConfigurationError, match="probability"):
            envs.env_method("ask_promise", wrong)
    other = make_sb3_env(SCALAR, 2, "scbf", **HORIZON)
    with pytest.raises(ConfigurationError, match="promise filter"):
        other.env_method("ask_promise", 0.5)


def starts_of(session):
    """Let a session note the p_0 of its episodes, with the steps before."""
    found, envs = [], session._model.get_env().unwrapped
    assert isinstance(envs, SafeVecEnv)
    step, reset = envs.step_wait, envs.reset

    def noted_reset():
        observation = reset()
        found.append((0, [info["promise"] for info in envs.reset_infos]))
        return observation

    def noted():
        done = session._model.num_timesteps
        answer = step()
        ended = np.flatnonzero(answer[2])
        if ended.size:
            found.append((done, [envs.reset_infos[i]["promise"] for i in ended]))
        return answer

    envs.step_wait, envs.reset = noted, noted_reset
    return found


def test_episodes_of_a_training_begin_with_the_p_of_their_time(tmp_path, monkeypatch):
    monkeypatch.setattr(TrainingSession, "_evaluate", lambda *_: None)
    asked = training(promise_curriculum=0.5, curriculum_part=1.0, n_timesteps=512)
    folder = tmp_path / "run"
    folder.mkdir()
    session = TrainingSession(asked, folder)
    found = starts_of(session)
    session.log(None)
    session.run(lambda _: None)
    assert len(found) >= 5
    for done, starts in found:
        # Starts near the limit may allow less than what is asked for.
        assert max(starts) == pytest.approx(asked.curriculum.at(done))
        assert min(starts) > 0.0
    assert found[0][1] == pytest.approx([0.5] * 4)


def test_it_resumes_bitwise(tmp_path, monkeypatch):
    monkeypatch.setattr(TrainingSession, "_evaluate", lambda *_: None)
    asked = training(promise_curriculum=0.5, curriculum_part=0.8)
    train(asked, tmp_path / "whole")

    def stop(part):
        if part > 0.6:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(asked, tmp_path / "parts", progress=stop)
    train(asked, tmp_path / "parts", resume=True)
    one, other = ((tmp_path / name / "policy.npz").read_bytes() for name in ("whole", "parts"))
    assert one == other
    train(training(), tmp_path / "without")
    assert (tmp_path / "without" / "policy.npz").read_bytes() != one
    log = (tmp_path / "parts" / "progress.jsonl").read_text()
    logged = [json.loads(x) for x in log.splitlines()]
    values = [line["train/probability"] for line in logged if "train/probability" in line]
    assert values == sorted(values)
    assert values[-1] == 0.97


def test_a_training_without_it_is_the_same_as_before(tmp_path, monkeypatch):
    """That is, p is never asked for."""
    monkeypatch.setattr(TrainingSession, "_evaluate", lambda *_: None)
    asked = []
    monkeypatch.setattr(
        vec_env.SafetyFilterVectorWrapper, "ask_promise", lambda _, p: asked.append(p)
    )
    train(training(n_timesteps=128), tmp_path / "run")
    assert not asked
