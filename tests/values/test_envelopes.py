"""Tables hold the value between two envelopes: Bellman, exact values, and what is easier."""

from __future__ import annotations

import importlib.util
import math
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

from safe_envs import ConfigurationError, ControlAffineSDE, SystemDefinitionError, define_problem
from safe_envs.problem.problem import Barrier
from safe_envs.values.look_ahead import LookAhead
from safe_envs.values.solve import solve
from safe_envs.values.tables import ValueSettings
from tests.values.systems import expected_after, quadrature, row, s, scalar, solved, u, v, x, y

pytestmark = pytest.mark.filterwarnings("ignore:the input bounds")
INF, R = math.inf, sp.Rational
INPUTS = np.linspace(-1.0, 1.0, 17)
ANGLE = {"workspace": {}, "units": {x: "rad"}, "barriers": sp.cos(x) + 0.5, "start": (0.1,)}
FRONT = [(-math.acos(-0.5), math.acos(-0.5))]
BEHIND = [(-math.pi, -math.acos(0.5)), (math.acos(0.5), math.pi)]
# The problem, its safe set, and how far the envelopes of 60 cells may be apart on average at 0.
CASES = {
    "plain": ({}, [(0, 2)], 0.3),
    "drift": ({"drift": sp.sin(3 * x)}, [(0, 2)], 0.3),
    "strong drift": ({"drift": 30}, [(0, 2)], 0.01),
    "fast drift": ({"drift": 1e6 * x}, [(0, 2)], 0.1),
    "noise of the state": ({"drift": -x, "sigma": 0.2 + 0.3 * x**2}, [(0, 2)], 0.5),
    "fading noise": ({"drift": -x, "sigma": 0.5 * sp.exp(-x)}, [(0, 2)], 0.5),
    "gain of two signs": ({"gain": sp.cos(2 * x) + 0.2}, [(0, 2)], 0.5),
    "no gain": ({"gain": 1e-9}, [(0, 2)], 0.3),
    "hardly any noise": ({"s": 1e-3}, [(0, 2)], 0.6),
    "tiny noise": ({"s": 1e-9}, [(0, 2)], 0.6),
    "large noise": ({"s": 40.0}, [(0, 2)], 0.01),
    "huge noise": ({"s": 1e4}, [(0, 2)], 0.01),
    "two parts": ({"barriers": sp.Abs(x) - R(1, 10)}, [(-1, -0.1), (0.1, 2)], 0.3),
    # Cells are cut by these edges.
    "a hole": (
        {"barriers": (x - 1) ** 2 - R(1, 5), "start": (0.2,)},
        [(-1, 1 - math.sqrt(0.2)), (1 + math.sqrt(0.2), 2)],
        0.3,
    ),
    "thin": (
        {"barriers": 1e-6 - (x - R(1, 3)) ** 2, "start": (1 / 3,)},
        [(1 / 3 - 1e-3, 1 / 3 + 1e-3)],
        0.3,
    ),
    "everywhere": ({"barriers": 3 + x}, [(-1, 2)], 0.3),
    "kink": ({"barriers": sp.Max(x, R(-1, 2))}, [(0, 2)], 0.3),
    "angle": ({**ANGLE, "drift": 0.5 * sp.sin(x), "s": 0.6}, FRONT, 0.4),
    "angle, small noise": ({**ANGLE, "s": 0.15}, FRONT, 0.4),
    "angle, noise of many turns": ({**ANGLE, "s": 30.0}, FRONT, 0.1),
    "angle, safe set across its end": (
        {**ANGLE, "barriers": -0.5 - sp.cos(x), "start": (3.0,), "s": 0.5},
        [(-math.pi, -math.acos(-0.5)), (math.acos(-0.5), math.pi)],
        0.4,
    ),
    "goal": ({"drift": -1, "goal": R(1, 2) - x}, [(0, 2)], 0.3),
}
ONES = {"goal": [(0.0, 0.5)], "leaving": [(2.0, INF)]}


