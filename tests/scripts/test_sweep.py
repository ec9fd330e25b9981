from __future__ import annotations

import functools
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from safe_envs.agents.sweeps.store import read
from tests.scripts.conftest import strictly

pytestmark = pytest.mark.slow

SPEC = """
fixed: {env: Scalar-v0, episodes: 20, horizon: 0.2}
grid:
  filter: [none, scbf]
  noise: [0.1, 0.3]
  seed: [0, 1]
"""

SYSTEM = """
from safe_envs.registry import make_problem

def problem(first=0, second=0):
    1 / (2 - first - second)
    return make_problem("Scalar-v0", horizon=0.2)
"""


@pytest.fixture
def spec(tmp_path: Path) -> Path:
    path = tmp_path / "sweep.yaml"
    path.write_text(SPEC)
    return path


def test_a_sweep_its_second_run_and_its_report(safe_envs_command, spec: Path, tmp_path: Path):
    status, out, _ = safe_envs_command("sweep", spec, "--out done --jobs 1 --plot rates.svg")
    assert (status, out) == (0, "8 of 8 cells are in done.\nThe picture: rates.svg\n")
    assert "noise" in (tmp_path / "rates.svg").read_text()
    spec.write_text(SPEC.replace("[0, 1]", "[0, 1, 2]"))
    status, out, _ = safe_envs_command("sweep", spec, "--out done --jobs 1")
    assert (status, out) == (0, "12 of 12 cells are in done, of which 8 were there before.\n")

    status, out, _ = safe_envs_command("sweep-report done --worst 2 --json report.json")
    assert status == 0
    assert "12 of 12 cells are done, 0 failed, 0 are missing." in out
    assert (tmp_path / "done" / "report.png").stat().st_size > 10_000
    spec.write_text(SPEC.replace("[0, 1]", "[0]"))
    status, out, _ = safe_envs_command("sweep", spec, "--out done --jobs 1")
    assert (status, out.splitlines()[0]) == (
        0,
        "4 of 4 cells are in done, of which 4 were there before.",
    )
    assert out.splitlines()[1].startswith(
        "Note: 8 cells of another grid or version are in done too"
    )
    spec.write_text(SPEC.replace("[0, 1]", "[0, 1, 2]"))
    assert safe_envs_command("sweep", spec, "--out done --jobs 1")[0] == 0
    report = strictly(tmp_path / "report.json")
    rates = sorted(read(tmp_path / "done")["safety_rate"].to_pylist())
    assert [row["safety_rate"] for row in report["worst"]] == rates[:2]
    assert report["swept"] == ["filter", "noise", "seed"]


def test_a_cell_that_fails_stops_no_other(safe_envs_command, spec: Path, tmp_path: Path):
    (tmp_path / "mine.py").write_text(SYSTEM)
    # Each value works with some other one, so that nothing is found beforehand.
    spec.write_text("""
fixed: {system: "mine.py:problem", filter: scbf, episodes: 20}
grid: {barrier.first: [0, 1], barrier.second: [0, 1], seed: [0, 1]}
""")
    told = (
        r"2 of 8 cells failed; the same command tries them again:\n  seed = 0, barrier\.first = 1,"
        r" barrier\.second = 1: .*division by zero"
    )
    for there in ("", ", of which 6 were there before"):
        status, out, err = safe_envs_command("sweep", spec, "--out done --jobs 1 --json done.json")
        assert (status, out) == (2, f"6 of 8 cells are in done{there}.\n")
        assert re.search(told, err)
        document = strictly(tmp_path / "done.json")
        assert (document["cells"], document["done"], len(document["failed"])) == (8, 6, 2)
        assert document["failed"][1]["settings"]["seed"] == 1
    (tmp_path / "done" / "cells" / f"{read(tmp_path / 'done')['key'][0]}.json").unlink()
    # No cell that is there has this one.
    index = json.loads((tmp_path / "done" / "sweep.json").read_text())
    (tmp_path / "done" / "sweep.json").write_text(
        json.dumps({**index, "swept": [*index["swept"], "dt"]})
    )
    status, out, _ = safe_envs_command("sweep-report done --plot rates.svg")
    assert status == 0
    assert "5 of 8 cells are done, 2 failed, 1 are missing." in out
    assert re.search(
        r"\nFailed:\n  seed = 0, barrier\.first = 1, barrier\.second = 1, dt = -: .*division by"
        r" zero\n",
        out,
    )
    assert "barrier.first" in (tmp_path / "rates.svg").read_text()


def test_mistakes_end_before_anything_is_made(safe_envs_command, spec: Path, tmp_path: Path):
    spec.write_text(SPEC.replace("scbf", "scfb"))
    status, _, err = safe_envs_command("sweep", spec, "--out done")
    assert status == 2
    assert (
        "sweep.yaml, cell filter = scfb, noise = 0.1, seed = 0: unknown filter 'scfb'; did you mean"
        " 'scbf'" in err
    )
    status, _, err = safe_envs_command(
        "sweep", spec, "--out done --backend dask --address tcp://127.0.0.1:1 --jobs 2"
    )
    assert status == 2
    assert "--jobs 2 is of this machine" in err
    assert not (tmp_path / "done").exists()


def test_mistakes_in_a_report(safe_envs_command, spec: Path, tmp_path: Path):
    assert safe_envs_command("sweep-report", tmp_path)[0] == 2
    spec.write_text(
        "fixed: {env: Scalar-v0, episodes: 20, horizon: 0.2}\ngrid: {filter: [none, scbf]}"
    )
    assert safe_envs_command("sweep", spec, "--out done --jobs 1")[0] == 0
    for option in ("--x", "--lines"):
        status, _, err = safe_envs_command("sweep-report done", option, "noise")
        assert status == 2
        assert f"{option} noise: it was not swept; allowed: filter" in err
    status, _, err = safe_envs_command("sweep-report done --plot picture.txt")
    assert status == 2
    assert "unknown format" in err


@pytest.mark.slow
def test_a_stop_keeps_what_is_done_and_leaves_no_process(spec: Path, tmp_path: Path):
    spec.write_text(SPEC.replace("seed: [0, 1]", f"seed: {list(range(100))}"))
    words = [sys.executable, "-m", "safe_envs.scripts.sweep", str(spec), "--jobs", "2"]
    words += ["--out", str(tmp_path / "out")]
    # A shell that runs the tests in the background has its processes ignore the signal.
    heed = functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    process = subprocess.Popen(
        words, stderr=subprocess.PIPE, text=True, start_new_session=True, preexec_fn=heed
    )
    try:
        cells = tmp_path / "out" / "cells"
        while process.poll() is None and not (
            cells.exists() and len(list(cells.glob("[!.]*.json"))) >= 3
        ):
            time.sleep(0.05)
        # As a terminal and a job manager send it: to all of them.
        os.killpg(process.pid, signal.SIGINT)
        _, err = process.communicate(timeout=240)
        assert "Stopped. The same command goes on" in err
        assert process.returncode not in (0, 2)
        assert 3 <= len(read(tmp_path / "out")) < 400
        for _ in range(600):
            if not _is_there(process.pid):
                break
            time.sleep(0.1)
        assert not _is_there(process.pid)
    finally:
        if _is_there(process.pid):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def _is_there(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True
