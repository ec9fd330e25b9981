"""Constraints that are known up to an error which depends on the input: a u + b >= sqrt([1, u]' Q
[1, u]). One input against a grid, several against the root itself."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from safe_envs.filters.qp import FilterDecision
from safe_envs.wrappers import SafetyFilter
from tests.oracles.programs import decision_of
from tests.oracles.qps import system_of

EPS = float(np.finfo(float).eps)
LOW, HIGH = -2.0, 1.5
GRID = np.linspace(LOW, HIGH, 1751)
KINDS = [
    "plain",
    "singular",
    "sizes",
    "no slope",
    "parabola",
    "integers",
    "input alone",
    "certain",
    "far",
]


def random_rows(rng, k, size, kind):
    """a, b (k, size), q (3, k, size), positive semidefinite up to rounding, and v (size,)."""
    a, b = rng.normal(size=(2, k, size))
    b += rng.choice([0.0, 1.0, 4.0], (k, size))
    factor = rng.normal(size=(k, size, 2, 2))
    factor *= rng.choice([0.0, 1e-3, 0.1, 0.5, 2.0], (k, size, 1, 1))
    v = rng.normal(size=size) * 2
    if kind == "singular":
        factor[..., 1] = 0.0
    if kind == "integers":  # edges, ends and touching rows that coincide exactly
        a, b, factor = (
            rng.integers(-2, end, part.shape) * 1.0 for part, end in ((a, 3), (b, 6), (factor, 2))
        )
        v = rng.integers(-3, 4, size) * 0.5
    form = factor @ factor.swapaxes(2, 3)
    q = np.stack([form[..., 0, 0], form[..., 0, 1], form[..., 1, 1]])
    if kind == "no slope":
        a[:] = 0.0
    if kind == "parabola":
        q[2] = a * a
        q[0] = q[1] ** 2 / q[2] * (1.0 + rng.choice([0.0, 1.0], (k, size)))
    if kind == "input alone":
        q[:2] = 0.0
    if kind == "certain":
        q[:] = 0.0
    if kind == "sizes":
        units = 10.0 ** rng.uniform(-6, 6, (k, size))
        a, b, q = a * units, b * units, q * units**2
    if kind == "far":
        v *= 1e6
    return a, b, q, v


def filter_of(k, m, bounds, priorities=None) -> SafetyFilter:
    """A filter whose states are, for each constraint, a, b, and the entries of its form."""
    system, pairs = system_of(k, m, (m + 1) * (m + 2) // 2)
    return SafetyFilter(system, pairs, input_bounds=bounds, priorities=priorities)


def states_of(a, b, q) -> np.ndarray:
    return (
        np.concatenate([a[:, None], b[:, None], np.moveaxis(q, 0, 1)], axis=1)
        .reshape(-1, a.shape[1])
        .T
    )


def one(a, b, forms, v, low=LOW, high=HIGH, priority=None) -> FilterDecision:
    """The decision on a single state, which that on a batch and that of its program equal."""
    made = filter_of(len(a), 1, (low, high), priority)
    state = states_of(np.array(a)[:, None], np.array(b)[:, None], np.array(forms).T[:, :, None])[0]
    found = made.filter(state, [v])
    batch, program = made.filter(state[None], [[v]]), decision_of(made)(state, [v])
    assert found.action == batch.action[0] == program.action
    assert found.feasible == batch.feasible[0] == program.feasible
    assert (found.margin == batch.margin[0]).all()
    return found


def spread(q, u):
    return np.sqrt(np.maximum(q[0] + u * (2.0 * q[1] + u * q[2]), 0.0))


def sizes(a, b, q, u):
    """Of the terms of each row."""
    return np.abs(a * u) + np.abs(b) + np.sqrt(np.abs(q[0]) + 2.0 * np.abs(q[1] * u) + q[2] * u * u)


def rounding(a, b, q, u):
    """Of a margin: some eps of its terms; of the root r of a sum of size s^2, eps s^2/r, which is
    not more than sqrt(eps) s."""
    size = sizes(a, b, q, u)
    return (
        64 * EPS * size * (1.0 + size / np.maximum(spread(q, u), np.sqrt(64 * EPS) * size + 1e-300))
    )


@pytest.mark.parametrize("size", [100, pytest.param(600, marks=pytest.mark.oracle)])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("k", [1, 2, 3])
def test_one_input_equals_a_grid(kind, k, size):
    rng = np.random.default_rng([k, KINDS.index(kind)])
    step = GRID[1] - GRID[0]
    a, b, q, v = random_rows(rng, k, size, kind)
    priority = 10.0 ** rng.uniform(-1, 1, k)
    made, states = filter_of(k, 1, (LOW, HIGH), priority), states_of(a, b, q)
    found = made.filter(states, v[:, None])
    u, margin, active, feasible = found.action[:, 0], found.margin.T, found.active.T, found.feasible
    assert 0.02 * size < np.count_nonzero(feasible) < 0.98 * size
    assert ((u >= LOW) & (u <= HIGH)).all()
    tolerance = rounding(a, b, q, u)
    assert (abs(margin - (a * u + b - spread(q, u))) <= tolerance).all()
    assert (margin >= -tolerance)[:, feasible].all()

    tried = a[..., None] * GRID + b[..., None] - spread(q[..., None], GRID)
    # A margin changes by its steepest slope from one point of the grid to the middle between two.
    reach = 0.5 * step * (abs(a) + np.sqrt(q[2]))[..., None]
    clear = (tried > 1e-9 * sizes(a, b, q, HIGH - LOW)[..., None]).all(axis=0)
    touched = (tried >= -reach - tolerance[..., None]).all(axis=0)
    assert feasible[clear.any(axis=1)].all()
    assert touched[feasible].any(axis=1).all()
    best = np.where(clear, abs(GRID - v[:, None]), np.inf).min(axis=1)
    assert (abs(u - v) <= best * (1 + 4 * EPS) + 1e-9)[feasible].all()
    inside = np.clip(v, LOW, HIGH)
    kept = (a * inside + b - spread(q, inside) >= 0.0).all(axis=0)
    assert (u[kept] == inside[kept]).all()
    assert not active[:, kept].any()

    units = sizes(a, b, q, HIGH - LOW).max(axis=0)
    missed = [
        (priority[:, None] * np.minimum(part / units, 0.0) ** 2).sum(axis=0)
        for part in (margin, *np.moveaxis(tried, 2, 0))
    ]
    blurred = (priority[:, None] * tolerance / units * (abs(margin) + tolerance) / units).sum(
        axis=0
    )
    least = np.array(missed[1:])
    beaten = (missed[0] > least * (1 + 1e-12) + 4 * blurred) & ~feasible
    for j, i in np.argwhere(beaten).tolist():
        # The point of the grid is near a kink, where one bit of the form is far more of its root
        # than at u.
        there = rounding(a[:, i], b[:, i], q[:, :, i], GRID[j])
        blur = (priority * there / units[i] * (abs(tried[:, i, j]) + there) / units[i]).sum()
        assert missed[0][i] <= least[j, i] * (1 + 1e-12) + 4 * (blurred[i] + blur)
    assert not active[margin > tolerance].any()
    assert active[margin < -tolerance].all()

    decide = decision_of(made)
    for i in range(20):
        single, program = made.filter(states[i], v[[i]]), decide(states[i], v[[i]])
        assert single.action[0] == program.action[0] == u[i]
        assert single.feasible == program.feasible == feasible[i]
        assert single.active.tolist() == active[:, i].tolist()


def test_the_form_of_an_input_alone_bounds_its_size():
    # 1 - 2 |u| >= 0, beside u >= .2, and u >= .6, which contradicts: slacks 1 - 2u and u - .6 with
    # the priorities 1 and 9.
    form, none = (0.0, 0.0, 4.0), (0.0, 0.0, 0.0)
    found = one([0.0], [1.0], [form], 3.0)
    assert (found.action, found.margin, found.active) == (0.5, 0.0, True)
    assert one([0.0, 1.0], [1.0, -0.2], [form, none], -3.0).action == pytest.approx(0.2, rel=1e-15)
    found = one([0.0, 1.0], [1.0, -0.6], [form, none], -3.0, priority=[1.0, 9.0])
    u = found.action[0]
    assert u == pytest.approx((2 * 1 + 9 * 0.6) / (4 + 9))
    assert found.margin == pytest.approx([1 - 2 * u, u - 0.6])
    assert not found.feasible


NONE = (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("a", "b", "forms", "v", "bounds", "u", "feasible"),
    [
        # Of equally bad inputs the nearest, alone and beside a constraint that is always met.
        *[
            ([0.0] * k, [-1.0, 1.0][:k], [NONE] * k, v, (LOW, HIGH), np.clip(v, LOW, HIGH), False)
            for k in (1, 2)
            for v in (0.3, 9.0, -9.0)
        ],
        # u - 1 - 2 |u| is at most -1, at 0, in bounds without an end.
        ([1.0], [-1.0], [(0.0, 0.0, 4.0)], 3.0, (-1e99, 9e99), 0.0, False),
        ([1.0, 0.0], [-1.0, 1.0], [(0.0, 0.0, 4.0), NONE], 3.0, (-1e99, 9e99), 0.0, False),
        # Neither the unit of a row matters, nor one of nearly no slope that is met everywhere.
        *[
            (
                [unit],
                [-0.2 * unit],
                [(0.01 * unit**2, 0.0, 0.01 * unit**2)],
                0.0,
                (-1.0, 1.0),
                0.30453425823325,
                True,
            )
            for unit in (1e-100, 1e-85, 1e85, 1e100)
        ],
        ([1e-170, 1.0], [1.0, -0.5], [NONE] * 2, 0.0, (-1.0, 1.0), 0.5, True),
        # Rows that meet in one point.
        *[
            ([1.0, -scale], [-0.3, 0.3 * scale], [NONE] * 2, 0.9, (-1.0, 1.0), 0.3, True)
            for scale in (3.0, 7e5, 0.1)
        ],
        # u + 1 - |u + 2|: -1 from -2 on, and less before it.
        ([1.0], [1.0], [(4.0, 2.0, 1.0)], 0.3, (-3.0, 1.5), None, False),
        ([1.0], [1.0], [(4.0, 2.0, 1.0)], -2.5, (-3.0, 1.5), None, False),
        # A form that hardly bends has a maximiser.
        *[
            ([a * q2**0.5], [-1.0], [(1.0, 0.0, q2)], 0.5, (LOW, HIGH), None, False)
            for q2 in (1e-300, 1e-170, 1e-20)
            for a in (0.0, 0.5, 2.0)
        ],
    ],
)
def test_of_special_rows(a, b, forms, v, bounds, u, feasible):
    found = one(a, b, forms, v, *bounds)
    assert bounds[0] <= found.action[0] <= bounds[1]
    assert found.feasible == feasible
    # Near a kink the root of a square is known to sqrt(eps).
    assert u is None or found.action[0] == pytest.approx(u, abs=1e-6, rel=1e-12)
    if forms == [(4.0, 2.0, 1.0)]:
        assert found.margin == pytest.approx(-1.0)
        assert found.action[0] >= -2.0 - 1e-6


def random_forms(rng, m, size, rank=None):
    factor = rng.normal(size=(size, m + 1, rank or m + 1))
    factor *= 10.0 ** rng.uniform(-2, 2, (size, 1, 1))
    return factor @ factor.swapaxes(1, 2)


@pytest.mark.parametrize("m", [2, 3, 4])
@pytest.mark.parametrize("bounds", [(-1.0, 2.0), (-1.0, 1.0), (0.0, 1e5), (-3e-3, -1e-3)])
def test_several_inputs_keep_a_plane_above_the_root_that_touches_it(m, bounds):
    rng = np.random.default_rng(m)
    low, high = [bounds[0]] * m, [bounds[1] * (1 + 0.1 * j) for j in range(m)]
    form = np.concatenate([random_forms(rng, m, 40), random_forms(rng, m, 20, rank=1)])
    form[::2, 1:] /= bounds[1] - bounds[0]
    form[::2, :, 1:] /= bounds[1] - bounds[0]
    corners = np.array(list(itertools.product(*zip(low, high, strict=True))))
    points = np.concatenate([corners, rng.uniform(low, high, (20, m))])
    lifted = np.column_stack((np.ones(len(points)), points))
    roots = np.sqrt(np.maximum(np.einsum("pi,bij,pj->bp", lifted, form, lifted), 0.0))
    size = np.sqrt(np.einsum("pi,bij,pj->bp", abs(lifted), abs(form), abs(lifted))).max(axis=1)
    made, entries = filter_of(1, m, list(zip(low, high, strict=True))), np.triu_indices(m + 1)
    offset = 10 * size  # With which no input is changed.
    states = np.column_stack([np.zeros((60, m)), offset, form[:, *entries]])
    gap = np.empty_like(roots)
    for p, point in enumerate(points):
        found = made.filter(states, np.tile(point, (60, 1)))
        assert (found.action == point).all()
        gap[:, p] = offset - found.margin[:, 0] - roots[:, p]
    assert (gap.min(axis=1) >= -1e-13 * size).all()
    # No smaller constant would do: at one corner there is no gap.
    assert (gap[:, : len(corners)].min(axis=1) <= 1e-13 * size).all()
    decide = decision_of(made)
    for state in states[:5]:
        # And where the constraint acts, it does so for a program, too.
        state = np.concatenate([np.ones(m), [-2.0 * m], 1e-3 * state[m + 1 :] / size.max() ** 2])
        found = made.filter(state, low)
        np.testing.assert_allclose(decide(state, low).action, found.action, rtol=1e-9, atol=1e-12)


def test_the_plane_of_a_root_without_a_direction_is_level_and_of_a_linear_one_is_the_root():
    for m in (2, 3, 4):
        made, entries = filter_of(1, m, (-2.0, 2.0)), np.triu_indices(m + 1)
        row = np.array([3.0 * m, *np.linspace(-1.0, 1.0, m)])
        for point in (np.zeros(m), np.linspace(-1, 2, m), np.full(m, -2.0)):
            # sqrt(1 + |u|^2), whose corners are all alike, and |row . [1, u]|.
            for form, root in (
                (np.eye(m + 1), np.sqrt(1 + 4 * m)),
                (np.outer(row, row), row[0] + row[1:] @ point),
            ):
                margin = made.filter([*[0.0] * m, 100.0, *form[entries]], point).margin
                assert margin == pytest.approx(100.0 - root, rel=1e-13)
