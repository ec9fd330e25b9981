"""What `safe-envs evaluate` cannot take: status 2, and a reason."""

from __future__ import annotations

from pathlib import Path

import pytest

from safe_envs.agents import make_problem
from tests.scripts.conftest import strictly

pytestmark = pytest.mark.usefixtures("coarse_bounds")
DUBINS = "safe_envs/StochasticDubins-v0"
QUICK = ("--episodes", "8", "--horizon", "0.3")


@pytest.fixture
def ppo(tmp_path):
    """A folder as `safe-envs train` writes it, with the .zip of an untrained model."""
    import gymnasium as gym
    from stable_baselines3 import PPO

    from safe_envs.agents.policies.network import save_policy

    model = PPO("MlpPolicy", gym.make(DUBINS), policy_kwargs={"net_arch": [8]}, device="cpu")
    save_policy(model, tmp_path / "ppo", make_problem(DUBINS))
    model.save(tmp_path / "ppo" / "model.zip")


def test_a_trained_policy_needs_trust_only_as_a_zip(safe_envs_command, ppo):
    evaluation, verification = (
        ("evaluate", DUBINS, *QUICK, "--filter", "none"),
        ("verify", "Scalar-v0", "--no-simulate"),
    )
    assert safe_envs_command(*evaluation, "--policy ppo")[0] == 0
    assert safe_envs_command(*evaluation, "--policy ppo/model.zip --trust")[0] == 0
    for command in (evaluation, verification):
        status, out, err = safe_envs_command(*command, "--policy ppo/model.zip")
        assert (status, out) == (2, "")
        assert (
            "loading ppo/model.zip runs code that it contains; if you trust its source, pass"
            " --trust" in " ".join(err.split())
        )
    status, _, err = safe_envs_command(*verification, "--policy ppo/model.zip --trust")
    assert (status, "another observation space" in " ".join(err.split())) == (2, True)


@pytest.mark.parametrize("policy", ["ppo", "ppo/model.zip"])
def test_a_policy_is_not_overwritten(safe_envs_command, ppo, policy):
    file = Path("ppo/policy.npz" if policy == "ppo" else policy)
    before = file.read_bytes()
    status, _, err = safe_envs_command("evaluate", DUBINS, "--policy", policy, "--json", file)
    assert (status, file.read_bytes()) == (2, before)
    assert f"would overwrite the file of --policy {file}" in err


def test_forces_beyond_floating_point_are_an_error_not_a_crash(safe_envs_command):
    # The square of such an input is not finite, and infinity is no JSON.
    arguments = "--input-bounds -1e200,1e200 --policy random --filter none --json out.json"
    status, _, err = safe_envs_command("evaluate Scalar-v0", *QUICK, arguments)
    assert status in (0, 2)
    assert "Traceback" not in err
    if status == 0:
        strictly("out.json")


@pytest.mark.parametrize("suffix", ["pgf", "tif"])
def test_every_format_is_refused_before_the_run_or_written(safe_envs_command, suffix):
    status, _, _ = safe_envs_command(
        "evaluate Scalar-v0 --filter none", *QUICK, "--plot", f"out.{suffix}"
    )
    written = Path(f"out.{suffix}")
    assert (status == 0 and written.stat().st_size > 0) or (status == 2 and not written.exists())


def test_a_failed_picture_leaves_no_part_of_it(safe_envs_command, monkeypatch):
    from matplotlib.figure import Figure

    def fail(self, file, **_):
        file.write(b"half a picture")
        raise OSError("no space left")

    monkeypatch.setattr(Figure, "savefig", fail)
    status, _, err = safe_envs_command("evaluate Scalar-v0", *QUICK, "--plot out.png")
    assert status == 2
    assert "cannot write out.png: no space left" in err
    assert list(Path().iterdir()) == []
