"""Exported promise filters: built with the C compiler at hand, and held against Python."""

from __future__ import annotations

import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import sympy as sp

from safe_envs import ConfigurationError, ControlAffineSDE, SafetyProblem, define_problem
from safe_envs.errors import NotCompilableError
from safe_envs.export import ExportOptions, PromiseComparison, compare_promise, export_promise
from safe_envs.values.look_ahead import LookAhead
from safe_envs.values.promise_filter import PromiseFilter, PromiseSettings
from safe_envs.values.promise_source import promise_program
from tests.conftest import problem_of
from tests.export.test_export import COMPILERS, NEEDS_COMPILER, STRICT, run_selftest
from tests.values.systems import pursued, s, scalar, solved, u, v, x, y


def planar(noise: float = 0.2) -> SafetyProblem:
    """A point in the plane with two inputs, and no noise or some along one coordinate."""
    system = ControlAffineSDE(
        states=(x, y),
        inputs=(u, v),
        drift=[sp.sin(y), -x / 2],
        input_matrix=[[1, 0], [0, 1 + x**2]],
        diffusion=[[s * (1 + y**2)], [0]],
        parameters={s: noise},
    )
    return define_problem(
        system,
        1 - x**2 - y**2,
        input_bounds=[(-1.0, 1.0), (-0.5, 0.75)],
        start=(0.1, 0.2),
        dt=0.1,
        horizon=0.6,
        workspace={x: (-1.0, 1.0), y: (-1.0, 1.0)},
        name="planar",
        filter="scbf",
    )


def shortened(env: str, **changes: Any) -> SafetyProblem:
    return replace(problem_of(f"safe_envs/{env}-v0"), **changes)


def filter_of(
    problem: SafetyProblem, *cells: int, robust: tuple[Any, ...] = (), **settings: Any
) -> PromiseFilter:
    """A promise filter with a coarse table."""
    asked = PromiseSettings(0.9, robust=robust, leaving=settings.get("leaving", "violation"))
    table = solved(problem, *cells, intervals=asked.intervals, **settings)
    return PromiseFilter(LookAhead(table, problem), asked, problem)


CASES = {
    "noise along one coordinate": lambda: filter_of(scalar(), 60),
    "intervals of a parameter": lambda: filter_of(scalar(), 40, robust=ROBUST),
    "known states": lambda: filter_of(pursued(), 80),
    "the workspace may be left": lambda: filter_of(pursued(), 50, leaving="safe"),
    "two inputs": lambda: filter_of(planar(), 12, 14, inputs=5),
    "no noise": lambda: filter_of(planar(0.0), 20, 21, inputs=5),
    "a frame, and a period": lambda: filter_of(
        shortened("StochasticDubins", horizon=0.5), 20, 16, inputs=9
    ),
    "boxes of noise": lambda: filter_of(shortened("Pendulum", horizon=0.3), 40, 20, inputs=9),
}
ROBUST = (("s", 0.2, 0.4),)


def options_of(promise_filter: PromiseFilter) -> ExportOptions:
    return ExportOptions(region=((-1.0, 1.6),) * promise_filter.problem.plant.n)


def assert_equal(found: PromiseComparison) -> None:
    """Nothing differs but for rounding, and every sort of decision has occurred."""
    assert found.was_made
    assert (found.flags_different, found.beyond, found.out_of_bounds) == (0, 0, 0)
    assert found.largest_error <= 1e-9
    assert found.largest_level_error <= 1e-12
    assert 0 < found.infeasible < found.states + found.steps
    assert 0 < found.replaced < found.states + found.steps
    assert min(found.invalid, found.steps) > 0


QUICK = ("known states", "the workspace may be left", "two inputs", "intervals of a parameter")


@NEEDS_COMPILER
@pytest.mark.parametrize(
    "name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.oracle) for n in CASES]
)
def test_c_decides_as_python_does(name, tmp_path):
    promise_filter = CASES[name]()
    options = options_of(promise_filter)
    export_promise(promise_filter, tmp_path / "c", options=options)
    assert_equal(compare_promise(tmp_path / "c", promise_filter, options, states=1500))


