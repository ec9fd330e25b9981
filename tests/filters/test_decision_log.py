"""The log of decisions: what is added is what is read, and what is no log is refused."""

from __future__ import annotations

import copy
import pickle
from functools import partial

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import sympy as sp

from safe_envs import (
    Barrier,
    ConfigurationError,
    ControlAffineSDE,
    DecisionLog,
    InvalidInputError,
)
from safe_envs.filters import decision_log
from safe_envs.filters.decision_log import LogColumns
from safe_envs.problem.signals import TIME
from safe_envs.wrappers import CBF, SafetyFilter
from tests.conftest import problem_of

x, y, u, w = sp.symbols("x y u w", real=True)


@pytest.fixture(scope="module")
def safety_filter():
    """Two integrators below walls at x = 1 and y = 2, in a room where |x| stays below 3."""
    plane = ControlAffineSDE((x, y), (u, w), [0, 0], [[1, 0], [0, 1]], [0, 0])
    walls = [Barrier(1 - x, "wall"), Barrier(2 - y, "wall"), Barrier(9 - x**2, "room")]
    return SafetyFilter(plane, walls, CBF(2.0), input_bounds=(-3.0, 3.0))


@pytest.fixture
def log(safety_filter):
    """Free, held back by the first wall, and beyond it further than the bounds can mend."""
    found = DecisionLog.for_filter(safety_filter, {x: "m", "u": "m/s", "room": "m^2"})
    for k, (state, proposed) in enumerate(
        [((0.0, 0.0), (1.0, -1.0)), ((0.5, 0.0), (2.0, 0.5)), ((3.5, 0.0), (0.0, 0.0))]
    ):
        decision = safety_filter.filter(np.array(state), np.array(proposed))
        found.add(0.1 * k, np.array(state), decision)
    return found


def test_sections_hold_what_was_decided(log, safety_filter):
    assert len(log) == 3
    np.testing.assert_array_equal(log.t, [0.0, 0.1, 0.2])
    np.testing.assert_array_equal(log.section("state"), [[0.0, 0.0], [0.5, 0.0], [3.5, 0.0]])
    np.testing.assert_array_equal(log.section("nominal"), [[1.0, -1.0], [2.0, 0.5], [0.0, 0.0]])
    np.testing.assert_allclose(log.section("action"), [[1.0, -1.0], [1.0, 0.5], [-3.0, 0.0]])
    np.testing.assert_array_equal(log.section("low"), np.full((3, 2), -3.0))
    np.testing.assert_allclose(log.section("h"), [[1, 2, 9], [0.5, 2, 8.75], [-2.5, 2, -3.25]])
    np.testing.assert_allclose(log.section("slack")[:2], 0.0)
    assert log.section("slack")[2, 0] == pytest.approx(2.0)
    assert log.intervention.tolist() == [False, True, True]
    assert log.feasible.tolist() == [True, True, False]
    assert log.section("cause")[:2, 0].tolist() == [-1, 0]
    assert (log.interventions, log.infeasible, log.h_min) == (2, 1, -3.25)
    assert "-3.25 m^2 (room, t = 0.2 s)" in str(log)
    empty = DecisionLog(log.columns)
    assert (len(empty), empty.h_min, str(empty)) == (0, np.inf, "an empty log")


