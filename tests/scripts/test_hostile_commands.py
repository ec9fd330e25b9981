"""Command lines of whoever wants to do harm: status 2 and a short message, at once and without a
traceback."""

from __future__ import annotations

import os

import pytest

pytestmark = pytest.mark.slow

SCALAR = ("evaluate", "Scalar-v0", "--episodes", 2)
TRAIN = ("train", "Scalar-v0", "--algo", "ppo", "--n-timesteps", 64, "--out", "run", "--set")
LONG = "x" * 100_000


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((*SCALAR, "--seed", "1_0"), "--seed = '1_0'; give a whole number"),
        ((*SCALAR, "--seed", "٣"), "--seed = '٣'; give a whole number"),
        ((*SCALAR, "--seed", "9" * 5000), "give a whole number"),
        (("render", "Scalar-v0", "--out", "r.png", "--seed", -1), "--seed = -1; give a whole"),
        ((*SCALAR, "--dt", "1_0"), "--dt = '1_0'; give a number"),
        (("demo", "--episodes", 0), "--episodes = 0; give a whole number from 1"),
        ((*SCALAR, "--noise", "1_0"), "'1_0' is no number"),
        ((*SCALAR, "--noise", "٣"), "'٣' is no number"),
        ((*SCALAR, "--box=-1_0,1"), "is no number"),
        ((*SCALAR, "--plant", "sigma=1_0"), "'1_0' is not a number"),
        ((*SCALAR, "--plant", f"sigma={'9' * 5000}"), "sigma = inf is not finite"),
        ((*SCALAR, "--barrier", "limit=1_0"), "limit = '1_0' is not a number"),
        ((*SCALAR, "--start", "1_0"), "unknown start '1_0'"),
        ((*SCALAR, "--filter", "cbf:alpha=1_0"), "'1_0' is no decimal number"),
        (
            (
                "identify",
                "Scalar-v0",
                "--method",
                "ddscbf",
                "--out",
                "l.npz",
                "--set",
                "points=1_0",
            ),
            "'1_0' is not a number",
        ),
        ((*TRAIN, "n_steps=6_4"), "6_4 is no plain number"),
        ((*TRAIN, f"n_steps={'[' * 3000}"), "nested more than"),
        ((*TRAIN, "n_steps=[&a [1], *a]"), "an alias is not allowed"),
        ((*TRAIN, f"n_steps=[{'? ,' * 30_000}]"), "it has 90002 characters"),
        ((*TRAIN, f"n_steps={'9' * 5000}"), "n_steps = inf; give a whole number"),
        ((*SCALAR, "--filter", LONG), "unknown filter"),
        ((*SCALAR, "--policy", LONG), "unknown policy"),
        ((*SCALAR, "--monitoring", LONG), "monitoring ="),
        ((*SCALAR, "--learned", LONG), "cannot be read: File name too long"),
        ((*SCALAR, "--json", LONG), "File name too long"),
        ((*SCALAR, "--json", "pipe"), "it is a pipe or a device"),
        ((*SCALAR, "--learned", "pipe"), "it is a pipe or a device"),
        ((*SCALAR, "--learned", "loop"), "Too many levels of symbolic links"),
        (("evaluate", LONG), "unknown env"),
        (("evaluate", "--system", f"{LONG}.py:problem"), "File name too long"),
        (("evaluate", "--system", f"{LONG}:problem"), "ended with an error"),
        (("evaluate", "--system", "pipe.py:problem"), "it is a pipe or a device"),
        (("evaluate", "Pendulum-v1", "--filter-spec", "pipe.py:spec"), "it is a pipe or a device"),
        (("sweep", "pipe", "--out", "found"), "it is a pipe or a device"),
        (("sweep-report", "."), "holds no sweep"),
        (("leaderboard", "Scalar-v0", "--out", "."), "holds a leaderboard of an earlier version"),
        (("leaderboard", "Scalar-v0", "--out", "b", "--page", "deep.json"), "needs the line"),
        (("leaderboard", "Scalar-v0", "--out", "b", "--page", "pipe"), "cannot be read"),
    ],
    ids=lambda given: " ".join(map(str, given))[:40] if isinstance(given, tuple) else "",
)
def test_what_no_command_can_take_ends_with_status_2_and_a_short_message(
    safe_envs_command, tmp_path, arguments, message
):
    for name in ("pipe", "pipe.py", "sweep.json"):
        os.mkfifo(tmp_path / name)
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "deep.json").write_text("[" * 100_000)
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "Scalar-v0.json").write_text('{"rows": [{"env_id": "Scalar-v0"}]}')
    status, out, err = safe_envs_command(*arguments)
    assert (status, out) == (2, "")
    assert message in " ".join(err.replace("│", " ").split())
    assert len(err) < 2500