@NEEDS_COMPILER
@pytest.mark.parametrize("compiler", COMPILERS)
def test_the_selftest_compiles_without_warnings_and_passes(compiler, tmp_path):
    promise_filter = filter_of(pursued(), 40)
    export_promise(promise_filter, tmp_path / "c", options=options_of(promise_filter))
    assert "0 differences" in run_selftest(tmp_path / "c", compiler=compiler)


USE = """#include "filter.h"

#include <math.h>
#include <stdio.h>

int main(void)
{
    safety_filter_memory memory = {0};
    safety_filter_input input = {{0.5}, {0}};
    safety_filter_result result;
    for (int i = 0; i < 4; i++) {
        if (i == 1) {
            safety_filter_begin(&memory);
        }
        input.state.x = i == 2 ? (double)NAN : 0.5;
        const int status = safety_filter_decide(&memory, &input, &result);
        printf("%d %d, ", status, result.feasible);
    }
    safety_filter_begin(&memory);
    int last = 0;
    for (int k = 0; k < SAFETY_FILTER_STEPS + 3; k++) {
        safety_filter_decide(&memory, &input, &result);
        last = result.feasible ? k : last;
    }
    printf("%d\\n", last + 1 == SAFETY_FILTER_STEPS);
    return 0;
}
"""


@NEEDS_COMPILER
def test_the_memory_is_begun_anew(tmp_path):
    """One that never was is refused; NaN ends a promise; beyond the horizon there is none."""
    export_promise(filter_of(scalar(), 60), tmp_path / "c")
    (tmp_path / "c" / "use.c").write_text(USE)
    command = [*COMPILERS[0], *STRICT, "filter.c", "use.c", "-lm", "-o", "use"]
    subprocess.run(command, cwd=tmp_path / "c", check=True)
    done = subprocess.run([str(tmp_path / "c" / "use")], capture_output=True, text=True, check=True)
    assert done.stdout == "1 0, 0 1, 2 0, 0 0, 1\n"


def test_files_state_the_promise_and_h(tmp_path):
    export_promise(filter_of(scalar(), 20), tmp_path)
    for name in ("filter.h", "filter.c"):
        head = (tmp_path / name).read_text().split("*/")[0]
        assert "promise:p=0.9 for scalar" in head
        assert "* h = x\n" in head
    assert "| h | `x` |" in (tmp_path / "README.md").read_text()


def test_what_has_no_form_in_c_is_refused(tmp_path):
    promise_filter = filter_of(scalar(), 60)
    with pytest.raises(ConfigurationError, match="double precision"):
        export_promise(promise_filter, tmp_path / "c", float32=True)
    with pytest.raises(ConfigurationError, match="fewer cells, about"):
        promise_program(promise_filter, 1000)
    with pytest.raises(ConfigurationError, match="no name of C"):
        export_promise(promise_filter, tmp_path / "c", options=ExportOptions(name="a b"))
    problem = scalar()
    asked = PromiseSettings(0.9, specification="always safe")
    table = solved(problem, 40, specification="always safe")
    promise_filter = PromiseFilter(LookAhead(table, problem), asked, problem)
    with pytest.raises(NotCompilableError, match="specification"):
        export_promise(promise_filter, tmp_path / "c")
    assert not (tmp_path / "c").exists()


@NEEDS_COMPILER
def test_only_what_the_filter_exports_is_run(tmp_path):
    promise_filter = filter_of(scalar(), 60)
    export_promise(promise_filter, tmp_path / "c")
    source: Path = tmp_path / "c" / "filter.c"
    source.write_text(source.read_text() + "\n/* changed */\n")
    with pytest.raises(ConfigurationError, match="export it again"):
        compare_promise(tmp_path / "c", promise_filter)