def points_of(edges, safe, goal=()):
    """Return states in cells and the safe set, next to all the ends too, and their cells."""
    ends = [e for interval in (*safe, *goal) for e in interval]
    cuts = np.unique([*edges, *np.clip(ends, edges[0], edges[-1])])
    low, width = cuts[:-1, None], np.diff(cuts)[:, None]
    q = (low + width * [1e-6, 0.31, 1 - 1e-6]).ravel()
    inside = np.any([(a < q) & (q < b) for a, b in safe], axis=0)
    inside &= ~np.any([(a <= q) & (q <= b) for a, b in [*goal, (1, 0)]], axis=0)
    q = q[inside]
    return q, np.searchsorted(edges, q, side="right") - 1


def require_bellman(table, problem, safe, ones=(), instants=None):
    """Require both of Bellman's inequalities at states of all cells, with exact expectations."""
    edges, period = table.grid.axes[0].edges, table.grid.axes[0].period
    goal = ones if problem.goal is not None else ()
    q, cells = points_of(edges, safe, goal)
    given = {"safe": safe, "ones": ones, "period": period}
    lower, upper = row(table, table.steps)
    assert (upper[cells] == 1).all()
    assert (lower <= upper).all()
    for k in (0, 1, table.steps - 1) if instants is None else instants:
        lower, upper = (e[cells] for e in row(table, k))
        after = row(table, k + 1)
        scanned = expected_after(problem, after[0], edges, q, table.inputs[:, 0], **given)
        assert (lower <= scanned.max(axis=1) + 1e-9).all(), k
        largest = expected_after(problem, after[1], edges, q, INPUTS, **given).max(axis=1)
        assert (upper >= largest - 1e-9).all(), k
        assert (lower <= upper).all()


FEW = ("thin", "two parts", "angle", "noise of the state")
LIKE_OTHERS = ("drift", "fast drift", "fading noise", "hardly any noise", "large noise", "angle")


@pytest.mark.parametrize(
    ("name", "count"),
    [
        *((name, 5) for name in FEW),
        *((name, 60) for name in CASES if name not in LIKE_OTHERS),
        *(pytest.param(name, 60, marks=pytest.mark.oracle) for name in LIKE_OTHERS),
    ],
)
def test_envelopes_meet_bellmans_inequalities(name, count):
    options, safe, gap = CASES[name]
    options = dict(options)
    goal = options.pop("goal", None)
    problem = replace(scalar(horizon=0.5, **options), goal=goal)
    table = solved(problem, count, inputs=5)
    require_bellman(table, problem, safe, ONES["goal"] if goal is not None else ())
    if count == 60:
        q, cells = points_of(table.grid.axes[0].edges, safe)
        lower, upper = row(table, 0)
        assert (upper - lower)[cells].mean() < gap
        require_look_ahead(problem, table, q)
    if goal is not None and count == 60:
        lower, upper = row(table, 0)
        cells = table.grid.cell_of([np.array([0.03, 0.3, 0.45, 0.5 - 1e-9])])
        assert (upper[cells] == 1).all()
        assert (lower[cells[:-1]] == 1).all()


def require_look_ahead(problem, table, q):
    """Require that a step of look-ahead does not fall below the table, which promises rest on."""
    ahead, rng = LookAhead(table, problem), np.random.default_rng(1)
    q = rng.choice(q, 100)
    k = rng.integers(0, table.steps, 100)
    most = ahead.scanned(k, (q,)).max(axis=1)
    _, ends = ahead.sets_at(k, (q,))
    assert (ahead.values(k, (q,)) <= np.where(ends, 1.0, most) + 1e-7).all()
    assert (ahead.largest(k, (q,)) >= most - 1e-7).all()
    chosen, value = ahead.best_input(k, (q,))
    np.testing.assert_allclose(value, most, atol=1e-8)
    np.testing.assert_allclose(ahead.expected(k, (q,), chosen[:, None])[:, 0], value, atol=1e-7)


@pytest.mark.parametrize("drift", [0, sp.sin(3 * x)])
@pytest.mark.parametrize("leaving", ["violation", "safe"])
def test_envelopes_close_in(drift, leaving):
    problem, gaps = scalar(drift), []
    for count in (40, 160):
        table = solved(problem, count, inputs=5, leaving=leaving)
        ones = ONES["leaving"] if leaving == "safe" else ()
        require_bellman(table, problem, [(0, 2)], ones)
        gaps.append(np.mean(table.upper - table.lower))
    # The error is of first order; that of five inputs stays.
    assert gaps[1] < 0.5 * gaps[0]


