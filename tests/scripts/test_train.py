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
QUICK = "--n-timesteps 512 --num-envs 4 --eval-freq 256 --eval-episodes 8 --horizon 0.5"


@pytest.mark.slow
def test_an_agent_is_trained_evaluated_and_gone_on_with(safe_envs_command, tmp_path):
    arguments = (
        f"train {DUBINS} --algo ppo --filter scbf --engine numpy --out run",
        QUICK,
        "--set learning_rate=lin_1e-3 --set ent_coef=1e-3",
    )
    status, out, err = safe_envs_command(*arguments, "--tensorboard logs")
    assert (status, err) == (0, "")
    assert re.search(r"violations\n.* in training\n", out)
    assert f"safe-envs evaluate {DUBINS} --policy run --filter scbf --horizon=0.5" in out
    assert list((tmp_path / "logs").iterdir())
    config = json.loads((tmp_path / "run" / "config.json").read_text())["training"]
    assert config["hyperparameters"]["learning_rate"] == "lin_1e-3"
    assert config["hyperparameters"]["ent_coef"] == 1e-3
    assert config["engine"] == "numpy"
    status, out, err = safe_envs_command(
        "evaluate", DUBINS, "--policy run --filter none --filter scbf --episodes 20"
    )
    assert (status, err) == (0, "")
    assert "policy run" in out
    status, _, err = safe_envs_command(*arguments)
    assert status == 2
    assert "not empty" in err
    assert safe_envs_command(*arguments, "--resume")[0] == 0


def test_an_agent_under_a_limit_is_told_to_keep_it_or_not(safe_envs_command):
    Path("own.py").write_text(SYSTEM)
    given = "--algo ppo-lag --num-envs 4 --eval-episodes 8 --set n_steps=32"
    arguments = ("train", "--system", "own.py:problem", given, "--n-timesteps", 1024)
    limit = ("--eval-freq", 1024, "--out", "run", "--violation-limit")
    status, out, err = safe_envs_command(*arguments, *limit, "0.2 --json run.json")
    assert (status, err) == (0, "")
    assert "P(any violation) <= 20 %. Measured:" in " ".join(out.split())
    last = strictly("run.json")["evaluations"][-1]
    assert last["constraint"]["limit"] == 0.2
    evaluated = ("--policy", "run", "--filter", "none", "--episodes", 8)
    assert safe_envs_command("evaluate --system own.py:problem", *evaluated)[::2] == (0, "")
    assert safe_envs_command(*arguments, *limit, "0.2 --resume")[0] == 0
    status, _, err = safe_envs_command(*arguments, *limit, "0.3 --resume")
    assert status == 2
    assert "violation_limit = 0.2, not 0.3" in err


def test_a_system_without_a_workspace_is_trained_and_gone_on_with(safe_envs_command):
    Path("own.py").write_text(SYSTEM)
    given = "--algo ppo --n-timesteps 128 --num-envs 4 --eval-episodes 8 --set n_steps=32 --out run"
    arguments = ("train", "--system", "own.py:problem", given)
    status, out, err = safe_envs_command(*arguments, "--eval-freq 128")
    assert (status, err) == (0, "")
    assert "finished already" not in out
    assert load(Path("run/policy.npz")).details["observation"] == {
        "low": ["-inf", "-inf"],
        "high": ["inf", "inf"],
    }
    evaluated = ("--policy", "run", "--filter", "none", "--episodes", 8)
    assert safe_envs_command("evaluate --system own.py:problem", *evaluated)[::2] == (0, "")
    # A policy of other observations is refused as ever.
    status, _, err = safe_envs_command("evaluate --system own.py:bounded", *evaluated)
    assert status == 2
    assert "was trained for another problem: its observation" in err
    status, out, _ = safe_envs_command(*arguments, "--eval-freq 128 --resume")
    assert status == 0
    assert out.startswith("The training in run was finished already")
    # The system is named before all that changes with it.
    status, _, err = safe_envs_command(
        "train --system own.py:bounded", given, "--eval-freq 64 --resume"
    )
    assert status == 2
    assert "has system = 'own.py:problem', not 'own.py:bounded'" in err
