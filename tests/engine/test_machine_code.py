"""Decisions in machine code: those of the interpreted text to the bit, in threads, copies and other
processes, whatever becomes of the cache."""

from __future__ import annotations

import copy
import inspect
import multiprocessing
import os
import pickle
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sympy as sp

from safe_envs import ControlAffineSDE, RelativeDegreeError
from safe_envs.agents.policies.registry import make_policy
from safe_envs.engine import program
from safe_envs.files import VARIABLE
from safe_envs.filters import decisions
from safe_envs.wrappers import SafetyFilter, parse_conditions
from tests.conftest import problem_of
from tests.oracles.filter_cases import CASES, case_of, situations

CONDITIONS = ("cbf", "hocbf:sampling_margin=first-order", "srcbf:form=log", "szcbf", "scbf")


def parts_of(safety_filter: SafetyFilter, states: np.ndarray, inputs: np.ndarray) -> list[Any]:
    """All parts of the decisions for a batch, and for some states alone."""
    found = [*safety_filter.filter(states, inputs)]
    for x, u in zip(states[:20], inputs[:20], strict=True):
        found += safety_filter.filter(x, u)
    return found


def assert_equal(found: list[Any], expected: list[Any]) -> None:
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)


def assert_executions_agree(
    safety_filter: SafetyFilter, states: np.ndarray, inputs: np.ndarray, monkeypatch
) -> None:
    """Interpret a copy, and compile another."""
    found = []
    monkeypatch.setattr(decisions, "_MANY", 1)
    for switch in ("0", "1"):
        monkeypatch.setenv(program.SWITCH, switch)
        found.append(parts_of(copy.deepcopy(safety_filter), states, inputs))
    assert_equal(*found)


def test_every_condition_of_every_id_in_both_executions(env_id: str, monkeypatch) -> None:
    problem = problem_of(env_id)
    for text in CONDITIONS:
        with suppress(RelativeDegreeError):
            made = SafetyFilter.for_problem(problem, parse_conditions(text, problem))
            assert_executions_agree(made, *situations(problem, 60), monkeypatch)


@pytest.mark.parametrize("name", CASES)
def test_everything_that_a_filter_may_have_in_both_executions(name: str, monkeypatch) -> None:
    safety_filter, states, inputs = case_of(name)
    assert_executions_agree(safety_filter, states[:60], inputs[:60], monkeypatch)


def test_a_goal_without_barriers_in_both_executions(monkeypatch) -> None:
    problem, found = problem_of("safe_envs/CubicSDE-v0"), []
    seen = np.random.default_rng(0).uniform(-1.0, 1.0, (30, len(problem.features)))
    monkeypatch.setattr(decisions, "_MANY", 1)
    for switch in ("0", "1"):
        monkeypatch.setenv(program.SWITCH, switch)
        policy = make_policy("clf", problem)
        found.append([policy.predict(given)[0] for given in (seen, *seen)])
    assert_equal(*found)
    assert len(np.unique(found[0][0])) > 2


def test_threads_decide_as_one_does() -> None:
    for name in ("plane", "minimum"):
        safety_filter, states, inputs = case_of(name)
        expected = parts_of(safety_filter, states, inputs)
        with ThreadPoolExecutor(8) as pool:
            calls = [pool.submit(parts_of, safety_filter, states, inputs) for _ in range(24)]
            for call in calls:
                assert_equal(call.result(), expected)


@pytest.mark.parametrize("copied", [lambda f: pickle.loads(pickle.dumps(f)), copy.deepcopy])
def test_a_copy_of_a_filter_that_has_decided_often_takes_machine_code_as_it_did(
    copied, monkeypatch
) -> None:
    asked = []
    monkeypatch.setattr(decisions, "_FEW", 10)
    monkeypatch.setattr(decisions, "decider", lambda **given: asked.append(given))
    x, u = sp.symbols("x u", real=True)
    made = SafetyFilter(ControlAffineSDE((x,), (u,), [0], [1]), [1 - x], "cbf", (-1, 1))
    for given in (made, copied(made)):
        for _ in range(3):
            given.filter(np.full((5, 1), 0.5), np.ones((5, 1)))
    assert asked == [{"compiling": False}] * 2


def _in_another_process(given: Any) -> list[Any]:
    return parts_of(*given)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["fork", pytest.param("spawn", marks=pytest.mark.oracle)])
def test_other_processes_decide_alike(method: str) -> None:
    if method not in multiprocessing.get_all_start_methods():
        pytest.skip("not on this system")
    given = case_of("plane")
    expected = parts_of(*given)
    with multiprocessing.get_context(method).Pool(2) as pool:
        for found in pool.map(_in_another_process, [given] * 2):
            assert_equal(found, expected)


