"""Exported filters: built with the C compiler at hand, and held against Python."""

from __future__ import annotations

import math
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sympy as sp

from safe_envs import Barrier, ConfigurationError, ControlAffineSDE
from safe_envs.errors import NotCompilableError
from safe_envs.export import CComparison, ExportOptions, compare, export_filter
from safe_envs.export.comparison import c_compiler
from safe_envs.filters.conditions.bayesian import BayesianSCBF
from safe_envs.filters.conditions.learned import DDSCBF, LearnedHOCBF
from safe_envs.problem.clf import CLF
from safe_envs.problem.signals import TIME
from safe_envs.wrappers import CBF, DelayedFilter, SafetyFilter, parse_conditions
from tests.conftest import problem_of
from tests.oracles.filter_cases import CASES, Corrected, case_of, integrators
from tests.wrappers.learned import Terms

COMPILER = c_compiler()
COMPILERS = [[name] for name in ("gcc", "clang") if shutil.which(name)] or [COMPILER or []]
NEEDS_COMPILER = pytest.mark.skipif(COMPILER is None, reason="there is no C compiler")
WARNINGS = ("-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wdouble-promotion", "-Werror")
STRICT = ("-std=c99", "-O1", "-ffp-contract=off", *WARNINGS)
SANITIZED = ("-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
x, y, u, w, p, rate = sp.symbols("x y u w p rate", real=True)
mass, drag = sp.symbols("mass drag", positive=True)


def filter_of(env_id: str, condition: str) -> tuple[SafetyFilter, ExportOptions]:
    """The filter of an env, and where its states are drawn."""
    problem = problem_of(f"safe_envs/{env_id}-v0")
    found = SafetyFilter.for_problem(problem, parse_conditions(condition, problem))
    units = {v.symbol.name: v.unit for v in (*problem.states, *problem.inputs)}
    return found, ExportOptions(units=units, region=problem.sampling_domain.region)


def cart(**options: Any) -> SafetyFilter:
    """A cart of measured mass that is to stay behind something that moves, and before a line."""
    system = ControlAffineSDE(
        (x, y),
        (u,),
        [y, -drag * y],
        [0, 1 / mass],
        [0, sp.Rational(1, 10)],
        parameters={drag: 0.3},
        signals={p: rate, rate: 0, mass: 0},
    )
    barriers = [p - x, 4 + TIME / 10 - x]
    return SafetyFilter(system, barriers, "hocbf:alpha=2,8", **{"input_bounds": (-5, 5), **options})


def run_selftest(directory: Path, *flags: str, compiler: Sequence[str] = COMPILER or ()) -> str:
    """Build the self-test without warnings, run it, and return what it prints."""
    program = directory / "selftest"
    files = ("filter.c", "selftest.c")
    command = [*compiler, *STRICT, *flags, *files, "-o", str(program), "-lm"]
    built = subprocess.run(command, cwd=directory, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr[:2000]
    done = subprocess.run([str(program)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, (done.stdout + done.stderr)[:2000]
    return done.stdout


def run_hostile(directory: Path, *flags: str, number: str = "double") -> None:
    """Decide at tiny, huge and undefined numbers, and look at all actions."""
    program, source = directory / "hostile", Path(__file__).with_name("hostile.c")
    command = [*(COMPILER or ()), "-std=c99", *flags, f"-DNUMBER={number}", "-I."]
    built = [*command, str(source), "filter.c", "-o", str(program), "-lm"]
    subprocess.run(built, cwd=directory, check=True)
    done = subprocess.run([str(program)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, (done.stdout + done.stderr)[:2000]


def assert_equal(found: CComparison, error: float = 1e-11) -> None:
    """Flags are equal but where they hang on rounding, and actions but for rounding."""
    assert found.was_made
    assert found.flags_different == found.flags_close <= found.states // 500
    assert found.out_of_bounds == 0
    assert found.largest_error <= error


@NEEDS_COMPILER
@pytest.mark.parametrize("name", ["goal of several", "planes above"])
def test_what_a_filter_may_have(name: str, tmp_path: Path) -> None:
    safety_filter = case_of(name)[0]
    options = ExportOptions(region=((-2.5, 2.5),) * safety_filter.model.n)
    export_filter(safety_filter, tmp_path, options=options)
    found = compare(tmp_path, safety_filter, options, states=1000)
    assert_equal(found)
    assert found.infeasible > 0
    assert found.without_effect > 0
    assert found.invalid > 0
    assert "0 differences" in run_selftest(tmp_path)
    run_hostile(tmp_path, *SANITIZED)


@NEEDS_COMPILER
@pytest.mark.parametrize("bounds", [(-5, 5), (-5, math.inf)])
def test_signals_parameters_time_and_bounds_at_run_time(bounds: Any, tmp_path: Path) -> None:
    safety_filter = cart(adjustable=["drag"], input_bounds=bounds)
    interface = export_filter(safety_filter, tmp_path)
    assert [q.name for q in interface.runtime] == ["p", "rate", "mass", "drag", "t"]
    assert_equal(compare(tmp_path, safety_filter, states=3000))
    assert "0 differences" in run_selftest(tmp_path)
    header = (tmp_path / "filter.h").read_text()
    assert "double mass; /* mass, positive */" in header
    assert "double t; /* t, in s, nonnegative */" in header
    assert "input->runtime.drag = 0.3;" in (tmp_path / "filter.c").read_text()


def test_files_state_the_whole_filter(tmp_path: Path) -> None:
    system = ControlAffineSDE.from_rate((x, y), (u,), [y, u - y], signals={p: 0})
    barriers = [Barrier(sp.Float(0.1) - x + sp.Abs(p), "wall"), Barrier(4 - y, "speed | limit")]
    conditions = "hocbf:alpha=2,8:sampling_margin=0.5+cbf:alpha=3"
    goal = CLF(x**2 + y**2, rate=1.0)
    export_filter(SafetyFilter(system, barriers, conditions, (-5, 5), clf=goal), tmp_path)
    title = "hocbf:alpha=2.0,8.0:sampling_margin=0.5 for wall; cbf:alpha=3.0 for speed | limit"
    for name in ("filter.h", "filter.c"):
        head = " ".join((tmp_path / name).read_text().split("*/")[0].split())
        for line in (f"{title};", "goal V = x**2 + y**2", "* wall = -x + Abs(p) + 0.1 *"):
            assert line in head
    # What would end a cell of a table is escaped.
    assert "| speed \\| limit | `4 - y` |" in (tmp_path / "README.md").read_text()


@pytest.mark.parametrize(
    ("text", "estimator"),
    [("scbf", "ekf:process_noise=0.1"), ("scbf:belief=0.1", "ekf"), ("scbf:belief=0.1", None)],
)
def test_no_estimator_is_dropped(text: str, estimator: str | None, tmp_path: Path) -> None:
    problem = problem_of("safe_envs/Pendulum-v0", measurement="default")
    safety_filter = SafetyFilter.for_problem(problem, text, estimator=estimator)
    with pytest.raises(NotCompilableError, match="estimators and beliefs"):
        export_filter(safety_filter, tmp_path)
    assert not list(tmp_path.iterdir())
    with pytest.raises(ConfigurationError, match=estimator or "belief"):
        DelayedFilter(safety_filter, 1, 0.01)


@NEEDS_COMPILER
def test_the_cause_where_no_input_changes_what_is_unmet(tmp_path: Path) -> None:
    system = ControlAffineSDE((x, y), (u, w), [0, 0], [[1, 0], [0, 1]], [0, 0])
    safety_filter = SafetyFilter(system, [9 + y, -1 - x**2, -2 - x**2], "cbf", (-1, 1))
    options = ExportOptions(region=((-1.0, 1.0), (-9.0, 0.0)))
    export_filter(safety_filter, tmp_path, options=options)
    found = compare(tmp_path, safety_filter, options, states=2000)
    assert_equal(found)
    assert found.without_effect > 0


@NEEDS_COMPILER
def test_single_precision(tmp_path: Path) -> None:
    safety_filter, options = filter_of("StochasticDubins", "scbf")
    export_filter(safety_filter, tmp_path, float32=True, options=options)
    assert "double" not in (tmp_path / "filter.c").read_text().replace("-fp", "")
    assert_equal(compare(tmp_path, safety_filter, options, states=20_000), error=1e-5)
    assert "0 differences" in run_selftest(tmp_path)


@NEEDS_COMPILER
def test_plain_floats_to_the_bit(tmp_path: Path) -> None:
    # C has the operations of one state, and batches those of another order.
    safety_filter = case_of("one sampled")[0]
    export_filter(safety_filter, tmp_path)
    assert compare(tmp_path, safety_filter, states=2000).largest_error <= 1e-14


@NEEDS_COMPILER
@pytest.mark.parametrize(
    ("problem", "learned", "condition"),
    [
        ("disk", "residual", LearnedHOCBF),
        ("top", "network", DDSCBF),
        pytest.param("gap", "diffusion", DDSCBF, marks=pytest.mark.oracle),
        pytest.param("cubic", "posterior", BayesianSCBF, marks=pytest.mark.oracle),
    ],
)
def test_learned_filters(
    problem: str, learned: str, condition: Any, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    tried, model = request.getfixturevalue(problem), request.getfixturevalue(learned)
    settings = {"confidence": 0.9} if condition is BayesianSCBF else {}
    found = condition.from_learned(model, tried.gains_of(0), **settings)
    safety_filter = SafetyFilter.for_problem(tried, found)
    options = ExportOptions(region=tried.sampling_domain.region)
    export_filter(safety_filter, tmp_path, options=options)
    # A matrix product of NumPy adds in another order.
    assert_equal(compare(tmp_path, safety_filter, options, states=3000), error=1e-6)
    assert "0 differences" in run_selftest(tmp_path)


def test_filters_of_other_kinds_are_refused(tmp_path: Path) -> None:
    with pytest.raises(NotCompilableError, match="DelayedFilter has no form in C"):
        export_filter(DelayedFilter(cart(), 1, 0.01), tmp_path)  # pyright: ignore[reportArgumentType]


def test_learned_terms_without_a_compiled_form_are_refused(tmp_path: Path) -> None:
    system = integrators(1)
    learned = Terms(system, 1, [1 + x**2, x])
    safety_filter = SafetyFilter(
        system, [(2 - x**2, Corrected(1.0, learned=learned))], None, (-1, 1)
    )
    with pytest.raises(NotCompilableError, match="no compiled form"):
        export_filter(safety_filter, tmp_path)
    assert not list(tmp_path.iterdir())


@NEEDS_COMPILER
def test_names_of_users_neither_clash_nor_end_comments(tmp_path: Path) -> None:
    names = ["double", "far", "x0", "*/ int main", "a b", "a-b", "1st", "vector", "größe"]
    states = tuple(sp.Symbol(n, real=True) for n in names)
    system = ControlAffineSDE(states, (u,), [0] * 9, [1] * 9, [0] * 9)
    safety_filter = SafetyFilter(system, [1 - sum(s**2 for s in states)], CBF(1.0), (-1, 1))
    export_filter(safety_filter, tmp_path, options=ExportOptions(units={"far": "*/ m"}))
    assert_equal(compare(tmp_path, safety_filter, ExportOptions(units={"far": "*/ m"}), states=500))
    assert "0 differences" in run_selftest(tmp_path)


PIECES = sp.Piecewise((x**2, x < 0), (sp.sqrt(1 + x), x < 1), (2, True))
FORMULAS = {
    "remainders": sp.Mod(x, 2) + sp.Mod(3 * y, -1.5) + sp.frac(x * y),
    "steps": sp.floor(3 * x) - sp.ceiling(2 * y) / 3 + sp.sign(x - y) * x,
    "conditions": sp.Piecewise((x, (x > 1) & (y > 0) | (x < y)), (y**2, sp.Ne(y, x)), (1, True)),
    "pieces": PIECES + sp.Max(x, y, -x) - sp.Min(x * y, 1) + sp.Heaviside(x),
    "powers": x**9 + sp.cbrt(1 + x**2) + (1 + y**2) ** sp.Rational(-5, 2) + 2**y / 3 + x**-2,
    "roots": 1 / sp.sqrt(1 + x**2) + sp.sqrt(2 + y) ** 3 - sp.log(3 + x, 2) + sp.coth(3 + y),
    "functions": sp.tanh(x) + sp.atan2(y, x) + sp.exp(-(y**2)) * sp.erf(x) + sp.log(2 + y**2),
    "signs": -(-x - (y - (x - 1))) / (2 - -sp.Abs(y)) - sp.Rational(1, 3) * x / 7,
}


@NEEDS_COMPILER
@pytest.mark.parametrize("name", FORMULAS)
def test_formulas(name: str, tmp_path: Path) -> None:
    system = ControlAffineSDE((x, y), (u,), [FORMULAS[name], -y], [1 + x**2, 0], [0, 0])
    safety_filter = SafetyFilter(system, [2 - x - y / 2], CBF(1.0), (-5, 5))
    export_filter(safety_filter, tmp_path)
    found = compare(tmp_path, safety_filter, states=3000)
    assert_equal(found, error=1e-12)
    assert found.infeasible > 0


@NEEDS_COMPILER
def test_minima_and_maxima(tmp_path: Path) -> None:
    system = ControlAffineSDE((x, y), (u, w), [-y / 5, x / 10], [[1, 0], [0, 1]])
    disks = sp.Max(1 - (x - 0.9) ** 2 - y**2, 1 - (x + 0.9) ** 2 - y**2, -1 - x)
    barriers = [sp.Min(disks, 2 - sp.Abs(x)), 3 - x - y]
    safety_filter = SafetyFilter(system, barriers, CBF(1.0), (-5, 5))
    interface = export_filter(safety_filter, tmp_path)
    assert interface.barriers == ("h_1_1", "h_1_2", "h_1_3", "h_2")
    found = compare(tmp_path, safety_filter, states=3000)
    assert_equal(found)
    assert found.infeasible > 0
    assert "0 differences" in run_selftest(tmp_path)


NOWHERE_FINITE = ControlAffineSDE((x,), (u,), [sp.log(x)], [1 / (x - 1)], [0])
DOUBLE = ControlAffineSDE.from_rate((x, y), (u,), [y, u])
ROOTS = [sp.sqrt(2 - x) - y, sp.log(4 - y)]
UNDEFINED = {
    "a cube root": (DOUBLE, [2 - sp.cbrt(y)], "cbf", None, "infeasible"),
    "a constraint": (NOWHERE_FINITE, [2 - x], CBF(1.0), None, "invalid"),
    "a barrier": (DOUBLE, ROOTS, ["rcbf", "cbf:alpha=2"], ((-3.0, 5.0), (-3.0, 6.0)), "infeasible"),
}


@NEEDS_COMPILER
@pytest.mark.parametrize("name", UNDEFINED)
def test_states_without_a_value(name: str, tmp_path: Path) -> None:
    system, barriers, conditions, region, flagged = UNDEFINED[name]
    safety_filter = SafetyFilter(system, barriers, conditions, (-5, 5))
    options = ExportOptions(region=region) if region else ExportOptions()
    export_filter(safety_filter, tmp_path, options=options)
    found = compare(tmp_path, safety_filter, options, states=1000)
    assert_equal(found)
    assert getattr(found, flagged) > 300
    assert "0 differences" in run_selftest(tmp_path)


@NEEDS_COMPILER
def test_what_compilers_refuse_and_what_they_may_take(tmp_path: Path) -> None:
    assert COMPILER is not None
    export_filter(cart(), tmp_path)

    def compiled(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [*COMPILER, "-std=c99", *arguments, "-c", "-o", "filter.o"]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)

    quick = compiled("-ffast-math", "filter.c")
    assert quick.returncode != 0
    assert "-ffast-math" in quick.stderr
    # Builds that take every file of a folder give it to the compiler, too.
    assert compiled(*WARNINGS, "filter_core.c").returncode == 0


def test_without_a_compiler_the_files_are_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    export_filter(cart(), tmp_path / "new")
    assert {f.name for f in (tmp_path / "new").iterdir()} == {
        *("filter.h", "filter.c", "filter_core.c", "selftest.c", "CMakeLists.txt", "README.md")
    }
    assert not compare(tmp_path / "new", cart(), states=10).was_made


def test_files_of_others_are_neither_overwritten_nor_run(tmp_path: Path) -> None:
    (tmp_path / "README.md").write_text("mine")
    with pytest.raises(ConfigurationError, match=r"holds README\.md"):
        export_filter(cart(), tmp_path)
    assert [f.name for f in tmp_path.iterdir()] == ["README.md"]
    (tmp_path / "README.md").unlink()
    for _ in range(2):  # what an export has written, another one replaces
        export_filter(cart(), tmp_path)
    with (tmp_path / "filter.c").open("a") as file:
        file.write("\n")
    with pytest.raises(ConfigurationError, match="a changed one"):
        compare(tmp_path, cart(), states=10)
    with pytest.raises(ConfigurationError, match="holds no exported filter"):
        compare(tmp_path / "none", cart(), states=10)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (ExportOptions(name="while"), "no name of C"),
        (ExportOptions(name="two words"), "no name of C"),
        (ExportOptions(region=((0.0, 1.0),)), "of each of the 2 states"),
        (ExportOptions(region=((0.0, 1.0), (1.0, 1.0))), "of each of the 2 states"),
    ],
)
def test_wrong_options(options: ExportOptions, message: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=message):
        export_filter(cart(), tmp_path, options=options)


@NEEDS_COMPILER
def test_the_compiler_of_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    export_filter(cart(), tmp_path)
    monkeypatch.setenv("CC", "false")
    with pytest.raises(ConfigurationError, match="the C compiler false fails"):
        compare(tmp_path, cart(), states=10)


@NEEDS_COMPILER
@pytest.mark.oracle
@pytest.mark.parametrize("name", [name for name in CASES if "learned" not in name])
def test_everything_that_a_filter_may_have(name: str, tmp_path: Path) -> None:
    safety_filter = case_of(name)[0]
    options = ExportOptions(region=((-2.5, 2.5),) * safety_filter.model.n)
    for float32 in (False, True):
        export_filter(safety_filter, tmp_path, float32, options)
        for flags in (("-O0",), ("-O3",), SANITIZED):
            assert "0 differences" in run_selftest(tmp_path, *flags)
        run_hostile(tmp_path, *SANITIZED, number="float" if float32 else "double")
        found = compare(tmp_path, safety_filter, options, states=20_000)
        assert found.out_of_bounds == 0
        unexplained = found.flags_different - found.flags_close
        assert unexplained <= (found.states // 1000 if float32 else 0)
        assert float32 or found.largest_error <= 1e-10


@NEEDS_COMPILER
@pytest.mark.oracle
@pytest.mark.parametrize(
    ("env_id", "condition", "states", "error"),
    [
        ("StochasticDubins", "scbf", 1_000_000, 1e-12),
        ("DubinsObstacles", "hocbf", 1_000_000, 1e-12),
        ("QuadrotorLimits", "hocbf", 1_000_000, 1e-12),
    ],
)
def test_a_million_states(
    env_id: str, condition: str, states: int, error: float, tmp_path: Path
) -> None:
    safety_filter, options = filter_of(env_id, condition)
    export_filter(safety_filter, tmp_path, options=options)
    found = compare(tmp_path, safety_filter, options, states=states)
    assert found.flags_different == found.flags_close
    assert found.out_of_bounds == 0
    assert found.largest_error <= error
    assert found.beyond == 0
    assert min(found.infeasible, found.without_effect, found.invalid) > 0
    assert np.isfinite(found.largest_relative_error)
    for compiler in COMPILERS:
        for flags in (("-O0",), ("-O3",), SANITIZED):
            assert "0 differences" in run_selftest(tmp_path, *flags, compiler=compiler)


@NEEDS_COMPILER
def test_a_held_input_has_no_part_in_a_plane(tmp_path: Path) -> None:
    # Rounding of two equal faces, over a width of 0, once gave a slope of 1e284.
    safety_filter = case_of("planes above")[0]
    options = ExportOptions(region=((-2.5, 2.5),) * 3)
    export_filter(safety_filter, tmp_path, options=options)
    assert_equal(compare(tmp_path, safety_filter, options, states=3000))
    x, u = [-1.426, 1.23, -0.286], [-0.57, -0.79]
    held = safety_filter.filter(x, u, input_bounds=[(-0.65, 0.42), (-0.64, -0.64)])
    nearly = safety_filter.filter(x, u, input_bounds=[(-0.65, 0.42), (-0.64, -0.64 + 1e-9)])
    assert held.feasible == nearly.feasible
    np.testing.assert_allclose(held.action, nearly.action, atol=1e-6)
    np.testing.assert_allclose(held.margin, nearly.margin, atol=1e-6)
