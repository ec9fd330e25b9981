"""What the commands and envs compute, beside stored rows.

Each case is a file in `rows`, with what its command lines wrote by --json, less times, versions,
checksums and paths. Whole numbers and texts are compared exactly, floats to a relative 1e-9.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
import sys
import tempfile
import traceback
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from PIL import Image

from safe_envs.scripts.cli import main as safe_envs_main
from tests.golden.cases import SYSTEMS, cases
from tests.golden.environments import rows
from thesis.__main__ import main as thesis_main

ROOT = Path(__file__).resolve().parents[2]
ROWS = Path(__file__).parent / "rows"
_TOLERANCE = 1e-9
_LONGEST = 24
"""Numbers of an array that are stored; of a longer one its ends and sums are."""

_LEFT_OUT = (
    "versions",
    "timing",
    "seconds",
    "learning_seconds",
    "minutes",
    "steps_per_second",
    "sha256",
    "key",
)


def names() -> list[str]:
    """Return the names of all cases."""
    return [*cases(), *(f"env/{env_id}" for env_id in SYSTEMS)]


def compute(name: str) -> Any:
    """Run a case in a temporary folder.

    Returns:
        What it found, as JSON has it; the key "error" with the traceback where the case itself
        broke.
    """
    try:
        with (
            warnings.catch_warnings(),
            tempfile.TemporaryDirectory() as folder,
            contextlib.chdir(folder),
        ):
            warnings.simplefilter("ignore")
            kind, _, subject = name.partition("/")
            if kind == "env":
                return _kept(rows(subject, SYSTEMS[subject].filter, SYSTEMS[subject].dt), folder)
            case = cases()[name]
            for file, text in case.files.items():
                Path(file).write_text(text)
            return {
                line: _kept(_document(arguments), folder)
                for line, arguments in case.arguments(str(ROOT))
            }
    except Exception:
        return {"error": traceback.format_exc()}


def _document(arguments: list[str]) -> Any:
    """Run a command in this process; return what it wrote by --json.

    Raises:
        RuntimeError: it refused.
    """
    out, err = io.StringIO(), io.StringIO()
    of_thesis = arguments[0] == "thesis"
    words = arguments if of_thesis else ["safe-envs", *arguments]
    argv = [*words, "--quiet", "--json", "golden.json"]
    with (
        mock.patch.object(sys, "argv", argv),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        try:
            thesis_main() if of_thesis else safe_envs_main()
            status: Any = 0
        except SystemExit as ended:
            status = ended.code
    if status:
        raise RuntimeError(f"{' '.join(arguments)}: exit status {status}, {err.getvalue()}")
    path = Path("golden.json")
    found = json.loads(path.read_text())
    path.unlink()
    if "still.png" in arguments:
        found["still"] = _blocks(Path("still.png"))
    return found


def _blocks(path: Path) -> list[list[int]]:
    """Return the mean colours of a picture in 8 columns and 4 rows, which letters hardly change."""
    pixels = np.asarray(Image.open(path).convert("RGB"), dtype=float)
    parts = [block for row in np.array_split(pixels, 4) for block in np.array_split(row, 8, axis=1)]
    return [np.rint(block.mean(axis=(0, 1))).astype(int).tolist() for block in parts]


def _kept(value: Any, folder: str) -> Any:
    """Return a value without what differs from run to run, and with long arrays shortened."""
    if isinstance(value, dict):
        return {key: _kept(entry, folder) for key, entry in value.items() if key not in _LEFT_OUT}
    if isinstance(value, str):
        return (
            value.replace(os.path.realpath(folder), "FOLDER")
            .replace(folder, "FOLDER")
            .replace(str(ROOT), "ROOT")
        )
    if not isinstance(value, list):
        return value
    numbers = _flat(value)
    if numbers is None or len(numbers) <= _LONGEST:
        return [_kept(entry, folder) for entry in value]
    known = [(i + 1, float(number)) for i, number in enumerate(numbers) if number is not None]
    # Sums of one sign: what rounds differently does not cancel.
    return {
        "length": len(value),
        "numbers": len(numbers),
        "without value": len(numbers) - len(known),
        "first": numbers[:4],
        "last": numbers[-4:],
        "positive": math.fsum(max(x, 0.0) for _, x in known),
        "negative": math.fsum(max(-x, 0.0) for _, x in known),
        "positive by place": math.fsum(i * max(x, 0.0) for i, x in known),
        "negative by place": math.fsum(i * max(-x, 0.0) for i, x in known),
    }


def _flat(value: list[Any]) -> list[Any] | None:
    """Return the numbers in lists of lists; None if there is something else."""
    found: list[Any] = []
    for entry in value:
        if isinstance(entry, list):
            inner = _flat(entry)
            if inner is None:
                return None
            found += inner
        elif entry is None or isinstance(entry, (bool, int, float)):
            found.append(entry)
        else:
            return None
    return found


def differences(stored: Any, got: Any, path: str = "$") -> Iterator[str]:
    """Yield where two JSON values differ: path, what is stored, what was got."""
    if isinstance(stored, dict) and isinstance(got, dict):
        for key in sorted(stored.keys() | got.keys()):
            if key not in got:
                yield f"{path}.{key}: stored {_short(stored[key])}, got nothing"
            elif key not in stored:
                yield f"{path}.{key}: not stored, got {_short(got[key])}"
            else:
                yield from differences(stored[key], got[key], f"{path}.{key}")
    elif isinstance(stored, list) and isinstance(got, list) and len(stored) == len(got):
        for i, (first, second) in enumerate(zip(stored, got, strict=True)):
            yield from differences(first, second, f"{path}[{i}]")
    elif not _same(stored, got):
        yield f"{path}: stored {_short(stored)}, got {_short(got)}"


def _same(stored: Any, got: Any) -> bool:
    if type(stored) is not type(got):
        return False
    if isinstance(stored, float):
        return math.isclose(stored, got, rel_tol=_TOLERANCE) or (
            math.isnan(stored) and math.isnan(got)
        )
    return stored == got


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) < 200 else f"{text[:200]}..."


def text_of(value: Any, indent: int = 0) -> str:
    """Return JSON with sorted keys, indented by 1, and lists of plain values on one line."""
    if isinstance(value, dict) and value:
        entries = (f"{json.dumps(key)}: {text_of(value[key], indent + 1)}" for key in sorted(value))
    elif isinstance(value, list) and any(isinstance(entry, (list, dict)) for entry in value):
        entries = (text_of(entry, indent + 1) for entry in value)
    else:
        return json.dumps(value)
    first, last = "{}" if isinstance(value, dict) else "[]"
    inner = "\n" + " " * (indent + 1)
    return f"{first}{inner}{f',{inner}'.join(entries)}\n{' ' * indent}{last}"


def compared(name: str, found: Any) -> list[str]:
    """Return how what a case found differs from what is stored."""
    file = ROWS / f"{name}.json"
    if "error" in found:
        return [f"broke\n{found['error']}"]
    if not file.is_file():
        return ["nothing is stored; `make golden ARGS=--write` stores it"]
    return list(differences(json.loads(file.read_text()), json.loads(json.dumps(found))))


def store(name: str, found: Any) -> None:
    """Store what a case found."""
    file = ROWS / f"{name}.json"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text_of(found) + "\n")