def test_what_counts_of_the_text_is_noticed(monkeypatch) -> None:
    read, caches = inspect.getsource, (program._parsed, program._kernel, program._decide_text)

    def folder_after(old: str, new: str) -> str:
        def changed(module: Any) -> str:
            return read(module).replace(old, new)

        with monkeypatch.context() as patched:
            patched.setattr(program.inspect, "getsource", changed)
            for each in caches:
                each.cache_clear()
            return program._decide_text()[1]

    try:
        plain = folder_after("", "")
        assert folder_after("Orthonormalise the free entries", "Take the free entries") == plain
        assert folder_after("DEPENDENT = 1e-14", "DEPENDENT = 1e-13") != plain
        assert folder_after("for _ in range(2 if size > 0 else 0):", "for _ in range(2):") != plain
        assert folder_after("ROUNDS = 12", "ROUNDS = 13") != plain
        monkeypatch.setattr(program, "package_version", lambda name: "another")
        assert folder_after("", "") != plain
    finally:
        for each in caches:
            each.cache_clear()


# In a process of its own: it replaces the decisions of the process by others that compile fast.
_CACHES = """
import logging, os, pathlib
from concurrent.futures import ThreadPoolExecutor
from safe_envs.engine import program
from safe_envs.errors import ConfigurationError

said, folder = [], pathlib.Path(os.environ["SAFE_ENVS_CACHE"])
elsewhere = pathlib.Path(os.environ.get("NUMBA_CACHE_DIR", folder))
logging.getLogger("safe_envs").addFilter(lambda record: said.append(record.getMessage()))
TEXT = '''
@c_entry
def project_rows(k, m, rows, proposed, ends, weights, out, work):
    return 0

@part
def inner(x):
    return x + ANSWER

@c_entry
def decide_columns(numbers):
    return inner(project_rows(1, 1, *[floats_at(0) for _ in range(6)]))
'''.replace("*[floats_at(0) for _ in range(6)]", ", ".join(["floats_at(0)"] * 6))


def result(answer, digit="0"):
    for each in (program.register_decide, program._decider):
        each.cache_clear()
    text = TEXT.replace("ANSWER", answer)
    program._decide_text = lambda: (text, digit * 32)
    before, found = len(said), program.decider()
    return found and (found.one(None), found.many(None)), said[before:]


assert program.decider(compiling=False) is None
value, words = result("7")
assert value == (7, 7) and len(words) == 1 and "once for this machine" in words[0], words
assert program.decider(compiling=False) is not None
assert result("7") == ((7, 7), [])
assert result("8", "1")[0] == (8, 8)
for ending in ("nbi", "nbc"):
    damaged = [*elsewhere.rglob(f"*.{ending}")]
    assert damaged
    for kept in damaged:
        kept.write_bytes(b"damaged")
    value, words = result("7")
    assert value == (7, 7) and len(words) == 1, (ending, words)
    assert result("7") == ((7, 7), [])

for each in (program.register_decide, program._decider):
    each.cache_clear()
program._decide_text = lambda: (TEXT.replace("ANSWER", "6"), "6" * 32)
with ThreadPoolExecutor(4) as pool:
    assert [*pool.map(lambda _: program.decider().one(None), range(4))] == [6] * 4


def full(*_):
    raise ConfigurationError("no space left on device")


write, program.write_atomically = program.write_atomically, full
value, words = result("9", "2")
assert value == (9, 9) and "no folder of yours" in words[-1], words
program.write_atomically = write
os.environ["SAFE_ENVS_CACHE"] = ""
value, words = result("5", "3")
assert value == (5, 5) and len(words) == 1 and "no folder of yours" in words[0], words
value, words = result("unknown", "4")
assert value is None and "plain Python" in words[-1], words
"""


@pytest.mark.slow
@pytest.mark.parametrize("elsewhere", [False, pytest.param(True, marks=pytest.mark.oracle)])
def test_whatever_becomes_of_the_cache(tmp_path: Path, elsewhere: bool) -> None:
    own = {VARIABLE: str(tmp_path / "own")}
    if elsewhere:
        own["NUMBA_CACHE_DIR"] = str(tmp_path / "elsewhere")
    command = [sys.executable, "-c", _CACHES]
    done = subprocess.run(command, capture_output=True, env=os.environ | own, check=False)
    assert not done.returncode, done.stderr.decode()


_DECIDE = """
import logging
from tests.oracles.filter_cases import case_of
print(case_of("plane")[0].filter([0.9, 0.9, 0.1], [1.0, 0.5]).action.tolist())
"""


@pytest.mark.oracle
def test_two_processes_may_compile_at_once_and_a_third_reads(tmp_path: Path) -> None:
    def begin(folder: str) -> subprocess.Popen[str]:
        own = {VARIABLE: folder}
        given: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        root = Path(__file__).parents[2]
        return subprocess.Popen(
            [sys.executable, "-c", _DECIDE], env=os.environ | own, cwd=root, **given
        )

    expected = case_of("plane")[0].filter([0.9, 0.9, 0.1], [1.0, 0.5]).action.tolist()
    both = [begin(str(tmp_path)) for _ in range(2)]
    for each in both:
        out, said = each.communicate()
        assert out.strip() == str(expected), said
        assert "compiling" in said
    read = tmp_path / "compiled"
    for folder, compiles in ((str(tmp_path), False), ("", True)):
        out, said = begin(folder).communicate()
        assert out.strip() == str(expected), said
        assert ("compiling" in said) is compiles
    assert len([*read.iterdir()]) == 1
