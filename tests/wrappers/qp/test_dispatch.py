"""The dispatcher, and three and more inputs: exact where the rows can be met,
least-violating and flagged where not."""

from __future__ import annotations

import itertools
import subprocess
import sys

import numpy as np
import pytest
import scipy.optimize

from safe_envs.engine.qp import proxqp
from safe_envs.engine.qp.dispatch import SOLVERS, project_arrays, project_floats


def active_set_oracle(a, b, v, low, high, w):
    """The minimiser by trying every set of active constraints (rows and ends of the box); None if
    there is none."""
    m = len(v)
    rows, offsets = np.vstack([a, np.eye(m), -np.eye(m)]), np.concatenate([b, -low, high])
    best, best_cost = (v, 0.0) if np.all(rows @ v + offsets >= 0.0) else (None, np.inf)
    for count in range(1, m + 1):
        chosen = np.array(list(itertools.combinations(range(len(rows)), count)))
        r, o = rows[chosen], offsets[chosen]
        gram = (r / w) @ r.transpose(0, 2, 1)
        regular = np.abs(np.linalg.det(gram)) > 1e-12
        r, o, gram = r[regular], o[regular], gram[regular]
        multiplier = np.linalg.solve(gram, -(r @ v + o)[:, :, None])[:, :, 0]
        u = v + np.einsum("ci,cim->cm", multiplier, r) / w
        met = np.all(u @ rows.T + offsets >= -1e-9, axis=1)
        cost = np.where(met, (w * (u - v) ** 2).sum(axis=1), np.inf)
        if len(cost) and cost.min() < best_cost:
            best, best_cost = u[cost.argmin()], cost.min()
    return best


def random_batch(rng, size, k, m):
    a = rng.normal(size=(size, k, m))
    b = rng.normal(size=(size, k)) * (0.7 if k > 1 else 2.5)
    low, high = -rng.uniform(0.5, 1.5, (size, m)), rng.uniform(0.5, 2.0, (size, m))
    return a, b, rng.normal(size=(size, m)) * 2, low, high, rng.uniform(0.5, 2.0, (size, m))


def solve(a, b, v, low, high, w, priority=None, solver="daqp"):
    rows = [[a[:, i, j] for j in range(a.shape[2])] for i in range(a.shape[1])]
    *parts, feasible = project_arrays(
        rows,
        list(b.T),
        list(v.T),
        list(low.T),
        list(high.T),
        list(w.T),
        priority or [1.0] * a.shape[1],
        solver,
    )
    u, margin, active = [np.array(part).T for part in parts]
    assert np.all((u >= low) & (u <= high))
    return u, margin, active, feasible


def floats(*problem):
    return [np.asarray(part).tolist() for part in problem]


@pytest.mark.parametrize(("k", "m"), [(2, 3), (3, 3), (2, 4), (4, 4), (3, 2), (1, 2), (1, 4)])
def test_equals_the_active_set_oracle(k, m):
    problem = random_batch(np.random.default_rng(10 * k + m), 100, k, m)
    u, margin, active, feasible = solve(*problem)
    seen = set()
    for i, (a, b, v, low, high, w) in enumerate(zip(*problem, strict=True)):
        best = active_set_oracle(a, b, v, low, high, w)
        seen.add(bool(feasible[i]))
        assert feasible[i] == (best is not None)
        if best is not None:
            np.testing.assert_allclose(u[i], best, atol=1e-6)
            assert margin[i].min() > -1e-6
            idle = np.all(a @ np.clip(v, low, high) + b >= 0.0)
            np.testing.assert_array_equal(active[i], (margin[i] < 1e-6) & ~idle)
    assert seen == {True, False}


@pytest.mark.parametrize(("k", "m"), [(3, 3), (5, 4)])
def test_contradicting_rows_give_the_least_sum_of_squared_slacks(k, m):
    rng = np.random.default_rng(k)
    a, b, v, low, high, w = random_batch(rng, 60, k, m)
    b -= 2.5
    priority = [1.0, 20.0, 0.5, 3.0, 1.0][:k]
    u, margin, active, feasible = solve(a, b, v, low, high, w, priority)
    assert (~feasible).sum() > 30
    for i in np.flatnonzero(~feasible):

        def loss(u, i=i):
            missed = np.minimum(a[i] @ u + b[i], 0.0)
            return np.sum(priority * missed**2), 2.0 * (priority * missed) @ a[i]

        bounds = list(zip(low[i], high[i], strict=True))
        reference = scipy.optimize.minimize(loss, np.zeros(m), jac=True, bounds=bounds, tol=1e-14)
        assert loss(u[i])[0] <= reference.fun + 1e-5 * (1 + reference.fun)
        assert np.all(active[i][margin[i] < -1e-6])


