"""Tables that are envelopes are certified, and others are refused."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mpmath
import numpy as np
import pytest
import sympy as sp

from safe_envs import ConfigurationError, ControlAffineSDE, state_problem
from safe_envs.values import proved
from safe_envs.values.look_ahead import LookAhead
from safe_envs.values.proved import ProvedStarts, TableRefusedError, check_table, check_table_file
from safe_envs.values.tables import save_table
from tests.values.systems import quadrature, scalar, solved, u, x, y


def plane(sigma=((0.3, 0), (0, 0.2)), **options):
    system = ControlAffineSDE(
        (x, y), (u,), [y, -sp.sin(x)], [[0], [1]], [[sp.sympify(a) for a in row] for row in sigma]
    )
    given = {"box": (-1.0, 1.0), "start": (0.0, 0.0), "dt": 0.1, "horizon": 0.4, **options}
    workspace = {x: (-1.0, 1.0), y: (-1.0, 1.0)}
    return state_problem(system, 0.9 - x**2 - y**2, workspace=workspace, **given)


PROBLEMS = {
    "edges on cells": lambda: (scalar(barriers=x * (2 - x)), (40,)),
    "drift": lambda: (scalar(sp.sin(3 * x)), (60,)),
    "noise of the state": lambda: (scalar(-x, 0.2 + 0.3 * x**2), (60,)),
    "no noise": lambda: (scalar(x, 0), (50,)),
    "inputs not in proportion": lambda: (scalar(0, 0.3, gain=sp.cos(x) + 0.5), (30,)),
    "two coordinates": lambda: (plane(), (24, 20)),
    "noise of the plane": lambda: (plane(((0.3 * y, 0), (0.1, 0.2))), (12, 12)),
    "a goal": lambda: (scalar(1, goal=x - 1.5), (50,)),
}


@pytest.mark.parametrize("name", PROBLEMS)
def test_true_tables_are_certified_and_raised_or_lowered_cells_are_not(name):
    problem, cells = PROBLEMS[name]()
    table = solved(problem, *cells, inputs=5)
    found = check_table(table, problem)
    assert found.unchecked == ""
    assert found.upper is not None
    assert found.later[1] is not None
    assert 0.0 <= found.later[0] <= found.lower < 1e-7
    assert 0.0 <= found.later[1] <= found.upper < 1e-7
    for envelope, sign in (("lower", 1), ("upper", -1)):
        values = np.array(getattr(table, envelope))
        k, cell = _inner(values, sign)
        values[k, cell] += np.float32(sign * 1e-3)
        wrong = replace(table, **{envelope: values})
        told = f"k = {k + table.first} on cell {cell}, .* the {envelope} envelope"
        with pytest.raises(TableRefusedError, match=told):
            check_table(wrong, problem)


def _inner(values: np.ndarray, sign: int) -> tuple[int, int]:
    """Return a place, not far from K, at which a value can be changed but must not be."""
    k = len(values) - 4
    inner = (values[k] > 0.002) & (values[k] < 0.998)
    if not inner.any():
        inner = (values[k] < 0.5) & (values[-1] > 0.5) if sign > 0 else values[k] > 0.5
    cells = np.flatnonzero(inner)
    return k, int(cells[len(cells) // 2])


def exact_deficit(table, cell: int, low_of_c: float) -> Any:
    """Return L_0 - max E L_1 on a cell of dx = u dt + .4 dW with steps of .1, C = (low_of_c, 2)."""
    with mpmath.workdps(30):
        edges = [mpmath.mpf(float(e)) for e in table.grid.axes[0].edges]
        values = [
            mpmath.mpf(float(value)) * (e >= low_of_c)
            for value, e in zip(table.lower[1], edges[:-1], strict=True)
        ]
        step, size = mpmath.mpf(0.1), mpmath.mpf(0.4) * mpmath.sqrt(mpmath.mpf(0.1))
        bounds = []
        for u in map(float, table.inputs[:, 0]):
            low, high = (edges[i] + step * u for i in (cell, cell + 1))
            total, last = mpmath.mpf(0), mpmath.mpf(0)
            for value, e in zip([*values, 0], edges, strict=True):
                rise = value - last
                total += rise * mpmath.ncdf(((low if rise > 0 else high) - e) / size)
                last = value
            bounds.append(total)
        return mpmath.mpf(float(table.lower[0, cell])) - max(bounds)


def test_deficits_are_no_less_than_those_of_exact_arithmetic(monkeypatch):
    monkeypatch.setattr(proved, "TOLERANCE", 1.0)
    problem = scalar(barriers=x - sp.Rational(1, 64), horizon=0.2)
    table = solved(problem, 200, inputs=3)
    lower = np.array(table.lower)
    cell = int(np.abs(lower[0] - 0.5).argmin())
    lower[0, cell] += np.float32(0.25)
    raised = replace(table, lower=lower)
    true, found = exact_deficit(raised, cell, 1 / 64), check_table(raised, problem, upper=False)
    # The means' grid loses a little besides, and so did the table.
    assert 0.15 < true <= found.lower < 0.2500002
    assert found.lower - true == pytest.approx(-exact_deficit(table, cell, 1 / 64), abs=1e-6)


def test_starts_are_certified_by_a_proved_step_of_look_ahead():
    problem = plane()
    table = solved(problem, 40, 40, inputs=5)
    look = LookAhead(table, problem)
    proved = ProvedStarts(table, problem, check_table(table, problem), look)
    starts = tuple(np.random.default_rng(0).uniform(-1, 1, (2, 300)))
    computed, certified = look.start_bounds(starts), proved.start_bounds(starts)
    assert (certified[0] <= computed[0] + 1e-7).all()
    assert (certified[1] >= computed[1] - 1e-7).all()
    assert np.abs(np.array(certified) - computed).max() < 1e-6
    assert (certified[0][starts[0] ** 2 + starts[1] ** 2 > 0.9] == 0).all()


@pytest.mark.parametrize("drift", [0, sp.sin(3 * x)])
def test_certified_bounds_are_around_the_value(drift):
    problem = scalar(drift)
    table = solved(problem, 160, inputs=5)
    q, exact = quadrature(problem, np.linspace(-1, 1, 5), (0.0, 2.0))
    _, most = quadrature(problem, np.linspace(-1, 1, 33), (0.0, 2.0))
    look = LookAhead(table, problem)
    proved = ProvedStarts(table, problem, check_table(table, problem), look)
    lower, upper = proved.start_bounds((q,))
    assert (lower <= exact[0] + 1e-9).all()
    assert (upper >= most[0] - 1e-9).all()
    assert (upper - lower).mean() < 0.1


def test_an_upper_envelope_is_not_checked_where_it_cannot_be():
    problem = scalar()
    table = solved(problem, 40, inputs=3, leaving="safe")
    found = check_table(table, problem)
    assert found.upper is None
    assert "leaving" in found.unchecked
    assert (
        check_table(solved(problem, 40), problem, upper=False).unchecked == "it was not asked for"
    )


def test_a_grid_that_misses_safe_states_has_no_upper_envelope():
    problem = scalar()
    table = solved(problem, 40, inputs=3)
    grid = replace(
        table.grid, axes=(replace(table.grid.axes[0], edges=table.grid.axes[0].edges[:-4]),)
    )
    cut = replace(table, grid=grid, lower=0 * table.lower[:, :-4], upper=table.upper[:, :-4])
    assert "outside of the grid" in check_table(cut, problem).unchecked


def test_a_file_is_checked(tmp_path):
    problem = scalar()
    table = solved(problem, 20, inputs=3)
    save_table(table, tmp_path / "table.npz")
    found = check_table_file(tmp_path / "table.npz", problem)
    assert replace(found, seconds=0) == replace(check_table(table, problem), seconds=0)
    with pytest.raises(ConfigurationError, match=r"table\.npz"):
        check_table_file(tmp_path / "table.npz", scalar(s=0.5))


def test_other_problems_and_tables_are_refused():
    problem = scalar()
    table = solved(problem, 20, inputs=3)
    with pytest.raises(ConfigurationError, match="another problem"):
        check_table(table, scalar(s=0.5))
    specified = solved(problem, 20, inputs=3, specification="always safe")
    with pytest.raises(ConfigurationError, match="specification 'always safe'"):
        check_table(specified, problem)
    system = ControlAffineSDE((x, y), (u,), [y, -y], [[1], [0]], [[0.3], [0]])
    moving = state_problem(
        system,
        1 - x**2,
        box=(-1.0, 1.0),
        start=(0.0, 1.0),
        dt=0.1,
        horizon=0.3,
        workspace={x: (-2.0, 2.0), y: (-2.0, 2.0)},
    )
    with pytest.raises(ConfigurationError, match=r"known in advance \(y\)"):
        check_table(solved(moving, 20, inputs=3), moving)
    for value in (1.5, np.nan, -0.5):
        upper = np.array(table.upper)
        upper[-1, 3] = value
        with pytest.raises(TableRefusedError, match="not in"):
            check_table(replace(table, upper=upper), problem)
    short = replace(table, first=0, lower=table.lower[1:], upper=table.upper[1:])
    with pytest.raises(ConfigurationError, match="steps"):
        check_table(short, problem)
