"""Programs are compiled once, and kept where only their user writes."""

from __future__ import annotations

import logging
import multiprocessing
import os
import stat
import sys
from pathlib import Path

import numpy as np
import pytest

from safe_envs.engine import program
from safe_envs.engine.choice import compiled_or_none, engine_for, periods_of_a_part, require_engine
from safe_envs.engine.formulas import Source
from safe_envs.engine.program import Program
from safe_envs.errors import ConfigurationError, NotCompilableError, SystemDefinitionError
from safe_envs.files import VARIABLE, cache_folder
from tests.engine import kernels

HALF = "def reward_of(values):\n    return 0.5 * values[0]\n"
VALUES = np.array([1.0, 2.0, 4.0])


def small(text: str = HALF) -> Program:
    return Program("a sum", [kernels.total_reward], Source(text))


def result(text: str = HALF) -> float:
    """What the program returns where nothing of it is in memory."""
    program._loaded.cache_clear()
    return small(text).compiled()["total_reward"](VALUES)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(VARIABLE, str(tmp_path / "cache"))
    return tmp_path / "cache" / "compiled"


def test_a_program_holds_what_is_reached_and_nothing_else() -> None:
    text = small().text
    assert all(part in text for part in ("def total_reward", "def scaled", "FACTOR = 2.0"))
    assert not any(part in text for part in ("root", "sqrt", "philox_block"))
    assert small().plain()["total_reward"](VALUES) == 7.0
    text = "def reward_of(values):\n    return root(values[0]) + floor(values[0])\n"
    found = Program("roots", [kernels.total_reward], Source(text, (kernels.root,))).plain()
    assert found["total_reward"](VALUES) == pytest.approx(2.0 * (np.sqrt(VALUES) + VALUES).sum())


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("def another(values):\n    return 0.0\n", "'reward_of'"),
        (HALF + HALF, "generated twice"),
    ],
)
def test_programs_that_do_not_fit_together(text: str, words: str) -> None:
    with pytest.raises(SystemDefinitionError, match=words):
        small(text)


def test_compiled_programs_are_kept_and_a_changed_or_damaged_one_is_compiled_again(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING, "safe_envs"):
        assert result() == 7.0
        assert len(caplog.records) == 1  # which says that it takes its time
        assert stat.S_IMODE(next(folder.iterdir()).stat().st_mode) == 0o700
        assert result() == 7.0
        assert len(caplog.records) == 1
        assert result(HALF.replace("0.5", "1.0")) == 14.0
        assert len(caplog.records) == len(list(folder.iterdir())) == 2
    for pattern, content in (
        ("*/__pycache__/*.nb*", b"damaged"),
        ("*/program.py", b"raise SystemExit"),
    ):
        for kept in folder.glob(pattern):
            kept.write_bytes(content)
        assert result() == 7.0


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="needs rights of files as on Unix")
def test_a_folder_that_others_write_to_or_replace_is_not_used(folder: Path) -> None:
    assert cache_folder("compiled") == folder
    folder.parent.chmod(0o777)
    assert cache_folder("compiled") is None
    folder.parent.chmod(0o1777)
    assert cache_folder("compiled") == folder
    folder.mkdir(parents=True, exist_ok=True)
    folder.chmod(0o777)
    assert cache_folder("compiled") is None
    assert result() == 7.0
    assert not list(folder.iterdir())


def test_without_a_place_to_keep_it_a_program_is_compiled_all_the_same(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise ConfigurationError("no space left on device")

    monkeypatch.setattr(program, "write_atomically", full)
    assert result() == 7.0


def test_a_numba_that_does_not_work_leaves_the_work_to_numpy(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    program._loaded.cache_clear()
    monkeypatch.setattr("numba.core.config.DISABLE_JIT", 1)
    assert compiled_or_none("auto", 1e9, small().compiled) is None
    with pytest.raises(NotCompilableError, match="NUMBA_DISABLE_JIT"):
        compiled_or_none("compiled", 1.0, small().compiled)
    monkeypatch.setitem(sys.modules, "numba.core", None)
    monkeypatch.setattr(program, "is_available", lambda: True)
    with pytest.raises(NotCompilableError, match="imported"):
        small().compiled()


def test_compiled_natives_give_what_plain_ones_give(folder: Path) -> None:
    numbers = [0.1, -3e-46, 1e300, -1e39, np.pi, np.inf]
    natives, results = Program("words", [kernels.words_of], Source("")), []
    for functions in (natives.plain, natives.compiled):
        out, singles = np.zeros(64), np.array(numbers)
        functions()["words_of"](out, singles, np.uint64(2**64 - 3))
        results.append((out, singles))
    for plain, compiled in zip(*results, strict=True):
        np.testing.assert_array_equal(plain, compiled)
    out, singles = results[0]
    assert len(set(out)) == 63
    assert out[3] == out[13]
    with np.errstate(over="ignore"):
        np.testing.assert_array_equal(singles, np.array(numbers, np.float32).astype(float))


def _in_another_process(values: np.ndarray) -> float:
    return small().compiled()["total_reward"](values)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["fork", pytest.param("spawn", marks=pytest.mark.oracle)])
def test_other_processes_use_what_is_kept(folder: Path, method: str) -> None:
    if method not in multiprocessing.get_all_start_methods():
        pytest.skip("not on this system")
    assert result() == 7.0
    with multiprocessing.get_context(method).Pool(2) as pool:
        assert pool.map(_in_another_process, [VALUES, 2.0 * VALUES]) == [7.0, 14.0]


def test_engines_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    def impossible() -> int:
        raise NotCompilableError("the reason")

    for name, work, make, expected in (
        ("numpy", 1e9, lambda: 1, None),
        ("auto", 1e3, lambda: 1, None),
        ("auto", 1e9, lambda: 1, 1),
        ("auto", 1e9, impossible, None),
    ):
        assert compiled_or_none(name, work, make) == expected
    with pytest.raises(NotCompilableError, match="the reason"):
        compiled_or_none("compiled", 1.0, impossible)
    with pytest.raises(ConfigurationError, match="nmpy"):
        require_engine("nmpy")
    monkeypatch.setattr(program.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ConfigurationError, match="Numba"):
        small().compiled()


def test_parts_of_the_work_are_short_for_large_networks() -> None:
    # An interrupt waits for the end of a part. A network of 400 and 300 units takes some 30 us.
    assert periods_of_a_part(1) == periods_of_a_part(100) == 1_000_000
    assert periods_of_a_part(125_000) == 800
    assert periods_of_a_part(10**12) == 1


def test_short_work_is_not_compiled_unless_it_is_asked_for():
    assert [engine_for("auto", periods) for periods in (10, 10**9)] == ["numpy", "auto"]
    assert {engine_for("compiled", periods) for periods in (10, 10**9)} == {"compiled"}