def test_a_loop_with_a_belief_is_logged_at_its_estimate():
    problem = problem_of("safe_envs/Pendulum-v0", measurement="default")
    found = SafetyFilter.for_problem(problem, "scbf:belief=0.1", estimator="ekf")
    log = DecisionLog.for_filter(found)
    assert [h for h in log.columns.headings if h.startswith("parameter")] == []
    for k in range(3):
        decision = found.filter_measurement([0.1 * k, 0.0], [1.0])
        log.add(0.1 * k, found.measured.mean, decision)
        np.testing.assert_array_equal(log.section("state")[-1], found.measured.mean)
        np.testing.assert_array_equal(log.section("h")[-1], decision.barrier)
    # Whoever has an estimator of their own gives the belief, and the log does not ask for it.
    own = SafetyFilter.for_problem(problem, "scbf:belief=0.1")
    given = {s.name: 0.01 for s in own.qp.runtime}
    decision = own.filter([0.1, 0.0], [1.0], parameters=given)
    log.add(0.3, [0.1, 0.0], decision, parameters=given)
    with pytest.raises(InvalidInputError, match="mass"):
        log.add(0.3, [0.1, 0.0], decision, parameters={**given, "mass": 1.0})
    with pytest.raises(ConfigurationError, match="filter_measurement"):
        own.filter([0.1, 0.0], [1.0])
    moving = ControlAffineSDE.from_rate((x,), (u,), [u], signals={y: w, w: 0})
    settings = {"dt": 0.1, "instants": 10, "input_bounds": (-9, 9)}
    beside = SafetyFilter(moving, y - x, "cbf:belief=0.1", **settings)
    log = DecisionLog.for_filter(beside, {y: "m"})
    given = {"y": 2.0, "w": -1.0, **{s.name: 0.01 for s in beside.qp.runtime if s not in (y, w)}}
    log.add(0.0, [0.5], beside.filter([0.5], [3.0], parameters=given), parameters=given)
    assert log.section("parameter").tolist() == [[2.0, -1.0]]
    assert "parameter:y [m]" in log.columns.headings


each_format = pytest.mark.parametrize("suffix", ["csv", "parquet"])


def read_again(log, folder, suffix):
    path = folder / f"log.{suffix}"
    getattr(log, f"to_{suffix}")(path)
    found = DecisionLog.read(path)
    assert found.columns == log.columns
    np.testing.assert_array_equal(found.table(), log.table())
    assert list(folder.iterdir()) == [path]


@each_format
def test_a_file_gives_the_log_back_to_the_last_bit(log, tmp_path, suffix):
    read_again(log, tmp_path, suffix)
    read_again(DecisionLog(log.columns), tmp_path, suffix)
    columns = LogColumns.of(("a,b",), ('"u"',), ("h 'é",), units={"a,b": "%, $"})
    odd = DecisionLog(columns)
    odd.append([0.0, 1.5, 2.0, 1 / 3, -np.inf, np.inf, 0.1, 0.0, 1, 1, 0])
    read_again(odd, tmp_path, suffix)


@each_format
@pytest.mark.parametrize(
    ("given", "kept"),
    [
        (["a [m]"], ["a (m)"]),
        (["x[1]", "[m] b"], ["x[1]", "[m] b"]),
        (["a\rb", "a\nb", "\ud800", "\ufeffa"], ["a b 1", "a b 2", " ", " a"]),
        (["a", "a", "a 1", "a 3"], ["a 2", "a 4", "a 1", "a 3"]),
    ],
)
def test_names_are_written_so_that_they_are_read_again(tmp_path, given, kept, suffix):
    columns = LogColumns.of(("x",), ("u",), given, units={"u": "m\r/s"})
    assert columns.barriers == tuple(kept)
    assert columns.units == {"u": "m /s"}
    read_again(DecisionLog(columns), tmp_path, suffix)


def test_time_never_goes_back(log, safety_filter):
    decision = safety_filter.filter(np.zeros(2), np.zeros(2))
    log.add(0.2, [0.0, 0.0], decision)
    for earlier in (lambda: log.add(0.1, [0.0, 0.0], decision), lambda: log.append(log.table()[0])):
        with pytest.raises(InvalidInputError, match="before"):
            earlier()
    assert log.t.tolist() == [0.0, 0.1, 0.2, 0.2]
    assert len(log.between(0.2, 0.2)) == 2


ROW = [0.0, 0.0, 0.0, 0.0, -3.0, 3.0, 1.0, 0.0, 0, 1, -1]