@pytest.mark.parametrize(
    ("drift", "sigma", "interval"),
    [(-s * x, 0.3, (0.0, 2.0)), (0, s, (0.2, 0.5)), (-s * x, 0.2 + s, (0.1, 0.3))],
)
def test_robust_envelopes_are_around_the_value_of_every_parameter(drift, sigma, interval):
    robust = solved(scalar(drift, sigma, s=interval[0]), 80, inputs=5, intervals={"s": interval})
    for value in np.linspace(*interval, 3):
        require_bellman(robust, scalar(drift, sigma, s=value), [(0, 2)])
    assert (robust.upper - robust.lower).mean() < 0.5


def braking(**options):
    """Return dx = -x^2 - 1/2 + u (1 + x), whose best input for h = x - 0.3 is the largest one."""
    system = ControlAffineSDE((x,), (u,), [-(x**2) - 0.5], [[1 + x]], [[0]])
    given = {"input_bounds": (0.0, 0.4), "start": (1.0,), "dt": 0.1, "horizon": 2.0, **options}
    return define_problem(system, x - 0.3, workspace={x: (-1.0, 2.0)}, name="braking", **given)


def test_without_noise_a_step_of_runge_and_kutta():
    problem = braking()
    table = solved(problem, 400, inputs=5)
    rate = lambda at: -(at**2) - 0.5 + 0.4 * (1 + at)  # noqa: E731
    start = np.linspace(0.301, 1.99, 300)
    at, safe, h = start, np.full(start.shape, True), problem.dt
    for _ in range(problem.steps):
        a = rate(at)
        b = rate(at + 0.5 * h * a)
        c = rate(at + 0.5 * h * b)
        at = at + h / 6 * (a + 2 * b + 2 * c + rate(at + h * c))
        safe &= at >= 0.3
    assert 20 < safe.sum() < 280
    for lower, upper in (
        [each[table.grid.cell_of([start])] for each in row(table, 0)],
        LookAhead(table, problem).start_bounds((start,)),
    ):
        assert set(np.unique(lower)) <= {0.0, 1.0}
        assert (lower <= safe).all()
        assert (safe <= upper).all()
        assert (upper - lower).mean() < 0.15


# Systems of one state: drift, noise, barrier and bounds of the workspace.
PLAIN = (0, s, lambda q: q, (-1.0, 2.0))
OTHER = (lambda q: -q / 2, R(3, 10), lambda q: q, (-1.0, 1.5))
VARIED = (0, lambda q: 0.3 + 0.1 * q, lambda q: q, (-1.0, 1.5))
TURNING = (lambda q: sp.sin(q) / 2, R(3, 5), lambda q: sp.cos(q) + R(1, 2), None)
FACTORS = {"plain": PLAIN, "other": OTHER, "varied": VARIED, "turning": TURNING}


def side_by_side(*names, horizon=0.3, **options):
    """Return systems of one state each, with an input each, in one problem."""
    chosen = [FACTORS[name] for name in names]
    states, inputs = (sp.symbols(f"{e}_1:{len(names) + 1}", real=True) for e in "qu")
    put = lambda e, q: e(q) if callable(e) else e  # noqa: E731
    system = ControlAffineSDE(
        states,
        inputs,
        [put(f[0], q) for f, q in zip(chosen, states, strict=True)],
        sp.eye(len(names)),
        sp.diag(*[put(f[1], q) for f, q in zip(chosen, states, strict=True)]),
        {s: 0.4} if any(f[1] is s for f in chosen) else {},
    )
    given = {
        "input_bounds": (-1.0, 1.0),
        "start": (0.5,) * len(names),
        "dt": 0.1,
        "horizon": horizon,
        "workspace": {q: f[3] for f, q in zip(chosen, states, strict=True) if f[3]},
        "units": {q: "rad" for f, q in zip(chosen, states, strict=True) if not f[3]},
        **options,
    }
    barriers = [f[2](q) for f, q in zip(chosen, states, strict=True)]
    return define_problem(system, barriers, name="side by side", **given)


def safe_end(name):
    bounds = FACTORS[name][3]
    return (0.0, bounds[1]) if bounds else FRONT[0]


