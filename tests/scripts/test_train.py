"""`safe-envs train` as a person types it."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from safe_envs.filters.learning.data import load
from tests.scripts.conftest import strictly
from tests.scripts.own_system import SYSTEM

pytestmark = pytest.mark.slow

DUBINS = "safe_envs/StochasticDubins-v0"
QUICK = (
    "--n-timesteps",
    512,
    "--num-envs",
    4,
    "--eval-freq",
    256,
    "--eval-episodes",
    8,
    "--horizon",
    0.5,
)


@pytest.mark.slow
def test_an_agent_is_trained_evaluated_and_gone_on_with(safe_envs_command, tmp_path):
    arguments = (
        "train",
        DUBINS,
        "--algo",
        "ppo",
        "--filter",
        "scbf",
        *QUICK,
        "--set",
        "learning_rate=lin_1e-3",
        "--set",
        "ent_coef=1e-3",
        "--engine",
        "numpy",
        "--out",
        "run",
    )
    status, out, err = safe_envs_command(*arguments, "--tensorboard", "logs")
    assert (status, err) == (0, "")
    assert re.search(r"violations\n.* in training\n", out)
    assert f"safe-envs evaluate {DUBINS} --policy run --filter scbf --horizon=0.5" in out
    assert list((tmp_path / "logs").iterdir())
    config = json.loads((tmp_path / "run" / "config.json").read_text())["training"]
    assert config["hyperparameters"]["learning_rate"] == "lin_1e-3"
    assert config["hyperparameters"]["ent_coef"] == 1e-3
    assert config["engine"] == "numpy"
    status, out, err = safe_envs_command(
        "evaluate",
        DUBINS,
        "--policy",
        "run",
        "--filter",
        "none",
        "--filter",
        "scbf",
        "--episodes",
        20,
    )
    assert (status, err) == (0, "")
    assert "policy run" in out
    status, _, err = safe_envs_command(*arguments)
    assert status == 2
    assert "not empty" in err
    assert safe_envs_command(*arguments, "--resume")[0] == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--algo", "dqn"), "dqn"),
        (("--algo", "ppo", "--filter", "sbf"), "sbf"),
        (("--algo", "ppo", "--filter", "scbf", "--filter", "hocbf"), "one filter"),
        (("--algo", "ppo", "--set", "gamma"), "NAME=VALUE"),
        (("--algo", "ppo", "--set", "gamma=[1"), "no YAML"),
        (("--algo", "ppo", "--set", "speed=3"), "does not take"),
        (("--algo", "ppo", "--set", f"gamma={'[' * 1000}"), "no YAML"),
        (("--algo", "ppo", "--set", f"gamma={'[' * 3000}"), "nested more than 10 deep"),
        (("--algo", "ppo", "--set", "x" * 3000), "xxx: give NAME=VALUE"),
        (
            ("--algo", "ppo", "--set", "policy_kwargs={a: &a [1, 1], b: &b [*a, *a], c: [*b, *b]}"),
            "an alias is not allowed",
        ),
        (("--algo", "ppo", "--set", "gamma=2020-13-45"), "gamma = '2020-13-45'; give a number"),
        (("--algo", "ppo", "--set", "n_steps=1_000"), "1_000 is no plain number"),
        (("--algo", "ppo", "--set", "gamma=\u0661"), "the digits 0 to 9"),
        (("--algo", "ppo", "--n-timesteps", 0), "n_timesteps = 0"),
        (("--algo", "ppo", "--intervention-penalty", 1), "penalty"),
        (("--algo", "sac", "--action", "best"), "action = 'best'"),
        (("--algo", "ppo", "--promise-curriculum", 0.5), "a promise filter in the loop"),
        (
            ("--algo", "ppo", "--filter", "promise:p=0.9", "--promise-curriculum", 0.9),
            "promise_curriculum = 0.9",
        ),
        (("--algo", "ppo", "--resume"), "holds no training"),
        (("--algo", "ppo", "--cost-limit", 1), "ppo has no cost_limit; leave it out, or choose"),
        (("--algo", "sac-lag", "--violation-limit", 1), "is a probability"),
        (("--algo", "ppo-lag", "--cost-limit", "nan"), "cost_limit = nan; give a finite number"),
        (("--algo", "ppo-lag", "--cost-limit", 1, "--violation-limit", 0.1), "give one"),
        (("--algo", "ppo-lag", "--set", "cost_limit=1"), "give the limit by --cost-limit"),
        (("--algo", "ppo-lag", "--set", "multiplier_kq=1"), "did you mean 'multiplier_kp'"),
        (("--algo", "ppo-lag", "--set", "multiplier_ki=-1"), "multiplier_ki = -1"),
        (("--algo", "ppo-lag", "--set", "cost_gamma=soon"), "cost_gamma = 'soon'; give a number"),
    ],
)
def test_what_it_cannot_take_ends_with_status_2_and_leaves_nothing(
    safe_envs_command, tmp_path, arguments, message
):
    status, _, err = safe_envs_command(
        "train", DUBINS, "--horizon", 0.5, "--num-envs", 2, *arguments, "--out", "run"
    )
    assert status == 2
    assert "Traceback" not in err
    assert message in " ".join(err.split())
    assert not (tmp_path / "run").exists()


def test_an_agent_under_a_limit_is_told_to_keep_it_or_not(safe_envs_command):
    Path("own.py").write_text(SYSTEM)
    given = ("--algo", "ppo-lag", "--num-envs", 4, "--eval-episodes", 8, "--set", "n_steps=32")
    arguments = ("train", "--system", "own.py:problem", *given, "--n-timesteps", 1024)
    limit = ("--eval-freq", 1024, "--out", "run", "--violation-limit")
    status, out, err = safe_envs_command(*arguments, *limit, 0.2, "--json", "run.json")
    assert (status, err) == (0, "")
    assert "P(any violation) <= 20 %. Measured:" in " ".join(out.split())
    last = strictly("run.json")["evaluations"][-1]
    assert last["constraint"]["limit"] == 0.2
    evaluated = ("--policy", "run", "--filter", "none", "--episodes", 8)
    assert safe_envs_command("evaluate", "--system", "own.py:problem", *evaluated)[::2] == (0, "")
    assert safe_envs_command(*arguments, *limit, 0.2, "--resume")[0] == 0
    status, _, err = safe_envs_command(*arguments, *limit, 0.3, "--resume")
    assert status == 2
    assert "violation_limit = 0.2, not 0.3" in err


def test_a_system_without_a_workspace_is_trained_and_gone_on_with(safe_envs_command):
    Path("own.py").write_text(SYSTEM)
    given = (
        "--algo",
        "ppo",
        "--n-timesteps",
        128,
        "--num-envs",
        4,
        "--eval-episodes",
        8,
        "--set",
        "n_steps=32",
        "--out",
        "run",
    )
    arguments = ("train", "--system", "own.py:problem", *given)
    status, out, err = safe_envs_command(*arguments, "--eval-freq", 128)
    assert (status, err) == (0, "")
    assert "finished already" not in out
    assert load(Path("run/policy.npz")).details["observation"] == {
        "low": ["-inf", "-inf"],
        "high": ["inf", "inf"],
    }
    evaluated = ("--policy", "run", "--filter", "none", "--episodes", 8)
    assert safe_envs_command("evaluate", "--system", "own.py:problem", *evaluated)[::2] == (0, "")
    # A policy of other observations is refused as ever.
    status, _, err = safe_envs_command("evaluate", "--system", "own.py:bounded", *evaluated)
    assert status == 2
    assert "was trained for another problem: its observation" in err
    status, out, _ = safe_envs_command(*arguments, "--eval-freq", 128, "--resume")
    assert status == 0
    assert out.startswith("The training in run was finished already")
    # The system is named before all that changes with it.
    status, _, err = safe_envs_command(
        "train", "--system", "own.py:bounded", *given, "--eval-freq", 64, "--resume"
    )
    assert status == 2
    assert "has system = 'own.py:problem', not 'own.py:bounded'" in err