@pytest.mark.parametrize(
    "row",
    [
        *([np.nan, *ROW[1:]], [*ROW[:-3], 0.5, 1, -1], [*ROW[:-1], 1], [*ROW[:-1], 0.5]),
        *([*ROW[:-1], np.nan], [*ROW, 0.0], [10**400, *ROW[1:]], ["a", *ROW[1:]], "a", None, 3),
    ],
)
def test_rows_that_could_not_be_written_are_refused(row):
    log = DecisionLog(LogColumns.of(("x",), ("u",), ("h",)))
    log.append(ROW)
    with pytest.raises(InvalidInputError, match="the log"):
        log.append(row)
    assert len(log) == 1


def test_a_part_between_two_times(log):
    assert log.between(0.05).t.tolist() == [0.1, 0.2]
    assert log.between(end=0.1).t.tolist() == [0.0, 0.1]
    part = log.between(0.1, 0.1)
    np.testing.assert_array_equal(part.table(), log.table()[1:2])
    assert (part.interventions, part.infeasible, len(log)) == (1, 0, 3)
    assert len(log.between(3.0)) == len(log.between(0.2, 0.1)) == 0


def test_what_is_added_later_changes_nothing_before(log, safety_filter):
    table, state = log.table(), np.array([0.2, 0.1])
    decision = safety_filter.filter(state, np.zeros(2))
    section = log.section("h")
    log.add(0.3, state, decision)
    state[:] = 7.0
    np.testing.assert_array_equal(log.table()[:3], table)
    np.testing.assert_array_equal(log.section("state")[3], [0.2, 0.1])
    assert len(section) == 3


def test_bounds_of_a_period(log, safety_filter):
    decision = safety_filter.filter(np.zeros(2), np.zeros(2))
    log.add(0.3, [0.0, 0.0], decision, input_bounds=[(-1.0, 1.0), (-2.0, 0.5)])
    log.add(0.4, (0.0, 0.0), decision, input_bounds=(-1.0, 4.0))
    np.testing.assert_array_equal(log.section("low")[3:], [[-1.0, -2.0], [-1.0, -1.0]])
    np.testing.assert_array_equal(log.section("high")[3:], [[1.0, 0.5], [4.0, 4.0]])


def test_what_comes_in_at_run_time():
    p, m = sp.symbols("p m", real=True)
    system = ControlAffineSDE((x,), (u,), [0], [m], [0], {m: 2.0}, {p: 0})
    safety_filter = SafetyFilter(
        system, [p - x + TIME], "cbf:alpha=1", input_bounds=(-np.inf, 3.0), adjustable=("m",)
    )
    log = DecisionLog.for_filter(safety_filter, {p: "m"})
    for t, parameters in ((0.0, {"p": 1.0}), (0.5, {p: 0.5, "m": 4.0})):
        decision = safety_filter.filter([0.0], [9.0], parameters=parameters, t=t)
        log.add(t, [0.0], decision, parameters=parameters)
    assert log.columns.headings[2:4] == ["parameter:p [m]", "parameter:m"]
    np.testing.assert_array_equal(log.section("parameter"), [[1.0, 2.0], [0.5, 4.0]])
    np.testing.assert_array_equal(log.section("low"), [[-np.inf], [-np.inf]])
    np.testing.assert_allclose(log.section("h"), 1.0)
    # The filter allows m u <= 1 + h.
    np.testing.assert_allclose(log.section("action"), [[1.0], [0.5]])
    with pytest.raises(InvalidInputError, match="lacks p"):
        log.add(1.0, [0.0], decision)
    assert len(log) == 2


def test_a_log_can_be_copied_and_sent(log):
    for found in (copy.deepcopy(log), copy.copy(log), pickle.loads(pickle.dumps(log))):
        assert found.columns == log.columns
        np.testing.assert_array_equal(found.table(), log.table())
        found.append(log.table()[-1])
        assert (len(found), len(log)) == (4, 3)