def test_floats_equal_arrays():
    for k, m in ((2, 3), (1, 1), (1, 3)):
        problem = random_batch(np.random.default_rng(1), 40, k, m)
        u, margin, active, feasible = solve(*problem)
        for i, (a, b, v, low, high, w) in enumerate(zip(*problem, strict=True)):
            found = project_floats(*floats(a, b, v, low, high, w), [1.0] * k)
            np.testing.assert_allclose(found[0], u[i], atol=1e-9)
            np.testing.assert_allclose(found[1], margin[i], atol=1e-9)
            assert (found[2], found[3]) == (active[i].tolist(), feasible[i])
            assert isinstance(found[3], bool)


@pytest.mark.parametrize("m", [1, 2, 3])
def test_flat_row_beside_an_active_one_does_not_switch_the_filter_off(m):
    # A fault seen in a peer: L_g h = 0 in one row, and the other one was ignored.
    a = [[0.0] * m, [1.0] + [0.0] * (m - 1)]
    box = ([0.0] * m, [-1.0] * m, [1.0] * m, [1.0] * m, [1.0, 1.0])
    for value, feasible in ((0.5, True), (-0.5, False)):
        u, _, active, met = project_floats(a, [value, -0.5], *box)
        np.testing.assert_allclose(u, [0.5] + [0.0] * (m - 1), atol=1e-6)
        assert (active, met) == ([not feasible, True], feasible)


def test_duplicate_rows_and_opposite_rows_of_three_inputs():
    box = ([0.0] * 3, [-1.0] * 3, [1.0] * 3, [1.0] * 3, [1.0, 1.0])
    for a, b, u, feasible in (
        ([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0]], [-1.0, -1.0], [0.5, 0.5, 0.0], True),
        ([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]], [-0.3, 0.3], [0.3, 0.0, 0.0], True),
        ([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]], [-0.5, 0.1], [0.3, 0.0, 0.0], False),
    ):
        found = project_floats(a, b, *box)
        np.testing.assert_allclose(found[0], u, atol=1e-5)
        assert found[3] == feasible


def test_row_of_higher_priority_gives_way_by_as_much_less():
    rows = [[1.0, 0.3, 0.0], [-1.0, -0.3, 0.0]]
    _, margin, _, feasible = project_floats(
        rows, [-0.5, 0.0], [0.0] * 3, [-1.0] * 3, [1.0] * 3, [1.0] * 3, [1e4, 1.0]
    )
    assert not feasible
    assert margin[0] / margin[1] == pytest.approx(1e-4, rel=0.01)


