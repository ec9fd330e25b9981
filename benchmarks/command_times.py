"""How long commands take that compute nothing: help, the list of envs, and mistakes."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile

_ROUNDS = 3
"""Processes of each command, of which the quickest counts."""

_ENV = ("evaluate", "StochasticDubins-v0")

MISTAKES: tuple[tuple[str, ...], ...] = (
    ("evalute",),
    ("evaluate", "Scalarx"),
    ("evaluate", "CartPole-v1"),
    (*_ENV, "--nois", "1"),
    (*_ENV, "--filter", "hocb"),
    (*_ENV, "--filter", "none,scbf"),
    (*_ENV, "--filter", "hocbf:q=1,1"),
    (*_ENV, "--filter", "hocbf:alpha=1"),
    (*_ENV, "--filter", "cbf"),
    (*_ENV, "--policy", "nominl"),
    (*_ENV, "--policy", "missing.zip"),
    (*_ENV, "--policy", "missing.py:Policy"),
    (*_ENV, "--plant", "vv=1"),
    (*_ENV, "--barrier", "raduis=2"),
    (*_ENV, "--knowledge", "plan"),
    (*_ENV, "--noise", "-1"),
    (*_ENV, "--start", "inwrd"),
    (*_ENV, "--input-bounds", "2,1"),
    (*_ENV, "--episodes", "0"),
    (*_ENV, "--episodes", "many"),
    (*_ENV, "--json", "nowhere/out.json"),
    (*_ENV, "--plot", "out.pong"),
    ("train", "Scalar-v0", "--algo", "dqn"),
    ("identify", "Scalar-v0", "--method", "bayes", "--out", "learned.npz"),
    ("reproduce", "table-4.1"),
)
"""Command lines with a mistake that is often made."""

_WITHOUT_MISTAKE = (("--help",), ("evaluate", "--help"), ("list",))


def measure() -> dict[str, float]:
    """Return the seconds of processor time of each command, and those of Typer and rich alone."""
    commands = {
        "python -c 'import typer, rich', s": ["-c", "import typer, rich"],
        **{
            f"safe-envs {' '.join(words)}, s": ["-m", "safe_envs", *words]
            for words in (*_WITHOUT_MISTAKE, *MISTAKES)
        },
    }
    refused = {f"safe-envs {' '.join(words)}, s" for words in MISTAKES}
    with tempfile.TemporaryDirectory() as folder:
        return {
            name: min(_seconds(arguments, folder, 2 * (name in refused)) for _ in range(_ROUNDS))
            for name, arguments in commands.items()
        }


def _seconds(arguments: list[str], folder: str, status: int) -> float:
    """Return the processor time of a Python process that runs in a folder.

    Raises:
        RuntimeError: It ends with another exit status, so that its time is not that of its work.
    """
    before = os.times()
    done = subprocess.run(
        [sys.executable, *arguments], cwd=folder, capture_output=True, text=True, check=False
    )
    after = os.times()
    if done.returncode != status:
        raise RuntimeError(f"{arguments} ended with {done.returncode}: {done.stderr[-500:]}")
    return (after.children_user + after.children_system) - (
        before.children_user + before.children_system
    )