def test_what_a_filter_does_not_take_is_not_logged():
    p, q, mass = sp.symbols("p q mass", real=True)
    system = ControlAffineSDE.from_rate((x,), (u,), [u], None, {mass: 2.0}, {p: q, q: 0})
    made = SafetyFilter(system, p - x, "cbf", (-1.0, 1.0), adjustable=("mass",))
    plain = SafetyFilter(ControlAffineSDE.from_rate((x,), (u,), [u]), 1 - x, "cbf", (-1.0, 1.0))
    given = {"p": 1.0, q: -0.5}
    decision = made.filter([0.0], [0.5], parameters=given)
    log = DecisionLog.for_filter(made)
    for changes, fragment in (
        ({"z": 1.0}, "p, q, z"),
        ({p: 1.0}, "p, q, mass"),
        ({"t": 1.0}, "p, q, mass"),
        ({"p": np.nan}, "p is nan"),
        ({"mass": np.inf}, "mass is inf"),
    ):
        with pytest.raises(InvalidInputError, match=fragment):
            log.add(0.0, [0.0], decision, parameters={**given, **changes})
    for state in (np.nan, np.inf, -np.inf):
        with pytest.raises(InvalidInputError, match=f"x is {state}"):
            log.add(0.0, [state], decision, parameters=given)
    with pytest.raises(InvalidInputError, match="none"):
        DecisionLog.for_filter(plain).add(
            0.0, [0.0], plain.filter([0.0], [0.5]), parameters={"z": 1.0}
        )
    assert len(log) == 0
    log.add(0.0, [1e308], decision, parameters={**given, "mass": 1e308})  # whose sum is infinite
    assert log.section("parameter").tolist() == [[1.0, -0.5, 1e308]]


def added(log, safety_filter, t, x):
    log.add(t, x, safety_filter.filter([0.0] * 2, [0.0] * 2))


@pytest.mark.parametrize(
    ("call", "error", "fragment"),
    [
        *(
            (partial(added, t=t, x=x), InvalidInputError, "the log")
            for t, x in (
                (np.nan, [0.0, 0.0]),
                (3.0, [0.0]),
                (3.0, "ab"),
                (3.0, 1.0),
                (None, [0.0] * 2),
                (3.0, [10**400, 0.0]),
                (3.0, np.zeros((2, 2))),
            )
        ),
        *(
            (lambda log, f, n=name, p=path: getattr(log, n)(p), ConfigurationError, "FILE")
            for name in ("to_csv", "to_parquet", "read")
            for path in (3, None, b"x.csv")
        ),
        (lambda log, f: log.section("zz"), ConfigurationError, "'zz'"),
        (lambda log, f: log.between("now"), ConfigurationError, "start"),
        (lambda log, f: DecisionLog(3), ConfigurationError, "columns = 3"),
        (lambda log, f: LogColumns.of(("x", "x"), ("u",), ("h",)), ConfigurationError, "'x'"),
        (lambda log, f: DecisionLog.for_filter(f, {"z": "m"}), ConfigurationError, "'z'"),
        (lambda log, f: DecisionLog.for_filter(f, {"x": "[m]"}), ConfigurationError, "brackets"),
        (lambda log, f: DecisionLog.for_filter(f, "m"), ConfigurationError, "units = 'm'"),
        (lambda log, f: DecisionLog.for_filter(f.qp), ConfigurationError, "SafetyFilter"),
    ],
)
def test_what_does_not_fit_is_refused_and_adds_nothing(log, safety_filter, call, error, fragment):
    with pytest.raises(error, match=fragment):
        call(log, safety_filter)
    assert len(log) == 3


