"""What `safe-envs evaluate` cannot take: status 2, and a reason."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from safe_envs.agents import make_problem
from tests.scripts.conftest import strictly

pytestmark = pytest.mark.usefixtures("coarse_bounds")
DUBINS = "safe_envs/StochasticDubins-v0"
QUICK = ("--episodes", "8", "--horizon", "0.3")
USER_ERRORS = (
    (
        ["safe_envs/StochasticDubin-v0"],
        [
            "unknown env 'safe_envs/StochasticDubin-v0'",
            "did you mean 'safe_envs/StochasticDubins-v0'",
        ],
    ),
    (
        ["CartPole-v1"],
        [
            "not one of this project's envs",
            "safe_envs/DubinsDisk-v0",
            "`safe-envs evaluate CartPole-v1 --filter-spec",
        ],
    ),
    (["CartPole-v1", "--noise", "1"], ["CartPole-v1"]),
    ([":x"], [":x"]),
    ([DUBINS, "--filter", "hocb"], ["unknown filter 'hocb'", "did you mean 'hocbf'"]),
    ([DUBINS, "--filter", "hocbf:q=1,1"], ["no parameter 'q'", "allowed: p"]),
    ([DUBINS, "--filter", "hocbf:p=a"], ["'a' is not allowed"]),
    ([DUBINS, "--filter", "hocbf:p=-1,1"], ["positive"]),
    ([DUBINS, "--filter", "hocbf:p=1"], ["relative degree 2"]),
    ([DUBINS, "--filter", "scbf:alpha=1"], ["no parameter 'alpha'"]),
    ([DUBINS, "--filter", "ecbf:k=9,1"], ["complex poles"]),
    ([DUBINS, "--filter", "cbf"], ["relative degree 2", "use hocbf or ecbf"]),
    ([DUBINS, "--policy", "nominl"], ["unknown policy 'nominl'", "did you mean 'nominal'"]),
    ([DUBINS, "--policy", "missing.zip"], ["'missing.zip'", "there is no such file"]),
    ([DUBINS, "--policy", __file__], ["is a file of Python", "FILE.py:NAME"]),
    ([DUBINS, "--episodes-out", "out.csv"], ["out.csv", "give FILE.parquet"]),
    ([DUBINS, "--policy", __file__, "--trust"], ["is a file of Python"]),
    ([DUBINS, "--policy", "."], ["policy.npz does not exist", "`safe-envs train`"]),
    ([DUBINS, "--plant", "vv=1"], ["unknown parameter 'vv'", "did you mean 'v'"]),
    ([DUBINS, "--plant", "v=fast"], ["--plant 'v=fast'", "not a number"]),
    ([DUBINS, "--plant", "v"], ["NAME=VALUE"]),
    ([DUBINS, "--model", "v=inf"], ["parameter v"]),
    ([DUBINS, "--barrier", "raduis=2"], ["no barrier argument 'raduis'", "did you mean 'radius'"]),
    ([DUBINS, "--barrier", "radius=round"], ["radius"]),
    ([DUBINS, "--knowledge", "plan"], ["knowledge = 'plan'", "did you mean 'plant'"]),
    ([DUBINS, "--box", "1"], ["--box '1' has 1 numbers"]),
    ([DUBINS, "--box", "a,b"], ["--box 'a,b'"]),
    ([DUBINS, "--box", "2,1"], ["box of input omega"]),
    ([DUBINS, "--box", "0,1", "--box", "0,1"], ["box = "]),
    ([DUBINS, "--start", "1,2"], ["start has 2 numbers", "x, y, theta"]),
    ([DUBINS, "--start", "inwrd"], ["unknown start 'inwrd'", "did you mean 'inward'"]),
    ([DUBINS, "--start", "99,0,0"], ["outside the workspace"]),
    ([DUBINS, "--noise", "-1"], ["noise = -1"]),
    ([DUBINS, "--noise", "loud"], ["--noise 'loud'"]),
    ([DUBINS, "--noise", "1,2,3"], ["sigma_1, sigma_2"]),
    ([DUBINS, "--episodes", "0"], ["episodes = 0"]),
    ([DUBINS, "--num-envs", "0"], ["--num-envs = 0"]),
    ([DUBINS, "--seed", "-1"], ["seed = -1"]),
    ([DUBINS, "--engine", "compile"], ["engine = 'compile'", "did you mean 'compiled'"]),
    ([DUBINS, "--jobs", "0"], ["jobs = 0"]),
    ([DUBINS, "--confidence", "1"], ["confidence = 1.0", "above 0 and below 1"]),
    ([DUBINS, "--confidence", "95"], ["confidence = 95.0", "such as 0.95"]),
    ([DUBINS, "--confidence", "nan"], ["confidence = nan"]),
    ([DUBINS, "--filter", "hocbf:p=1,2+scbf"], ["has 2 conditions"]),
    ([DUBINS, "--filter", "hocbf+none"], ["'hocbf+none'", "'none' is the unfiltered env"]),
    ([DUBINS, "--filter", "none+hocbf:p=1,2"], ["'none' is the unfiltered env"]),
    ([DUBINS, "--refine", "--episodes", "0"], ["episodes = 0"]),
    (
        ["Scalar-v0", "--refine", "--dt", "5e-324", "--horizon", "5e-324"],
        ["dt = 0.0 s", "positive and finite"],
    ),
    ([DUBINS, "--dt", "0"], ["dt = 0"]),
    ([DUBINS, "--horizon", "nan"], ["horizon = nan"]),
    ([DUBINS, "--substeps", "0"], ["substeps = 0"]),
    ([DUBINS, "--json", "nowhere/out.json"], ["cannot write nowhere/out.json", "does not exist"]),
    ([DUBINS, "--json", "."], ["it is a folder"]),
    (
        [DUBINS, "--json", "out.svg", "--plot", "./out.svg"],
        ["--plot out.svg would overwrite the file of --json out.svg"],
    ),
    (
        [DUBINS, "--json", "x.npz", "--learned", "x.npz"],
        ["would overwrite the file of --learned x.npz"],
    ),
    (
        [DUBINS, "--json", "x.npz", "--filter", "ddscbf:file=x.npz"],
        ["would overwrite the file of --filter x.npz"],
    ),
    (
        [DUBINS, "--json", "ppo.zip", "--policy", "ppo.zip"],
        ["'ppo.zip': there is no such file"],
    ),
    (
        [DUBINS, "--json", "policy.npz", "--policy", "."],
        ["policy.npz does not exist"],
    ),
    ([DUBINS, "--plot", "nowhere/out.png"], ["cannot write nowhere/out.png"]),
    ([DUBINS, "--plot", "out.pong"], ["unknown format 'pong'", "did you mean 'png'"]),
    ([DUBINS, "--plot", "out"], ["unknown format ''"]),
    (["CubicSDE-v0", "--dt", "1e200", "--horizon", "1e202"], ["left the finite numbers"]),
)


@pytest.mark.parametrize(
    ("arguments", "messages"),
    USER_ERRORS,
    ids=[" ".join(map(os.path.basename, arguments)) for arguments, _ in USER_ERRORS],
)
def test_errors_of_the_user_end_with_status_2_and_say_why(safe_envs_command, arguments, messages):
    files = [] if "--json" in arguments or "--plot" in arguments else ["--json", "out.json"]
    status, out, err = safe_envs_command("evaluate", *arguments, *files)
    assert status == 2
    assert err.startswith("Error:")
    assert "Traceback" not in out + err
    for message in messages:
        assert message in err
    assert list(Path().iterdir()) == []


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
    assert safe_envs_command(*evaluation, "--policy", "ppo")[0] == 0
    assert safe_envs_command(*evaluation, "--policy", "ppo/model.zip", "--trust")[0] == 0
    for command in (evaluation, verification):
        status, out, err = safe_envs_command(*command, "--policy", "ppo/model.zip")
        assert (status, out) == (2, "")
        assert (
            "loading ppo/model.zip runs code that it contains; if you trust its source, pass"
            " --trust" in " ".join(err.split())
        )
    status, _, err = safe_envs_command(*verification, "--policy", "ppo/model.zip", "--trust")
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
    arguments = (
        "--box",
        "-1e200,1e200",
        "--policy",
        "random",
        "--filter",
        "none",
        "--json",
        "out.json",
    )
    status, _, err = safe_envs_command("evaluate", "Scalar-v0", *QUICK, *arguments)
    assert status in (0, 2)
    assert "Traceback" not in err
    if status == 0:
        strictly("out.json")


@pytest.mark.parametrize("suffix", ["pgf", "eps", "ps", "tif", "raw", "svgz", "webp", "gif"])
def test_every_format_is_refused_before_the_run_or_written(safe_envs_command, suffix):
    status, _, _ = safe_envs_command(
        "evaluate", "Scalar-v0", "--filter", "none", *QUICK, "--plot", f"out.{suffix}"
    )
    written = Path(f"out.{suffix}")
    assert (status == 0 and written.stat().st_size > 0) or (status == 2 and not written.exists())


def test_a_failed_picture_leaves_no_part_of_it(safe_envs_command, monkeypatch):
    from matplotlib.figure import Figure

    def fail(self, file, **_):
        file.write(b"half a picture")
        raise OSError("no space left")

    monkeypatch.setattr(Figure, "savefig", fail)
    status, _, err = safe_envs_command("evaluate", "Scalar-v0", *QUICK, "--plot", "out.png")
    assert status == 2
    assert "cannot write out.png: no space left" in err
    assert list(Path().iterdir()) == []