@pytest.mark.parametrize("m", [2, 3])
def test_units_of_very_different_size(m):
    # Forces of thousands of newtons against rows of thousandths: the thesis' cruise control has
    # these.
    rest = [0.0] * (m - 2)
    found = project_floats(
        [[-1.1e-3, 0.0, *rest], [2.0e-4, 1.0, *rest]],
        [-2.0, 0.2],
        [4000.0, 0.0, *rest],
        [-5000.0, -1.0, *[-1.0] * (m - 2)],
        [5000.0, 1.0, *[1.0] * (m - 2)],
        [1.0] * m,
        [1.0, 1.0],
    )
    assert found[3]
    u1 = -2.0 / 1.1e-3
    np.testing.assert_allclose(found[0], [u1, -0.2 - 2.0e-4 * u1, *rest], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("half", [1e6, 1e30, 1e100])
def test_endless_boxes_of_three_inputs_hide_no_row(half):
    problem = [[1.0, 0.5, 0.0], [0.0, 1.0, 1.0]], [-3.0, -1.0], [0.0, 0.0, 0.0]
    found = project_floats(*problem, [-half] * 3, [half] * 3, [1.0, 2.0, 1.0], [1.0, 1.0])
    wide = np.full(3, 50.0)
    best = active_set_oracle(*map(np.array, problem), -wide, wide, np.array([1.0, 2.0, 1.0]))
    np.testing.assert_allclose(found[0], best, atol=1e-5)
    assert found[2:] == ([True, True], True)
    contradicting = project_floats(
        [[1.0, 0.5, 0.0], [-1.0, -0.5, 0.0]],
        [-3.0, 1.0],
        [0.0] * 3,
        [-half] * 3,
        [half] * 3,
        [1.0] * 3,
        [1.0, 1.0],
    )
    np.testing.assert_allclose(contradicting[0], [1.6, 0.8, 0.0], atol=1e-4)
    assert not contradicting[3]


def test_flat_rows_of_many_inputs_are_exact():
    # Met or not by their sign alone, beside rows that the solver meets to its precision only.
    rows, box = (
        [[1.0, 0.2, 0.0], [0.3, 1.0, 0.1], [0.0, 0.0, 0.0]],
        ([0.0] * 3, [-1.0] * 3, [1.0] * 3, [1.0] * 3, [1.0] * 3),
    )
    for flat, met in ((-1e-12, False), (0.0, True), (1e-12, True), (-5.0, False)):
        u, margin, active, feasible = project_floats(rows, [-0.5, -0.5, flat], *box)
        assert feasible is met
        assert (margin[2], active[2]) == (flat, not met)
        np.testing.assert_allclose(
            u, project_floats(rows[:2], [-0.5, -0.5], *box[:4], [1.0] * 2)[0], atol=1e-9
        )


@pytest.mark.parametrize("gap", [1e-6, 1.0, 100.0])
def test_opposite_constraints_share_what_is_missing(gap):
    # s >= gap and -2 s >= 2 gap for s = u_1 + u_2, with the priorities 1 and 3/4, beside an input
    # on which no row depends.
    rows, offsets = [[1.0, 1.0, 0.0], [-2.0, -2.0, 0.0]], [-gap, -2.0 * gap]
    ends = [-1000.0] * 3, [1000.0] * 3
    u, margin, _, feasible = project_floats(
        rows, offsets, [0.0, 0.0, 5.0], *ends, [1.0] * 3, [1.0, 0.75]
    )
    # The sum (gap - s)^2 + 3 (gap + s)^2 is least at s = -gap/2.
    np.testing.assert_allclose(u, [-gap / 4, -gap / 4, 5.0], rtol=1e-12)
    np.testing.assert_allclose(margin, [-1.5 * gap, -gap], rtol=1e-12)
    assert not feasible


@pytest.mark.parametrize(("k", "m"), [(2, 3), (3, 4), (6, 4)])
def test_proxqp_is_of_the_same_opinion(k, m, monkeypatch):
    problem = random_batch(np.random.default_rng(k), 60, k, m)
    proposals = []
    propose = proxqp.propose

    def counted(qps):
        proposals.append(qps.b.shape[1])
        return propose(qps)

    monkeypatch.setattr(proxqp, "propose", counted)
    fast, slow = [solve(*problem, solver=solver) for solver in SOLVERS]
    for one, other in zip(fast[:2], slow[:2], strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-11)
    for one, other in zip(fast[2:], slow[2:], strict=True):
        np.testing.assert_array_equal(one, other)
    single = floats(*[part[0] for part in problem])
    found = project_floats(*single, [1.0] * k, "proxqp")
    np.testing.assert_allclose(found[0], fast[0][0], rtol=1e-11, atol=1e-11)
    assert len(proposals) == 2
    assert proposals[0] > 10


def test_a_constraint_that_moves_the_action_is_active_however_far_the_proposal():
    rng = np.random.default_rng(5)
    a, b, v, low, high, w = random_batch(rng, 200, 2, 3)
    _, margin, active, feasible = solve(a, b, 1e3 * v, low, high, w)
    inside = np.clip(1e3 * v, low, high)
    missed = (np.einsum("nij,nj->ni", a, inside) + b < 0.0).any(axis=1)
    assert np.count_nonzero(missed & feasible) > 50
    assert active[missed].any(axis=1).all()
    assert np.all(margin[feasible] > -1e-12)


_LATE = """
import sys
import numpy as np
from safe_envs.engine.qp import dispatch
for k, m in ((1, 2), (3, 1), (3, 2), (3, 4)):
    for solver in dispatch.SOLVERS:
        rng = np.random.default_rng(0)
        dispatch.prepare(k, m, solver)
        known = set(sys.modules)
        for shift in (0.0, 5.0):
            a, b, v = rng.normal(size=(k, m)), rng.normal(size=k) - shift, rng.normal(size=m)
            ends = [-1.0] * m, [1.0] * m, [1.0] * m, [1.0] * k
            dispatch.project_floats(a.tolist(), b.tolist(), v.tolist(), *ends, solver)
            many = [np.full(20, c) for c in v]
            dispatch.project_arrays(a.tolist(), b.tolist(), many, *ends, solver)
        late = set(sys.modules) - known
        assert not late, (k, m, solver, late)
"""


@pytest.mark.parametrize("exponent", [100, 170, 200, 290])
def test_rows_whose_squares_vanish_are_exact_for_one_state_and_for_a_batch(exponent):
    rows = [[0.9, 0.4, 1.2, 1.2], [-0.14, 1.16, -2.58, 0.67]]
    v, ends = [2.5, -1.7, -1.5, -1.3], ([-1.0] * 4, [1.0] * 4)
    plain = project_floats(rows, [0.0, 0.15], v, *ends, [1.0] * 4, [1.0, 1.0])
    rows[0] = [aj * 10.0**-exponent for aj in rows[0]]
    found = project_floats(rows, [0.0, 0.15], v, *ends, [1.0] * 4, [1.0, 1.0])
    proposed = [np.full(12, vj) for vj in v]
    u, _, _, feasible = project_arrays(rows, [0.0, 0.15], proposed, *ends, [1.0] * 4, [1.0, 1.0])
    assert plain[3]
    assert found[3]
    assert feasible.all()
    np.testing.assert_allclose(found[0], plain[0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.array(u).T, [plain[0]] * 12, rtol=0, atol=1e-12)


def test_nothing_is_imported_once_a_size_is_prepared():
    run = subprocess.run([sys.executable, "-c", _LATE], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