HEADINGS = LogColumns.of(("x",), ("u",), ("h",)).headings
TOP = ",".join(HEADINGS)
LINE = "0.0,1,1,1,-2,2,0.5,0,0,1,-1"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "columns"),
        ("t [s],x\n0,1\n", "columns"),
        (TOP.replace("state:x", "world:x") + f"\n{LINE}\n", "world:x"),
        (TOP.replace("state:x", "slack:x") + f"\n{LINE}\n", "in their order"),
        (f"{TOP}\n{LINE},5\n", "12 numbers"),
        (f"{TOP}\n{LINE}\n1,2\n", "columns"),
        (f"{TOP}\n{LINE.replace('1,1,1', '1,a,1')}\n", "could not convert"),
        (f"{TOP}\n{LINE.replace('0.0', 'nan', 1)}\n", "not finite"),
        (f"{TOP}\n{LINE.replace('0,1,-1', '0,2,-1')}\n", "neither 0 nor 1"),
        (f"{TOP}\n{LINE.replace('0,1,-1', '0,1,1')}\n", "none of its barriers"),
        (f"{TOP}\n\n{LINE}\n", "empty line"),
        (f"{TOP}\n{LINE}\n{LINE.replace('0.0', '-1.0', 1)}\n", "time goes back"),
        (f"{TOP.replace('h:h', 'h:h,h:h')}\n", "'h:h' twice"),
        (",".join(["t [s]"] * 2000), "1000"),
        ("x" * 200_000, "field limit"),
        ("\x00\xff", "holds no log"),
    ],
)
def test_a_text_that_is_no_log_is_refused(tmp_path, text, reason):
    path = tmp_path / "log.csv"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(ConfigurationError, match=reason):
        DecisionLog.read(path)


def test_the_line_of_these_tests_is_a_log(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text(f"{TOP}\n{LINE}\n")
    assert len(DecisionLog.read(path)) == 1


def table(**changed):
    values = dict(zip(HEADINGS, map(float, LINE.split(",")), strict=True))
    return pa.table({name: [value] for name, value in (values | changed).items()})


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        (table(cause="text"), "no numbers"),
        (table(cause=None), "no numbers"),
        (table(**{"t [s]": [0.0]}), "no numbers"),
        (pa.table({"a": [1.0]}), "columns"),
        (table(cause=5.0), "none of its barriers"),
        (pa.table({name: pa.array([None], pa.float64()) for name in HEADINGS}), "missing"),
    ],
)
def test_a_table_that_is_no_log_is_refused(tmp_path, given, reason):
    path = tmp_path / "log.parquet"
    pq.write_table(given, path)
    with pytest.raises(ConfigurationError, match=reason):
        DecisionLog.read(path)


def test_a_small_file_of_a_large_table_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "log.parquet"
    pq.write_table(pa.table({name: pa.array([0.0] * 10_000) for name in HEADINGS}), path)
    monkeypatch.setattr(decision_log, "MOST_BYTES", 100_000)
    assert path.stat().st_size < 100_000
    with pytest.raises(ConfigurationError, match="largest"):
        DecisionLog.read(path)


@pytest.mark.parametrize(
    ("name", "fragment"),
    [("broken.parquet", "Parquet"), ("folder.csv", ""), ("none.csv", ""), ("log.npz", "FILE.csv")],
)
def test_other_files_are_refused(tmp_path, name, fragment):
    (tmp_path / "broken.parquet").write_bytes(b"PAR1 and no more")
    (tmp_path / "folder.csv").mkdir()
    with pytest.raises(ConfigurationError, match=rf"{name}.*{fragment}"):
        DecisionLog.read(tmp_path / name)


def test_without_pyarrow_the_message_names_the_extra(tmp_path, monkeypatch):
    log = DecisionLog(LogColumns.read(HEADINGS))
    monkeypatch.setattr(decision_log, "find_spec", lambda name: None)
    (tmp_path / "there.parquet").write_bytes(b"")
    with pytest.raises(ConfigurationError, match=r"\.\[sweep\].*CSV"):
        log.to_parquet(tmp_path / "log.parquet")
    with pytest.raises(ConfigurationError, match=r"\.\[sweep\]"):
        DecisionLog.read(tmp_path / "there.parquet")


def test_a_failed_writing_leaves_the_file_before(tmp_path, monkeypatch):
    log = DecisionLog(LogColumns.read(HEADINGS))
    log.append([float(entry) for entry in LINE.split(",")])
    path = tmp_path / "log.csv"
    path.write_text("before")
    monkeypatch.setattr(decision_log.csv, "writer", lambda *_, **__: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        log.to_csv(path)
    assert path.read_text() == "before"
    assert list(tmp_path.iterdir()) == [path]