@pytest.mark.parametrize(
    ("names", "cells", "horizon", "gap"),
    [
        (("plain", "other"), 50, 0.4, 0.2),
        (("plain", "turning", "varied"), 12, 0.2, 0.8),
        *(
            pytest.param(*case, marks=pytest.mark.oracle)
            for case in (
                (("turning", "other"), 40, 0.3, 0.4),
                (("varied", "plain"), 40, 0.3, 0.3),
                (("other", "plain", "turning", "plain"), 7, 0.1, 0.95),
            )
        ),
    ],
)
def test_the_value_of_systems_side_by_side_is_the_product_of_values(names, cells, horizon, gap):
    problem = side_by_side(*names, horizon=horizon)
    table = solved(problem, *[cells] * len(names), inputs=3)
    tried, nodes = np.linspace(-1, 1, 3), 60 if len(names) == 2 else 12
    parts = []
    for name in names:
        alone = side_by_side(name, horizon=horizon)
        period = 0.0 if FACTORS[name][3] else 2 * math.pi
        fine = quadrature(alone, tried, safe_end(name), period=period, nodes=60)
        picked = np.linspace(0, 59, nodes).astype(int)
        parts.append((fine[0][picked], [values[picked] for values in fine[1]]))
    at = [e.ravel() for e in np.meshgrid(*[q for q, _ in parts], indexing="ij")]
    inside = table.grid.cell_of(at)
    assert (inside >= 0).all()
    for k in range(problem.steps + 1):
        each = np.meshgrid(*[values[k] for _, values in parts], indexing="ij")
        exact = np.prod(each, axis=0).ravel()
        lower, upper = (e[inside] for e in row(table, k))
        assert (lower <= exact + 1e-9).all()
        assert (exact <= upper + 1e-9).all()
    lower, upper = (e[inside] for e in row(table, 0))
    assert (upper - lower).mean() < gap
    low, high = LookAhead(table, problem).start_bounds(tuple(at))
    exact = np.prod(np.meshgrid(*[v[0] for _, v in parts], indexing="ij"), axis=0).ravel()
    assert (low <= exact + 1e-9).all()
    assert (exact <= high + 1e-9).all()


@pytest.mark.parametrize(
    "make",
    [
        lambda: (scalar(-x, 0.2 + x**2, gain=1 + x, horizon=0.3), (12,)),
        lambda: (side_by_side("turning", "varied", horizon=0.2), (5, 4)),
        lambda: (
            scalar(
                sp.exp(-x) / 4 - sp.sqrt(x + 3) / 4 + 1 / (x + 3) - sp.Min(x, x**3) / 9,
                0.2 + sp.Max(x, 0) / 5,
                horizon=0.2,
            ),
            (12,),
        ),
    ],
)
def test_with_and_without_numba_tables_are_the_same(make, monkeypatch):
    problem, cells = make()
    compiled = solved(problem, *cells, inputs=3)
    ahead = LookAhead(compiled, problem)
    starts = tuple(np.random.default_rng(0).uniform(-0.9, 1.4, (len(cells), 40)))
    bounds = ahead.start_bounds(starts)
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *a: None if name == "numba" else find(name, *a)
    )
    plain = solved(problem, *cells, inputs=3)
    np.testing.assert_allclose(plain.lower, compiled.lower, atol=1e-6)
    np.testing.assert_allclose(plain.upper, compiled.upper, atol=1e-6)
    np.testing.assert_allclose(LookAhead(plain, problem).start_bounds(starts), bounds, atol=1e-6)


@pytest.mark.parametrize(
    ("harder", "easier"),
    [
        ({}, {"input_bounds": (-1.5, 1.5)}),
        ({"s": 0.6}, {"s": 0.3}),
        ({"horizon": 2.0}, {}),
        ({"barriers": x - R(1, 5)}, {}),
    ],
)
def test_what_is_easier_has_the_larger_value(harder, easier):
    tables = [solved(scalar(**options), 120) for options in (harder, easier)]
    q = [np.linspace(0.25, 1.95, 50)]
    low, high = ([e[t.grid.cell_of(q)] for e in row(t, 0)] for t in tables)
    assert (low[0] <= high[1]).all()
    assert low[0].mean() <= low[1].mean()
    assert high[0].mean() < high[1].mean() + 1e-9


@pytest.mark.parametrize("leaving", ["violation", "safe"])
def test_values_do_not_rise_backwards_in_time(leaving):
    table = solved(scalar(horizon=2.0), 80, leaving=leaving)
    assert (np.diff(table.upper, axis=0) >= 0).all()
    assert (np.diff(table.lower, axis=0) >= -0.003).all()
    assert table.lower.min() >= 0
    assert table.upper.max() <= 1


