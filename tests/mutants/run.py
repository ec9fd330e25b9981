#!/usr/bin/env python3
"""Check that the tests notice wrong code: apply each mutant of `mutants.toml` to a copy of the
project, and run tests that must fail.

A mutant names a file, a text that occurs in it once, the text that takes its place, and the tests
that must notice. Exit status: 0 where each mutant was killed, 1 where one survived or could not be
applied, 2 where no mutant has a name that was given.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue

ROOT = Path(__file__).resolve().parents[2]
_TESTS_FAILED = 1
_SECONDS = 300


@dataclass(frozen=True)
class Mutant:
    """A wrong version of the code.

    Attributes:
        name: unique.
        file: path in the project.
        old: text that occurs in the file once.
        new: what takes its place.
        tests: paths of tests of which at least one must fail.
    """

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]


def mutants() -> list[Mutant]:
    """Read the list, in order."""
    with (Path(__file__).parent / "mutants.toml").open("rb") as file:
        return [
            Mutant(m["name"], m["file"], m["old"], m["new"], tuple(m["tests"]))
            for m in tomllib.load(file)["mutant"]
        ]


def verdict(mutant: Mutant, copy: Path) -> str:
    """Apply a mutant to a copy of the project, run its tests there, and undo it.

    Returns:
        "killed", or what went wrong.
    """
    path = copy / mutant.file
    text = path.read_text()
    if text.count(mutant.old) != 1:
        return f"cannot be applied: its text occurs {text.count(mutant.old)} times in {mutant.file}"
    path.write_text(text.replace(mutant.old, mutant.new))
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-x", "-q", *mutant.tests]
    environment = {**os.environ, "PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        status = subprocess.run(
            command, cwd=copy, env=environment, capture_output=True, timeout=_SECONDS, check=False
        ).returncode
    except subprocess.TimeoutExpired:
        return f"no answer in {_SECONDS} s"
    finally:
        path.write_text(text)
    return "killed" if status == _TESTS_FAILED else f"SURVIVED (pytest ended with status {status})"


def copies(folder: Path, count: int) -> SimpleQueue[Path]:
    """Make copies of the files that git knows, as they are in the working tree."""
    known = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
    ready: SimpleQueue[Path] = SimpleQueue()
    for i in range(count):
        for name in filter(None, known.split("\0")):
            if (ROOT / name).exists():
                target = folder / str(i) / name
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / name, target, follow_symlinks=False)
        ready.put(folder / str(i))
    return ready


def run(chosen: Sequence[Mutant], jobs: int) -> bool:
    """Print a line for each mutant; return whether all were killed."""
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(jobs) as pool:
        ready = copies(Path(folder), jobs)

        def judge(mutant: Mutant) -> str:
            copy = ready.get()
            try:
                return verdict(mutant, copy)
            finally:
                ready.put(copy)

        failed = 0
        for mutant, found in zip(chosen, pool.map(judge, chosen), strict=True):
            print(f"{found:8}  {mutant.name}", flush=True)
            failed += found != "killed"
    print(f"{len(chosen) - failed} of {len(chosen)} mutants were killed.")
    return not failed


def main() -> int:
    """Read the command line, run, and return the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument(
        "words",
        nargs="*",
        help="run the mutants whose name holds one of these words; all by default",
    )
    parser.add_argument("--jobs", type=int, default=2, help="processes at a time (default: 2)")
    given = parser.parse_args()
    chosen = [
        m for m in mutants() if not given.words or any(word in m.name for word in given.words)
    ]
    if not chosen:
        print(f"no mutant's name holds {', '.join(given.words)}", file=sys.stderr)
        return 2
    return 0 if run(chosen, max(given.jobs, 1)) else 1


if __name__ == "__main__":
    raise SystemExit(main())
