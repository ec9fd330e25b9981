from __future__ import annotations

import logging
import multiprocessing
import os
import stat
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from safe_envs.engine import program
from safe_envs.engine.choice import compiled_or_none, periods_of_a_part, require_engine
from safe_envs.engine.formulas import Source
from safe_envs.engine.program import Program
from safe_envs.errors import ConfigurationError, NotCompilableError, SystemDefinitionError
from safe_envs.files import VARIABLE, cache_folder
from tests.compiled import kernels, other_kernels

HALF = "def reward_of(values):\n    return 0.5 * values[0]\n"
VALUES = np.array([1.0, 2.0, 4.0])


def small(text: str = HALF) -> Program:
    return Program("a sum", [kernels.total_reward], Source(text))


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(VARIABLE, str(tmp_path / "cache"))
    program._loaded.cache_clear()
    return tmp_path / "cache" / "compiled"


def test_a_program_holds_what_is_reached_and_nothing_else() -> None:
    text = small().text
    assert "def total_reward" in text
    assert "def scaled" in text
    assert "FACTOR = 2.0" in text
    assert "root" not in text
    assert "sqrt" not in text
    assert "philox_block" not in text
    assert text.count("@entry") == 1
    assert small().plain()["total_reward"](VALUES) == 7.0


def test_generated_functions_bring_the_kernels_that_they_use() -> None:
    text = "def reward_of(values):\n    return root(values[0]) + floor(values[0])\n"
    found = Program("roots", [kernels.total_reward], Source(text, (kernels.root,))).plain()
    assert found["total_reward"](VALUES) == pytest.approx(2.0 * (np.sqrt(VALUES) + VALUES).sum())


@pytest.mark.parametrize(
    ("text", "uses", "words"),
    [
        ("def another(values):\n    return 0.0\n", (), "'reward_of', which is missing"),
        (HALF + HALF, (), "generated twice"),
        (HALF, (other_kernels.scaled,), "two kernels are called 'scaled'"),
    ],
)
def test_programs_that_do_not_fit_together(text: str, uses: tuple, words: str) -> None:
    with pytest.raises(SystemDefinitionError, match=words):
        Program("a sum", [kernels.total_reward], Source(text, uses))


def test_compiled_programs_are_kept_and_a_changed_one_is_another(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING, "safe_envs"):
        assert small().compiled()["total_reward"](VALUES) == 7.0
    assert [each.message for each in caplog.records] == [
        "compiling a sum, which takes some seconds once"
    ]
    assert stat.S_IMODE(next(folder.iterdir()).stat().st_mode) == 0o700
    caplog.clear()
    program._loaded.cache_clear()
    found = small().compiled()["total_reward"]
    assert found(VALUES) == found(VALUES) == 7.0
    assert not caplog.records
    assert small(HALF.replace("0.5", "1.0")).compiled()["total_reward"](VALUES) == 14.0
    assert len(list(folder.iterdir())) == 2
    assert len(caplog.records) == 1


def test_a_damaged_program_is_compiled_again(folder: Path) -> None:
    small().compiled()["total_reward"](VALUES)
    for kept in folder.glob("*/__pycache__/*.nb*"):
        kept.write_bytes(b"damaged")
    program._loaded.cache_clear()
    assert small().compiled()["total_reward"](VALUES) == 7.0
    for kept in folder.glob("*/program.py"):
        kept.write_text("raise SystemExit")
    program._loaded.cache_clear()
    assert small().compiled()["total_reward"](VALUES) == 7.0


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="needs rights of files as on Unix")
def test_a_folder_that_others_write_to_is_not_used(folder: Path) -> None:
    folder.mkdir(parents=True)
    folder.chmod(0o777)
    assert cache_folder("compiled") is None
    assert small().compiled()["total_reward"](VALUES) == 7.0
    assert not list(folder.iterdir())


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="needs rights of files as on Unix")
def test_a_folder_that_others_can_replace_is_not_used(folder: Path) -> None:
    assert cache_folder("compiled") == folder
    folder.parent.chmod(0o777)
    assert cache_folder("compiled") is None
    folder.parent.chmod(0o1777)
    assert cache_folder("compiled") == folder