def test_values_that_no_longer_change_are_kept_once():
    problem = scalar(-10 * x, 0, barriers=1 - x, horizon=5.0, s=0)
    table = solved(problem, 60)
    assert table.first > 0
    assert table.steps == problem.steps
    assert LookAhead(table, problem).start_bounds((np.array([0.2]),))[0] == 1


def test_leaving_the_workspace_counts_as_said():
    problem = scalar(3, s=0.2)
    staying, left = (solved(problem, 100, leaving=each) for each in ("violation", "safe"))
    at = (np.array([0.8]),)
    assert LookAhead(staying, problem).start_bounds(at)[1] < 0.05
    assert LookAhead(left, problem).start_bounds(at)[0] > 0.95


def test_leaving_beyond_another_end_of_the_safe_set():
    # The corner beyond x = 1 is safe only where y has left its workspace.
    system = ControlAffineSDE((x, y), (u, v), [0, -y / 2], sp.eye(2), sp.diag(0.4, R(3, 10)))
    problem = define_problem(
        system,
        [sp.Max(1 - x, y - 1)],
        workspace={x: (-2.0, 2.0), y: (-1.0, 1.0)},
        input_bounds=(3.0, 8.0),
        start=(0.5, 0.5),
        dt=0.1,
        horizon=0.3,
    )
    table = solved(problem, 30, 30, leaving="safe", inputs=3)
    low, high = LookAhead(table, problem).start_bounds((np.array([0.9]), np.array([0.7])))
    assert low > 0.5
    assert high > 0.99


def test_a_step_without_a_finite_value_somewhere_counts_as_anything():
    problem = scalar(1 / x, horizon=0.3)
    lower, upper = row(table := solved(problem, 50), 0)
    assert (lower <= upper).all()
    assert upper[table.grid.cell_of([np.array([1e-12])])] > 0.9
    table = solved(scalar(0, gain=1 / x, horizon=0.3), 50)
    assert np.isfinite(table.lower).all()
    assert row(table, 0)[1][table.grid.cell_of([np.array([1e-3])])] > 0.4


def test_zero_of_the_barrier_is_neither_promised_nor_excluded():
    # An evaluation counts h > 0 as safe, the info of an env h >= 0: here h = 0 below 1.2.
    problem = scalar(0, 0, barriers=sp.Max(x - 1.2, 0), horizon=0.2, start=(1.5,))
    ahead = LookAhead(solved(problem, 30), problem)
    low, high = ahead.start_bounds((np.array([1.5, 0.5]),))
    np.testing.assert_array_equal(low, [1, 0])
    np.testing.assert_array_equal(high, [1, 1])


PIECES = sp.Piecewise((x, x > 1), (x / 2, True))


@pytest.mark.parametrize(
    ("problem", "cells", "settings", "error", "fragment"),
    [
        (scalar(workspace={}), (10,), {}, ConfigurationError, "workspace"),
        (scalar(), (10, 10), {}, ConfigurationError, "coordinates x"),
        (scalar(), (10**7,), {"memory": 1e6}, ConfigurationError, "memory"),
        # The tables alone would fit, but not where all the cells lead under all the inputs.
        (braking(), (20_000,), {"inputs": 2000, "memory": 1e9}, ConfigurationError, "memory"),
        (side_by_side("plain", "other"), (10, 10), {"inputs": 1000}, ConfigurationError, "1000"),
        (scalar(substeps=2), (10,), {}, ConfigurationError, "substeps"),
        (scalar(1 / x), (20,), {"leaving": "safe"}, ConfigurationError, "very far out"),
        (replace(scalar(), barriers=(Barrier(x - 5),)), (20,), {}, ConfigurationError, "no state"),
        (scalar(barriers=PIECES), (10,), {}, SystemDefinitionError, "Piecewise"),
    ],
)
def test_what_no_table_can_hold_is_refused(problem, cells, settings, error, fragment):
    with pytest.raises(error, match=fragment):
        solved(problem, *cells, **settings)


def test_progress_goes_up_to_the_whole():
    done = []
    solve(scalar(), ValueSettings(cells=(10,)), done.append)
    assert done == sorted(done)
    assert done[-1] == 1
