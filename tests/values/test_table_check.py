"""Tables that are envelopes are certified, and others are refused."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import mpmath
import numpy as np
import pytest
import sympy as sp

from safe_envs import ConfigurationError, ControlAffineSDE, define_problem
from safe_envs.values import proved
from safe_envs.values.look_ahead import LookAhead
from safe_envs.values.proved import ProvedStarts, TableRefusedError, check_table, check_table_file
from safe_envs.values.tables import save_table
from tests.values.systems import quadrature, scalar, solved, u, x, y

pytestmark = pytest.mark.filterwarnings("ignore:the input bounds")
R = sp.Rational
ANGLE = {"workspace": {}, "units": {x: "rad"}, "barriers": sp.cos(x) + 0.5, "start": (0.1,)}


def plane(sigma=((0.3, 0), (0, 0.2)), **options):
    system = ControlAffineSDE(
        (x, y), (u,), [y, -sp.sin(x)], [[0], [1]], [[sp.sympify(a) for a in row] for row in sigma]
    )
    given = {"input_bounds": (-1.0, 1.0), "start": (0.0, 0.0), "dt": 0.1, "horizon": 0.3, **options}
    workspace = {x: (-1.0, 1.0), y: (-1.0, 1.0)}
    return define_problem(system, 0.9 - x**2 - y**2, workspace=workspace, **given)


PROBLEMS = {
    "edges on cells": lambda: (scalar(barriers=x * (2 - x)), (40,)),
    "drift": lambda: (scalar(sp.sin(3 * x)), (60,)),
    "noise of the state": lambda: (scalar(-x, 0.2 + 0.3 * x**2), (60,)),
    "no noise": lambda: (scalar(x, 0), (50,)),
    "inputs not in proportion": lambda: (scalar(0, 0.3, gain=sp.cos(x) + 0.5), (30,)),
    "two coordinates": lambda: (plane(), (24, 20)),
    "noise of the plane": lambda: (plane(((0.3 * y, 0), (0.1, 0.2))), (12, 12)),
    "a goal": lambda: (scalar(1, goal=x - 1.5), (50,)),
    "an angle": lambda: (scalar(sp.sin(x) / 2, **ANGLE), (40,)),
    "an angle, noise of the state": lambda: (scalar(0, 0.3 + sp.cos(x) / 10, **ANGLE), (40,)),
    "a point is missing": lambda: (scalar(barriers=sp.Abs(x - R(1, 2)), start=(0.7,)), (30,)),
    "two parts": lambda: (scalar(barriers=sp.Abs(x) - R(1, 10), s=0.1), (60,)),
}


def _inner(values: np.ndarray, sign: int) -> tuple[int, int]:
    """Return a place, not far from K, at which a value can be changed but must not be."""
    k = len(values) - 3
    inner = (values[k] > 0.022) & (values[k] < 0.978)
    if not inner.any():
        inner = (values[k] < 0.5) & (values[-1] > 0.5) if sign > 0 else values[k] > 0.5
    cells = np.flatnonzero(inner)
    return k, int(cells[len(cells) // 2])


@pytest.mark.parametrize("name", PROBLEMS)
def test_true_tables_are_certified_and_raised_or_lowered_cells_are_not(name):
    problem, cells = PROBLEMS[name]()
    problem = replace(problem, horizon=0.4)
    table = solved(problem, *cells, inputs=5)
    check = check_table(table, problem)
    assert check.unchecked == ""
    assert check.upper is not None
    assert check.later[1] is not None
    assert 0.0 <= check.later[0] <= check.lower < 1e-7
    assert 0.0 <= check.later[1] <= check.upper < 1e-7
    for envelope, sign in (("lower", 1), ("upper", -1)):
        values = np.array(getattr(table, envelope))
        k, cell = _inner(values, sign)
        # Of cells next to a missing point a check knows more than the table.
        values[k, cell] += np.float32(sign * (0.02 if name == "a point is missing" else 1e-3))
        wrong = replace(table, **{envelope: values})
        place = f"k = {k + table.first} on cell {cell}, .* {envelope}"
        with pytest.raises(TableRefusedError, match=place):
            check_table(wrong, problem)


# The step x + dt (f + g u) + sqrt(dt) s w of each problem, with many digits, and its safe set.
STEPS = {
    "plain": ({}, lambda q: (0, 1, mpmath.mpf(0.4)), [(0, 2)]),
    "drift": ({"drift": x / 4}, lambda q: (q / 4, 1, mpmath.mpf(0.4)), [(0, 2)]),
    "noise of the state": (
        {"drift": -x, "sigma": R(1, 4) + x**2 / 4},
        lambda q: (-q, 1, mpmath.mpf(1) / 4 + q**2 / 4),
        [(0, 2)],
    ),
    "gain": (
        {"gain": x / 2 - R(1, 4)},
        lambda q: (0, q / 2 - mpmath.mpf(1) / 4, mpmath.mpf(0.4)),
        [(0, 2)],
    ),
    "angle": (
        {**ANGLE, "s": 2.5},
        lambda q: (0, 1, mpmath.mpf(2.5)),
        [(-mpmath.acos(-0.5), mpmath.acos(-0.5))],
    ),
}


def exact_deficit(name: str, table: Any, cell: int, sign: int) -> Any:
    """Return by how much an envelope breaks Bellman's inequality on a cell, at least, from k = 0.

    Args:
        name: of the step.
        table: of it, with one row ahead.
        cell: whose points are looked at.
        sign: 1 for the lower envelope and the inputs of the table, -1 for the upper one and others.
    """
    _, step, safe = STEPS[name]
    with mpmath.workdps(30):
        (axis,), two_pi = table.grid.axes, 2 * mpmath.pi
        edges = [mpmath.mpf(float(e)) for e in axis.edges]
        if axis.period:
            edges[0], edges[-1] = -mpmath.pi, mpmath.pi
        values = (table.lower if sign > 0 else table.upper)[1]
        cuts = sorted({*edges, *[mpmath.mpf(e) for ends in safe for e in ends]})
        pieces = []
        for a, b in itertools.pairwise(cuts):
            middle = (a + b) / 2
            if edges[0] < middle < edges[-1] and any(low < middle < high for low, high in safe):
                place = int(np.searchsorted(axis.edges, float(middle), side="right")) - 1
                pieces.append((a, b, mpmath.mpf(float(values[place]))))
        worst = mpmath.mpf("-inf")
        inputs = table.inputs[:, 0] if sign > 0 else np.linspace(-1, 1, 9)
        for share in (1e-9, 0.5, 1 - 1e-9):
            q = edges[cell] + share * (edges[cell + 1] - edges[cell])
            drift, gain, size = step(q)
            size = size * mpmath.sqrt(mpmath.mpf(0.1))
            best = mpmath.mpf(0)
            for given in inputs:
                mean = q + mpmath.mpf(0.1) * (drift + gain * mpmath.mpf(float(given)))
                total = mpmath.mpf(0)
                for turn in range(-4, 5) if axis.period else (0,):
                    shift = turn * two_pi - mean
                    for a, b, value in pieces:
                        total += value * (
                            mpmath.ncdf((b + shift) / size) - mpmath.ncdf((a + shift) / size)
                        )
                best = max(best, total)
            own = mpmath.mpf(float((table.lower if sign > 0 else table.upper)[0, cell]))
            worst = max(worst, own - best if sign > 0 else best - own)
        return worst


@pytest.mark.parametrize("name", STEPS)
def test_deficits_are_no_less_than_those_of_exact_arithmetic(name, monkeypatch):
    monkeypatch.setattr(proved, "TOLERANCE", 1.0)
    problem = scalar(horizon=0.2, **STEPS[name][0])
    table = solved(problem, 24, inputs=3)
    for envelope, sign in (("lower", 1), ("upper", -1)):
        values = np.array(getattr(table, envelope))
        cell = int(np.abs(values[0] - 0.5).argmin())
        before = exact_deficit(name, table, cell, sign)
        assert before < 1e-8
        values[0, cell] += np.float32(sign * 0.25)
        false = replace(table, **{envelope: values})
        true, check = exact_deficit(name, false, cell, sign), check_table(false, problem)
        told = check.lower if sign > 0 else check.upper
        # Some is lost between the points of a cell, and so did the table.
        assert true == pytest.approx(float(before) + 0.25, abs=1e-6)
        assert float(true) <= told <= 0.2500002


@pytest.mark.parametrize(
    ("make", "cells"), [(lambda: scalar(sp.sin(3 * x)), (120,)), (plane, (30, 30))]
)
def test_starts_are_certified_by_a_proved_step_of_look_ahead(make, cells):
    problem = make()
    table = solved(problem, *cells, inputs=5)
    look = LookAhead(table, problem)
    starts = tuple(np.random.default_rng(0).uniform(-1, 1.9, (len(cells), 200)))
    computed = look.start_bounds(starts)
    certain = ProvedStarts(table, problem, check_table(table, problem), look)
    certified = certain.start_bounds(starts)
    assert (certified[0] <= computed[0] + 1e-7).all()
    assert (certified[1] >= computed[1] - 1e-7).all()
    assert np.abs(np.array(certified) - computed).max() < 1e-6
    if len(cells) == 2:
        assert (certified[0][starts[0] ** 2 + starts[1] ** 2 > 0.9] == 0).all()
        return
    q, exact = quadrature(problem, np.linspace(-1, 1, 5), (0.0, 2.0))
    _, most = quadrature(problem, np.linspace(-1, 1, 33), (0.0, 2.0))
    lower, upper = ProvedStarts(table, problem, check_table(table, problem), look).start_bounds(
        (q,)
    )
    assert (lower <= exact[0] + 1e-9).all()
    assert (upper >= most[0] - 1e-9).all()
    assert (upper - lower).mean() < 0.13


def test_an_upper_envelope_is_not_checked_where_it_cannot_be():
    problem = scalar()
    table = solved(problem, 40, inputs=3)
    assert check_table(table, problem, upper=False).upper is None
    leaving = check_table(solved(problem, 40, inputs=3, leaving="safe"), problem)
    assert leaving.upper is None
    assert "leaving" in leaving.unchecked
    # A grid that misses safe states.
    (axis,) = table.grid.axes
    for edges, kept in ((axis.edges[:-4], slice(None, -4)), (axis.edges[4:], slice(4, None))):
        grid = replace(table.grid, axes=(replace(axis, edges=edges),))
        cut = replace(table, grid=grid, lower=0 * table.lower[:, kept], upper=table.upper[:, kept])
        assert "outside of the grid" in check_table(cut, problem).unchecked


def test_a_file_is_checked(tmp_path):
    problem = scalar()
    table = solved(problem, 20, inputs=3)
    save_table(table, tmp_path / "table.npz")
    check = check_table_file(tmp_path / "table.npz", problem)
    assert replace(check, seconds=0) == replace(check_table(table, problem), seconds=0)
    with pytest.raises(ConfigurationError, match=r"table\.npz"):
        check_table_file(tmp_path / "table.npz", scalar(s=0.5))


def moving():
    system = ControlAffineSDE((x, y), (u,), [y, -y], [[1], [0]], [[0.3], [0]])
    return define_problem(
        system,
        1 - x**2,
        input_bounds=(-1.0, 1.0),
        start=(0.0, 1.0),
        dt=0.1,
        horizon=0.3,
        workspace={x: (-2.0, 2.0), y: (-2.0, 2.0)},
    )


@pytest.mark.parametrize(
    ("make", "settings", "checked", "fragment"),
    [
        (scalar, {}, lambda: scalar(s=0.5), "another problem"),
        (scalar, {"specification": "always safe"}, scalar, "'always safe'"),
        (moving, {}, moving, r"\(y\)"),
    ],
)
def test_other_problems_and_tables_are_refused(make, settings, checked, fragment):
    with pytest.raises(ConfigurationError, match=fragment):
        check_table(solved(make(), 20, inputs=3, **settings), checked())


@pytest.mark.parametrize(
    ("change", "error"),
    [
        *(
            (lambda t, value=value: {"upper": np.where(np.arange(21) == 3, value, t.upper)},
             TableRefusedError)
            for value in (1.5, np.nan, -0.5)
        ),
        (lambda t: {"first": 0, "lower": t.lower[1:], "upper": t.upper[1:]}, ConfigurationError),
    ],
)  # fmt: skip
def test_arrays_that_are_no_envelopes_are_refused(change, error):
    problem = scalar()
    table = solved(problem, 20, inputs=3)
    with pytest.raises(error):
        check_table(replace(table, **change(table)), problem)
