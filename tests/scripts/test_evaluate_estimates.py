"""`safe-envs evaluate --estimator`: rows side by side, and what is refused."""

from __future__ import annotations

import pytest

from tests.scripts.conftest import strictly

DUBINS = "safe_envs/StochasticDubins-v0"
QUICK = ("--episodes", 12, "--horizon", 0.5, "--measurement", "default", "--estimator", "ekf")
ROWS = ["scbf@state", "scbf", "scbf:belief=0.05"]

pytestmark = pytest.mark.usefixtures("coarse_bounds")


@pytest.mark.parametrize("name", ["ACC-v0", "StochasticDubins-v0", "Pendulum-v0"])
def test_a_filter_is_compared_at_states_estimates_and_beliefs(safe_envs_command, tmp_path, name):
    given = (*QUICK, "--json", tmp_path / "out.json")
    status, out, _ = safe_envs_command("evaluate", name, "--filter", "scbf", *given)
    assert status == 0
    document = strictly(tmp_path / "out.json")
    assert [row["filter"] for row in document["rows"]] == ROWS
    for text in (*ROWS, "NEES", "NIS"):
        assert text in out
    at_state, at_estimate, at_belief = document["rows"]
    assert "estimation" not in at_state
    for row in (at_estimate, at_belief):
        assert row["estimation"]["nees"]["low"] < row["estimation"]["nees"]["high"]
        # Bounds of true states are not claimed for estimates.
        assert row["continuous_bound"] is row["held_bound"] is None
    named = [(pair["first"], pair["second"]) for pair in document["comparisons"]]
    assert ("scbf", "scbf@state") in named


def test_without_a_filter_nothing_intervenes_at_states_and_at_estimates(safe_envs_command):
    given = (*QUICK, "--no-bounds", "--json", "out.json")
    status, out, _ = safe_envs_command(
        "evaluate", DUBINS, "--filter", "none", "--filter", "scbf", *given
    )
    assert status == 0
    rows = strictly("out.json")["rows"]
    assert [(row["filter"], row["kind"]) for row in rows] == [
        ("none@state", "unfiltered"),
        ("none", "unfiltered"),
        *((name, "filter") for name in ROWS),
    ]
    assert "0.0 %" not in next(
        line for line in out.splitlines() if line.startswith("none@state") and " %" not in line
    )
    compared = [line for line in out.splitlines() if " points [" in line]
    assert len(compared) == 3
    assert "none" not in " ".join(compared)
    assert "bound, continuous: not computed" in out


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["--estimator", "ekv"], "did you mean 'ekf'"),
        (["--estimator", "ekf:gain=1"], "process_noise"),
        (["--measurement=default", "--estimator=ekf:process_noise=-1"], "give a number >= 0"),
        (["--estimator", "ekf"], "nothing to estimate"),
        (["--observe", "measurement"], "goes with an estimator"),
        (["--filter", "scbf@state"], "--estimator ekf"),
        (["--measurement", "default"], "give an estimator"),
        (["--measurement", "theta:noise=0.1", "--estimator", "ekf"], "does not determine x, y"),
        (["--measurement", "default:noise=0", "--estimator", "ekf"], "singular"),
        (["--measurement", "default:noise=1e-300", "--estimator", "ekf"], "singular"),
        (["--measurement", "default", "--estimator", "ukf:alpha=1e-200"], "from 1e-8 to 1e8"),
        (["--measurement", "default", "--estimator", "kf"], "linear systems"),
        (["--measurement", "default", "--estimator", "ekf", "--belief", "1"], "such as 0.05"),
        (["--measurement", "default", "--estimator", "ekf", "--delay", "1"], "delay"),
        (["--measurement", "default", "--estimator", "ekf", "--rare"], "rare"),
        (["--measurement", "w=z**2:noise=1", "--estimator", "ekf"], "'z'"),
    ],
)
def test_mistakes_end_with_status_2(safe_envs_command, given, message):
    status, out, error = safe_envs_command("evaluate", DUBINS, "--episodes", 1, *given)
    assert (status, out) == (2, "")
    assert message in " ".join(error.split())
    assert "Traceback" not in error
    assert len(error) < 700


@pytest.mark.parametrize("command", ["best", "certify", "export", "frontier", "render", "verify"])
def test_commands_of_true_states_ignore_no_sensor(safe_envs_command, command):
    status, _, error = safe_envs_command(command, DUBINS, "--measurement", "default")
    assert status == 2
    assert "unknown option '--measurement'" in " ".join(error.split())


def test_training_and_the_evaluation_of_its_policy_take_an_estimator(safe_envs_command, tmp_path):
    status, out, _ = safe_envs_command(
        *("train", "Scalar-v0", "--algo", "ppo", "--filter", "scbf", "--out", tmp_path / "run"),
        *("--n-timesteps", 128, "--num-envs", 4, "--set", "n_steps=32", "--eval-episodes", 4),
        *("--horizon", 0.3, "--measurement", "default", "--estimator", "kf"),
    )
    assert status == 0
    assert "--estimator=kf" in out.replace("\n", " ")
    status, out, _ = safe_envs_command(
        *("evaluate", "Scalar-v0", "--policy", tmp_path / "run", "--filter", "scbf"),
        *("--horizon", 0.3, "--episodes", 4, "--measurement", "default", "--estimator", "kf"),
    )
    assert status == 0
    assert "scbf@state" in out
