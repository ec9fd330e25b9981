"""The demo, with little training."""

from __future__ import annotations

import functools

import numpy as np
from stable_baselines3 import PPO

from agents import evaluate, load_problem, make_policy
from scripts import demo


def test_training_writes_a_policy_that_can_be_evaluated(tmp_path):
    path, told = tmp_path / "ppo", []
    demo.train(path, told.append, steps=1024)
    assert PPO.load(path / "model.zip", device="cpu").num_timesteps == 1024
    assert told == sorted(told)
    assert 0 < told[0] < 0.1
    assert told[-1] == 1.0
    make_policy(str(path), load_problem(demo.ENV_ID))
    answer = evaluate(demo.ENV_ID, str(path), ["none"], options={"horizon": 0.5}, episodes=5)
    assert answer.rows[0]["episodes"] == 5


def test_being_told_does_not_change_the_training(tmp_path):
    policies = []
    for i, tell in enumerate((None, lambda _: None)):
        demo.train(tmp_path / str(i), tell, steps=1024)
        policies.append(make_policy(str(tmp_path / str(i)), load_problem(demo.ENV_ID)))
    observations = np.random.default_rng(0).uniform(-1.0, 1.0, (50, 4)).astype(np.float32)
    first, second = (policy.predict(observations)[0] for policy in policies)
    np.testing.assert_array_equal(first, second)


def test_demo_prints_two_tables_and_leaves_a_policy_and_two_pictures(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(demo, "train", functools.partial(demo.train, steps=1024))
    folder = tmp_path / "new" / "results"
    demo.demo(folder, episodes=10)
    out = capsys.readouterr().out
    assert sorted(p.name for p in folder.iterdir()) == ["nominal.png", "ppo", "ppo.png"]
    assert sorted(p.name for p in (folder / "ppo").iterdir()) == ["model.zip", "policy.json", "policy.safetensors"]
    for path in folder.iterdir():
        assert str(path) in out
        assert path.is_dir() or path.stat().st_size > 5000
    assert out.count("safe [95 % interval]") == 2
    assert "policy nominal" in out
    for name in demo.FILTERS:
        assert sum(line.startswith(name) for line in out.splitlines()) == 2
