"""The options of an env, which stand once for five commands, and the files that these do not
overwrite."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest
import typer

from safe_envs import ConfigurationError
from safe_envs.scripts.options.console import with_quiet
from safe_envs.scripts.options.env_options import EnvOptions, with_env
from tests.scripts.conftest import strictly
from tests.scripts.own_system import SYSTEM

COMMANDS = {
    "evaluate": (),
    "verify": (),
    "best": ("--episodes", "0"),
    "identify": ("--method", "bayesian", "--out", "out.npz"),
    "train": ("--algo", "ppo", "--out", "run"),
    "render": ("--out", "film.gif"),
}
GIVEN = (
    "--noise=.1,0",
    "--plant=v=.8",
    "--plant=sigma_1=2",
    "--barrier=radius=a b",
    "--dt=0.05",
    "--substeps=2",
    "--input-bounds=-1,2",
    "--start=-1,2,0",
)


def read(*words: str) -> EnvOptions:
    """What a command is handed for the words after its name."""
    found = []

    def command(first: int = 0, *, env: EnvOptions, last: int = 0) -> None:
        assert (first, last) == (3, 4)
        found.append(env)

    app = typer.Typer()
    app.command()(with_quiet(with_env(command)))
    app([*words, "--first", "3", "--last", "4", "--quiet"], standalone_mode=False)
    return found[0]


def test_a_command_is_handed_the_env_that_its_options_ask_for():
    env = read("StochasticDubins-v0", *GIVEN)
    assert (env.env_id, env.system, env.full_id) == (
        "StochasticDubins-v0",
        None,
        "safe_envs/StochasticDubins-v0",
    )
    assert env.arguments == {
        "noise": [0.1, 0.0],
        "plant": {"v": 0.8, "sigma_1": 2},
        "barrier": {"radius": "a b"},
        "dt": 0.05,
        "substeps": 2,
        "input_bounds": [-1.0, 2.0],
        "start": [-1.0, 2.0, 0.0],
    }
    assert read("StochasticDubins-v0").arguments == {}
    # What is 0 was given, and is refused.
    assert read("StochasticDubins-v0", "--delay", "0").arguments == {"delay": 0}
    with pytest.raises(ConfigurationError, match="dt = 0"):
        read("StochasticDubins-v0", "--dt", "0")


@pytest.mark.parametrize(
    "which", [("safe_envs/StochasticDubins-v0",), ("--system", "my folder/own.py:problem")]
)
def test_its_command_line_asks_for_the_same_env(which):
    env = read(*which, *GIVEN)
    words = shlex.split(env.evaluate_command("--policy", "a b"))
    assert words == ["safe-envs", "evaluate", *which, "--policy", "a b", *GIVEN]
    assert read(*which, *words[-len(GIVEN) :]) == env


def test_a_system_of_ones_own_takes_the_place_of_an_id():
    env = read("--system", "own.py:problem", "--horizon", "2")
    assert env.full_id == "safe_envs/Custom-v0"
    assert env.arguments == {"system": "own.py:problem", "horizon": 2.0}
    for words in ((), ("Pendulum-v0", "--system", "own.py:problem")):
        with pytest.raises(
            ConfigurationError, match="name an env by ENV_ID, or a system of your own"
        ):
            read(*words).full_id  # noqa: B018


@pytest.mark.parametrize(
    ("command", "option"),
    [*((command, "--json") for command in COMMANDS), ("verify", "--plot"), ("identify", "--out")],
)
def test_the_file_of_a_system_is_not_overwritten(safe_envs_command, command, option):
    path = Path("own.py")
    path.write_text(SYSTEM)
    status, out, err = safe_envs_command(
        command, "--system own.py:problem", *COMMANDS[command], option, "./own.py"
    )
    assert (status, out) == (2, "")
    assert (
        f"{option} own.py would overwrite the file of --system own.py; name another file"
        in " ".join(err.split())
    )
    assert path.read_text() == SYSTEM
    assert list(Path().iterdir()) == [path]


@pytest.mark.parametrize(
    ("arguments", "file"),
    [
        (("evaluate", "Pendulum-v1", "--filter-spec", "own.py:spec"), "--filter-spec own.py"),
        (
            ("train", "Pendulum-v0", *COMMANDS["train"], "--filter", "ddscbf:file=own.py"),
            "--filter own.py",
        ),
    ],
)
def test_nor_is_another_file_that_is_read(safe_envs_command, arguments, file):
    status, out, err = safe_envs_command(*arguments, "--json own.py")
    assert (status, out) == (2, "")
    assert f"--json own.py would overwrite the file of {file}" in " ".join(err.split())
    assert not Path("own.py").exists()


def test_bounds_are_of_the_horizon_that_is_simulated(safe_envs_command):
    """Which is 7 periods of .3 s where 2 s were asked for."""
    arguments = (
        "Scalar-v0 --filter szcbf:alpha=1 --noise .3 --dt .3 --no-simulate --json found.json"
    )
    status, out, _ = safe_envs_command("verify", arguments, "--horizon 2")
    assert status == 0
    assert "dt = 0.3 s, horizon 2.1 s;" in out
    assert "T = 2.1 s" in out
    found = strictly("found.json")
    assert found["config"]["horizon"] == pytest.approx(2.1)
    assert safe_envs_command("verify", arguments, "--horizon 2.1")[0] == 0
    assert strictly("found.json")["bounds"] == found["bounds"]
    assert any(bound["value"] and not bound["forever"] for bound in found["bounds"])
