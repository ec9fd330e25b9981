"""Several rows through ProxQP: exact where the rows can be met, least-violating and flagged where not."""

from __future__ import annotations

import itertools

import numpy as np
import scipy.optimize

from wrappers.qp.several_rows import project


def active_set_oracle(a, b, v, low, high, w):
    """The minimiser by trying every set of active constraints (rows and ends of the box); None if there is none."""
    m = len(v)
    rows = np.vstack([a, np.eye(m), -np.eye(m)])
    offsets = np.concatenate([b, -low, high])
    best, best_cost = None, np.inf
    for count in range(m + 1):
        for chosen in itertools.combinations(range(len(rows)), count):
            r, o = rows[list(chosen)], offsets[list(chosen)]
            kkt = np.block([[np.diag(w), -r.T], [r, np.zeros((count, count))]])
            if count and np.linalg.matrix_rank(r) < count:
                continue
            u = np.linalg.solve(kkt, np.concatenate([w * v, -o]))[:m]
            if np.all(rows @ u + offsets >= -1e-9) and (cost := np.sum(w * (u - v) ** 2)) < best_cost:
                best, best_cost = u, cost
    return best


def random_batch(rng, size, k, m):
    a = rng.normal(size=(size, k, m))
    b = rng.normal(size=(size, k)) * 0.7
    return a, b, rng.normal(size=(size, m)) * 2, -np.ones(m), np.array([1.0, 1.5, 2.0])[:m], np.array([1.0, 2.0, 0.5])[:m]


def test_equals_the_active_set_oracle():
    rng = np.random.default_rng(0)
    for k, m in ((2, 1), (2, 2), (3, 2), (2, 3)):
        a, b, v, low, high, w = random_batch(rng, 150, k, m)
        found = project(a, b, v, low, high, w)
        assert np.all((found.u >= low) & (found.u <= high))
        seen = set()
        for i in range(len(a)):
            best = active_set_oracle(a[i], b[i], v[i], low, high, w)
            assert found.feasible[i] == (best is not None)
            seen.add(bool(found.feasible[i]))
            if best is not None:
                np.testing.assert_allclose(found.u[i], best, atol=1e-6)
                assert found.margin[i].min() > -1e-6
        assert seen == {True, False}


def test_contradicting_rows_give_the_least_sum_of_squared_slacks():
    rng = np.random.default_rng(1)
    a, b, v, low, high, w = random_batch(rng, 200, 3, 2)
    b -= 1.5
    found = project(a, b, v, low, high, w)
    assert (~found.feasible).sum() > 50
    for i in np.flatnonzero(~found.feasible):

        def loss(u, i=i):
            return np.sum(np.minimum(a[i] @ u + b[i], 0.0) ** 2)

        reference = scipy.optimize.minimize(loss, np.zeros(2), bounds=list(zip(low, high, strict=True)), tol=1e-14)
        assert loss(found.u[i]) <= reference.fun + 1e-6 * (1 + reference.fun)


def test_flat_row_beside_an_active_one_does_not_switch_the_filter_off():
    # A fault seen in a peer: L_g h = 0 in one row, and the other one was ignored.
    a = np.array([[[0.0, 0.0], [1.0, 0.0]]])
    low, high, w = -np.ones(2), np.ones(2), np.ones(2)
    met = project(a, np.array([[0.5, -0.5]]), np.zeros((1, 2)), low, high, w)
    np.testing.assert_allclose(met.u, [[0.5, 0.0]], atol=1e-6)
    assert met.feasible.tolist() == [True]
    unmet = project(a, np.array([[-0.5, -0.5]]), np.zeros((1, 2)), low, high, w)
    np.testing.assert_allclose(unmet.u, [[0.5, 0.0]], atol=1e-5)
    assert unmet.feasible.tolist() == [False]


def test_duplicate_rows_and_opposite_rows():
    low, high, w = -np.ones(2), np.ones(2), np.ones(2)
    a = np.array([[[1.0, 1.0], [1.0, 1.0]], [[1.0, 0.0], [-1.0, 0.0]], [[1.0, 0.0], [-1.0, 0.0]]])
    b = np.array([[-1.0, -1.0], [-0.3, 0.3], [-0.5, 0.1]])
    found = project(a, b, np.zeros((3, 2)), low, high, w)
    np.testing.assert_allclose(found.u, [[0.5, 0.5], [0.3, 0.0], [0.3, 0.0]], atol=1e-5)
    assert found.feasible.tolist() == [True, True, False]


def test_units_of_very_different_size():
    # Forces of thousands of newtons against rows of thousandths: the thesis' cruise control has these.
    a = np.array([[[-1.1e-3, 0.0], [2.0e-4, 1.0]]])
    b = np.array([[-2.0, 0.2]])
    low, high, w = np.array([-5000.0, -1.0]), np.array([5000.0, 1.0]), np.ones(2)
    found = project(a, b, np.array([[4000.0, 0.0]]), low, high, w)
    assert found.feasible.tolist() == [True]
    u1 = -2.0 / 1.1e-3
    np.testing.assert_allclose(found.u, [[u1, -0.2 - 2.0e-4 * u1]], rtol=1e-4)