def test_a_folder_that_nothing_can_be_written_to_is_not_needed(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(*_: object) -> None:
        raise ConfigurationError("no space left on device")

    monkeypatch.setattr(program, "write_atomically", full)
    monkeypatch.setattr(program, "_not_kept", lambda text: {"total_reward": np.sum})
    assert small().compiled()["total_reward"](VALUES) == 7.0
    assert [each.message for each in caplog.records] == [
        "compiling a sum; there is no folder of yours to keep it in"
    ]


def test_a_disk_that_gets_full_while_compiling(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def load(_: object) -> dict:
        def full(_: np.ndarray) -> float:
            raise OSError("no space left on device")

        full.stats = SimpleNamespace(cache_path=str(folder))  # pyright: ignore[reportFunctionMemberAccess]
        return {"total_reward": full}

    monkeypatch.setattr(program._KeptProgram, "_load", load)
    monkeypatch.setattr(program, "_not_kept", lambda text: {"total_reward": np.sum})
    assert small().compiled()["total_reward"](VALUES) == 7.0


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
    with pytest.raises(NotCompilableError, match="cannot be imported"):
        small().compiled()


def test_compiled_natives_give_what_plain_ones_give(folder: Path) -> None:
    numbers = [0.1, -3e-46, 1e300, -1e39, np.pi, np.inf]
    results = []
    for functions in (
        (natives := Program("words", [kernels.words_of], Source(""))).plain,
        (natives.compiled),
    ):
        out, singles = np.zeros(64), np.array(numbers)
        functions()["words_of"](out, singles, np.uint64(2**64 - 3))
        results.append((out, singles))
    np.testing.assert_array_equal(results[0][0], results[1][0])
    assert len(set(results[0][0])) == 63
    assert results[0][0][3] == results[0][0][13]
    np.testing.assert_array_equal(results[0][1], results[1][1])
    with np.errstate(over="ignore"):
        np.testing.assert_array_equal(results[0][1], np.array(numbers, np.float32).astype(float))


def _in_another_process(values: np.ndarray) -> float:
    return small().compiled()["total_reward"](values)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_other_processes_use_what_is_kept(folder: Path, method: str) -> None:
    if method not in multiprocessing.get_all_start_methods():
        pytest.skip("not on this system")
    assert _in_another_process(VALUES) == 7.0
    with multiprocessing.get_context(method).Pool(2) as pool:
        assert pool.map(_in_another_process, [VALUES, 2.0 * VALUES]) == [7.0, 14.0]


def test_engines_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    def impossible() -> int:
        raise NotCompilableError("the reason")

    assert compiled_or_none("numpy", 1e9, lambda: 1) is None
    assert compiled_or_none("auto", 1e3, lambda: 1) is None
    assert compiled_or_none("auto", 1e9, lambda: 1) == 1
    assert compiled_or_none("auto", 1e9, impossible) is None
    with pytest.raises(NotCompilableError, match="the reason"):
        compiled_or_none("compiled", 1.0, impossible)
    with pytest.raises(ConfigurationError, match="did you mean 'numpy'"):
        require_engine("nmpy")
    monkeypatch.setattr(program.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ConfigurationError, match=r'needs Numba.*editable "\.\[fast\]"'):
        small().compiled()


def test_parts_of_the_work_are_short_for_large_networks() -> None:
    # An interrupt waits for the end of a part. A network of 400 and 300 units takes some 30 us.
    assert periods_of_a_part(1) == periods_of_a_part(100) == 1_000_000
    assert periods_of_a_part(125_000) == 800
    assert periods_of_a_part(10**12) == 1
