"""Three and more inputs against rational arithmetic: the nearest of the least-violating actions,
with scales up to a million apart."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safe_envs.engine.qp.dispatch import project_arrays, project_floats
from safe_envs.engine.qp.rounding import ROUNDING, tolerance
from safe_envs.engine.qp.working_set import ArrayQP, FloatQP, WorkingSet, find_points
from tests.oracles.rational_oracle import nearest_of_least_violating

KINDS = ["plain", "flat", "integers", "parallel", "sides", "sizes", "far", "weights", "endless"]


def random_batch(rng, size, k, m, kind, shift):
    """Programs of k rows and m inputs; a shift above 0 makes most of them infeasible."""
    a, b, v = (
        rng.normal(size=(size, k, m)),
        rng.normal(size=(size, k)) * 0.7,
        rng.normal(size=(size, m)) * 2,
    )
    low, high, w = (
        -rng.uniform(0.5, 1.5, (size, m)),
        rng.uniform(0.5, 2.0, (size, m)),
        rng.uniform(0.5, 2.0, (size, m)),
    )
    if kind == "flat":  # inputs that no row mentions, and rows that mention no input
        a[rng.random(a.shape) < 0.5] = 0.0
    if kind == "integers":
        a, b = rng.integers(-2, 3, a.shape) * 1.0, rng.integers(-4, 3, b.shape) * 1.0
        v, low, high, w = (
            rng.integers(-3, 4, v.shape) * 1.0,
            -np.ones((size, m)),
            np.ones((size, m)),
            np.ones((size, m)),
        )
    if kind == "parallel":  # duplicates and opposite rows
        for i in range(1, k):
            chosen, factor = rng.random(size) < 0.6, rng.choice([-1.0, 1.0, 2.0, -0.5], size)
            a[chosen, i] = a[chosen, 0] * factor[chosen, None]
            touching = chosen & (rng.random(size) < 0.3)
            b[touching, i] = (b[:, 0] * factor)[touching]
    if (
        kind == "sides"
    ):  # sides of the box that differ by up to 1e6, in the units of the rows or not
        half = 10.0 ** rng.choice([0, 3, 6], (size, m))
        low, high, v = low * half, high * half, v * half
        a[::2] /= half[::2, None, :]
    if kind == "sizes":
        scale = 10.0 ** rng.uniform(-3, 3, (size, k))
        a, b = a * scale[:, :, None], b * scale
    if kind == "far":
        v *= 10.0 ** rng.uniform(0, 8, (size, 1))
    if kind == "weights":
        w = 10.0 ** rng.uniform(-4, 4, (size, m))
    if kind == "endless":
        high = 10.0 ** rng.choice([6, 30], (size, m))
        low = -high
    return a, b - shift * np.abs(a).max(axis=2) * rng.random((size, k)), v, low, high, w


def solve(a, b, v, low, high, w, priority):
    rows = [[a[:, i, j] for j in range(a.shape[2])] for i in range(a.shape[1])]
    u, margin, active, feasible = project_arrays(
        rows, list(b.T), list(v.T), list(low.T), list(high.T), list(w.T), priority.tolist()
    )
    return np.array(u).T, np.array(margin).T, np.array(active).T, feasible


def off(problem, priority, u, feasible):
    """By how much an action is off as a share of the box or of the way from the proposal, and
    whether its flag is wrong; None: unknown."""
    exact = nearest_of_least_violating(*problem, priority, u)
    if exact is None:
        return None
    best, met = [float(c) for c in exact[0]], exact[1]
    _, _, v, low, high, w = problem
    way = np.sqrt(w) * np.abs(np.subtract(best, v))
    reach = np.minimum(high - low, way.max() / np.sqrt(w) + np.abs(best))
    return float((np.abs(u - best) / np.where(reach > 0.0, reach, 1.0)).max()), met != feasible


def assert_nearest(kind, size, ks, ms):
    compared = unknown = infeasible = 0
    for m in ms:
        for k in ks:
            for shift in (0.0, 1.8):
                rng = np.random.default_rng([KINDS.index(kind), m, k, int(shift)])
                problems, priority = (
                    random_batch(rng, size, k, m, kind, shift),
                    10.0 ** rng.uniform(-1, 1, k),
                )
                u, margin, active, feasible = solve(*problems, priority)
                a, b, v, low, high, _ = problems
                assert np.all((u >= low) & (u <= high))
                unread = (a == 0.0).all(axis=1)
                assert np.array_equal(u[unread], np.clip(v, low, high)[unread])
                terms = np.einsum("nij,nj->ni", np.abs(a), np.abs(u)) + np.abs(b)
                assert np.all((margin >= -1.001 * ROUNDING * terms) | ~feasible[:, None])
                assert np.all(active.any(axis=1) | feasible)
                for i in range(size):
                    error = off([part[i] for part in problems], priority, u[i], feasible[i])
                    unknown += error is None
                    if error is not None:
                        # A proposal 1e8 boxes away has its own rounding.
                        assert error[0] <= (1e-6 if kind in ("far", "sides") else 1e-9), (
                            k,
                            m,
                            shift,
                            i,
                        )
                        assert not error[1], (k, m, shift, i)
                    compared, infeasible = compared + 1, infeasible + (not feasible[i])
    assert infeasible > 0.01 * compared
    # A guess that the search does not get right says nothing of the answer; most are of integers,
    # where many rows meet.
    assert unknown <= 0.02 * compared


@pytest.mark.parametrize("kind", KINDS)
def test_equals_rational_arithmetic(kind):
    assert_nearest(kind, 5, (2, 4), (3, 5))


@pytest.mark.oracle
@pytest.mark.parametrize("kind", KINDS)
def test_equals_rational_arithmetic_in_many_programs(kind):
    assert_nearest(kind, 150, (2, 3, 4, 6), (3, 4, 5, 6))


def test_an_input_that_no_row_mentions_keeps_its_proposal():
    rows, offsets = [[1.0, 0.0, -0.1], [-1.0, 0.0, 0.1]], [1.0, -1.3]
    box = [-3.0, 2.7, 2.3], [-1.0] * 3, [1.0] * 3
    u, margin, active, feasible = project_floats(rows, offsets, *box, [1.0] * 3, [1.0] * 2)
    # The slacks share .3 - .1 u_3 + u_1 evenly wherever the rows' common line meets the box;
    # nearest to the proposal is its corner.
    assert (u, active, feasible) == ([-1.0, 1.0, 1.0], [True, True], False)
    assert margin == pytest.approx([-0.1, -0.2])


def squares(a, b, u, priority):
    """The weighted sum of squared slacks."""
    return float(
        np.sum(np.array(priority) * np.minimum(np.array(a) @ np.array(u) + np.array(b), 0.0) ** 2)
    )


def test_a_steep_row_is_not_missed_for_a_flat_one():
    # The force of a row 1e9 times as steep as the other is its rounding; the input that it frees
    # comes back at once.
    rows = [
        [0.00095467, 0.00083554, 0.00115792, -0.00130886],
        [306403.5, -982680.2, -1361077.7, -301636.4],
    ]
    offsets, box = (
        [-0.001293006, -1338006.1],
        ([-1.02, -1, -1.4467, -0.5496], [0.785, 0.7545, 0.5675, 0.8436]),
    )
    u, margin, _, feasible = project_floats(
        rows, offsets, [1.16465, 2.15, 2.3758, -1.2736], *box, [1.0] * 4, [1.0, 1.0]
    )
    assert not feasible
    # Where the steep row is met exactly, the flat one is missed least at a vertex of the box but
    # for one input, by 6.2e-4.
    corner = [
        0.785,
        -1.0,
        (1338006.1 - 306403.5 * 0.785 - 982680.2 - 301636.4 * 0.5496) / -1361077.7,
        -0.5496,
    ]
    assert squares(rows, offsets, u, [1.0, 1.0]) <= squares(rows, offsets, corner, [1.0, 1.0]) * (
        1 + 1e-9
    )
    assert u == pytest.approx(corner, abs=1e-9)
    assert margin[1] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("half", [0, 6])
def test_no_corner_of_wild_scales_is_better(half):
    rng = np.random.default_rng(half)
    for _ in range(40):
        (a,), (b,), (v,), (low,), (high,), (w,) = random_batch(rng, 1, 3, 4, "plain", 1.8)
        scale, side = (
            10.0 ** rng.uniform(half - 6, 6 - half, 3),
            10.0 ** rng.uniform(-half, half, 4),
        )
        a, b, v, low, high = a * scale[:, None], b * scale, v * side, low * side, high * side
        u = project_floats(
            a.tolist(), b.tolist(), v.tolist(), low.tolist(), high.tolist(), w.tolist(), [1.0] * 3
        )[0]
        corners = [np.where(bits, high, low) for bits in np.ndindex(2, 2, 2, 2)]
        least = min(
            squares(a, b, corner, [1.0] * 3) for corner in (*corners, np.clip(v, low, high))
        )
        assert squares(a, b, u, [1.0] * 3) <= least * (1 + 1e-9) + np.sum(
            (1e-14 * (np.abs(a) @ np.abs(u) + np.abs(b))) ** 2
        )


def test_sides_of_the_box_that_differ_by_a_million_hide_nothing():
    # u_1 + 1e-6 u_2 >= 1.5 needs both; u_3 must be .25 for the second row.
    rows, offsets = [[1.0, 1e-6, 0.0], [0.0, 0.0, 1.0]], [-1.5, -0.25]
    u, _, active, feasible = project_floats(
        rows, offsets, [0.0] * 3, [-1.0, -1e6, -1.0], [1.0, 1e6, 1.0], [1.0, 1e-12, 1.0], [1.0] * 2
    )
    np.testing.assert_allclose(u, [0.75, 7.5e5, 0.25], rtol=1e-12)
    assert (active, feasible) == ([True, True], True)


def test_a_wrong_guess_of_what_binds_gets_no_certificate():
    # u_1 >= .5 and u_2 >= -.5 from the origin: the first row binds, the second does not, and no
    # input is held.
    a, b = np.array([[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]]), np.array([[-0.5, 0.5]])
    ends, ones = (-np.ones((3, 1)), np.ones((3, 1))), np.ones((3, 1))
    qps = ArrayQP.of(a.transpose(1, 2, 0), b.T, 0.0 * ones, *ends, ones, np.ones((2, 1)))
    qp = FloatQP(
        a[0].tolist(), b[0].tolist(), [0.0] * 3, [-1.0] * 3, [1.0] * 3, [1.0] * 3, [1.0] * 2
    ).scaled()
    guesses = ([True, False], -1), ([True, True], -1), ([False, False], -1), ([True, False], 1)
    for (rows, held), certain in zip(guesses, (True, False, False, False), strict=True):
        for side in (-1, 1) if held >= 0 else (0,):
            at = [side if j == held else 0 for j in range(3)]
            found = find_points(qps, np.array([rows]).T, np.array([at]).T)
            assert found.proved.tolist() == [certain]
            one = qp.point(WorkingSet([i for i, counts in enumerate(rows) if counts], at))
            assert (one.change is None) is certain
            if certain:
                assert found.u[:, 0].tolist() == one.u == [0.5, 0.0, 0.0]


@pytest.mark.parametrize("steep", [1e3, 1e6, 1e9])
def test_steep_row_is_a_wall_to_flat_ones(steep):
    # u_1 + u_2 <= 0 is dear, and the other two ask for u_1: along the wall u_2 = -u_1 up to the
    # corner of the box.
    rows, offsets = (
        [[-steep, -steep, 0.0], [1e-3, -1e-3, 0.0], [1e-3, 0.0, 0.0]],
        [0.0, -2.2e-3, -5e-3],
    )
    u, margin, active, feasible = project_floats(
        rows, offsets, [0.0, 0.0, 0.2], [-1.0] * 3, [1.0] * 3, [1.0] * 3, [1.0] * 3
    )
    np.testing.assert_allclose(u, [1.0, -1.0, 0.2], atol=1e-9 + 5e-3 / steep**2)
    assert margin[1:] == pytest.approx([-2e-4, -4e-3], rel=1e-5)
    assert active[1:] == [True, True]
    assert not feasible
    # Turned round, the row is met with room to spare, and has no part.
    rows[0] = [steep, steep, 0.0]
    u, *_ = project_floats(
        rows, offsets, [-0.3, 0.2, 0.2], [-1.0] * 3, [1.0] * 3, [1.0] * 3, [1.0] * 3
    )
    np.testing.assert_allclose(u, [1.0, -1.0, 0.2], atol=1e-9)


def test_oracle_finds_what_is_clear():
    # The two rows contradict along u_1 by .4, of which the second, nine times as dear, takes a
    # tenth; u_2 is held by the third.
    a, b = (
        np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
        np.array([-0.5, 0.1, -0.3]),
    )
    ends = np.zeros(3), -np.ones(3), np.ones(3), np.ones(3)
    for guess in ([0.14, 0.3, 0.0], [1.0, 1.0, 1.0]):
        found = nearest_of_least_violating(a, b, *ends, np.array([1.0, 9.0, 1.0]), np.array(guess))
        if found is not None:
            assert [float(c) for c in found[0]] == pytest.approx([0.14, 0.3, 0.0], abs=1e-15)
            assert found[1] is False
            assert found[0][2] == Fraction(0)
    assert (
        nearest_of_least_violating(
            a, b, *ends, np.array([1.0, 9.0, 1.0]), np.array([0.14, 0.3, 0.0])
        )
        is not None
    )


def test_many_rows_on_one_point_are_met_there():
    rng = np.random.default_rng(0)
    for _ in range(20):
        point, v = rng.integers(-1, 2, 4) * 0.5, rng.normal(size=4) * 3
        a = rng.integers(-1, 2, (12, 4)) * 1.0
        box = [-1.0] * 4, [1.0] * 4, [1.0] * 4
        _, margin, _, feasible = project_floats(
            a.tolist(), (-(a @ point)).tolist(), v.tolist(), *box, [1.0] * 12
        )
        assert feasible
        assert min(margin) >= -12 * ROUNDING


SIZE = st.builds(
    lambda sign, exponent: sign * 10.0**exponent,
    st.sampled_from([-1.0, 0.0, 1.0]),
    st.floats(-300, 300),
)
ENTRY = st.one_of(st.floats(-2, 2), st.sampled_from([0.0, 1.0, -1.0]), SIZE)


@st.composite
def programs(draw):
    k, m = draw(st.integers(1, 4)), draw(st.integers(1, 4))
    scale = draw(st.sampled_from([1.0, 1e-300, 1e150, 1e300]))
    a = [[draw(ENTRY) * min(scale, 1.0) for _ in range(m)] for _ in range(k)]
    half = [draw(st.sampled_from([1.0, 1e-6, 1e6, 1e100])) for _ in range(m)]
    return (
        a,
        [draw(ENTRY) * scale for _ in range(k)],
        [draw(ENTRY) for _ in range(m)],
        half,
        draw(st.sampled_from([1.0, 1e-8, 1e8])),
    )


@pytest.mark.slow
@settings(max_examples=150)
@given(programs())
def test_one_state_equals_a_batch_at_any_scale(program):
    a, b, v, half, weight = program
    k, m = len(b), len(v)
    w, priority = [weight, *[1.0] * (m - 1)], [1.0] * k
    one = project_floats(a, b, v, [-h for h in half], half, w, priority)
    # Beside another state, so that masks cannot leak.
    columns = (
        [[np.array([aij, 1.0]) for aij in row] for row in a],
        [np.array([bi, 0.5]) for bi in b],
        [np.array([vj, 0.0]) for vj in v],
    )
    *parts, feasible = project_arrays(*columns, [-h for h in half], half, w, priority)
    u, margin, _ = [[entry[0].item() for entry in part] for part in parts]
    if not np.isfinite([*u, *margin, *one[0], *one[1]]).all():
        return  # the filter makes an error of that
    assert one[3] == feasible[0]
    np.testing.assert_allclose(one[0], u, rtol=1e-9, atol=1e-9 * max(half))
    for found, met in ((u, feasible[0]), (one[0], one[3])):
        assert all(-h <= c <= h for c, h in zip(found, half, strict=True))
        for row, offset in zip(a, b, strict=True):
            terms = [
                *(Fraction(x) * Fraction(y) for x, y in zip(row, found, strict=True)),
                Fraction(offset),
            ]
            # Twice: once for the rounding of the margin itself. Below the normal numbers rounding
            # is absolute.
            assert not met or sum(terms) >= -2 * Fraction(ROUNDING) * sum(
                map(abs, terms)
            ) - Fraction(1e-307)


def test_a_miss_is_never_called_feasible_on_the_way_there():
    # Exact enough for most rows, the single-state methods look at the result, and leave to the
    # batch what rounding made of it.
    skew = [[58.587457063119814, 160571986.1745277], [-8650.462775442928, -1255103405.2969155]]
    skew += [[-0.49231216962370533, -44.42495682814076], [5.894081711817454e-08, 0.033354829041236]]
    offsets = [0.04911269124857201, 0.2976744556968492, -0.49194699507253264, 0.1995416648164488]
    tiny = [[1e300], [1.0]], [-1e-20, 1.0]  # the root is denormal, and known to four digits
    for (a, b), v in (((skew, offsets), [395911001.8559354, 439281258.9179358]), (tiny, [0.0])):
        m, k = len(v), len(b)
        ends = [-1.0] * m, [1.0] * m, [1.0] * m, [1.0] * k
        u, margin, active, feasible = project_floats(a, b, v, *ends)
        allowed = [tolerance(row, offset, u) for row, offset in zip(a, b, strict=True)]
        assert feasible == all(g >= -t for g, t in zip(margin, allowed, strict=True))
        *parts, met = project_arrays(
            [[np.array([c]) for c in row] for row in a],
            list(np.array(b)[:, None]),
            list(np.array(v)[:, None]),
            *ends,
        )
        assert ([c.item() for c in parts[0]], [c.item() for c in parts[2]], met.item()) == (
            u,
            active,
            feasible,
        )


def test_a_long_way_inside_the_box_ends_on_the_row():
    for m in (2, 3):
        rest = [0.0] * (m - 1)
        u, margin, _, feasible = project_floats(
            [[-1.0, *rest]], [1e-3], [1e6, *rest], [-1e7] * m, [1e7] * m, [1.0] * m, [1.0]
        )
        assert feasible
        assert u == pytest.approx([1e-3, *rest], rel=1e-14)
        assert abs(margin[0]) <= 2e-3 * ROUNDING


def test_a_steep_row_met_with_room_to_spare_lets_go():
    # It is violated at first, and its pull is below its rounding from then on.
    a = [
        [208.26152489751715, 478.81823232530795, 473.39052954289167],
        [-0.50984162908369, 0.56405661689997, 0.47190637789455],
    ]
    a += [
        [-1.49283308835e-3, 7.5841902551e-4, -5.8054635124e-4],
        [-5.2353039445e-3, -2.4708513022e-2, 3.7908425575e-2],
    ]
    b, v = (
        [-412.768911191307, 0.114749375170422, -1.4806099082e-3, -1.9471364240e-2],
        [1.46724946406, 3.1629908946, -0.83154555956],
    )
    low, high = (
        [-0.8957285648, -1.0963488786775, -0.6095237162],
        [0.9434476957, 0.534211151, 1.52364823926],
    )
    priority = [6.183767680033, 0.904524468956, 0.291185329034, 7.892208614194]
    u, *_, feasible = project_floats(a, b, v, low, high, [1.0] * 3, priority)
    exact = nearest_of_least_violating(
        *map(np.array, (a, b, v, low, high, [1.0] * 3, priority)),
        np.array([low[0], high[1], 0.7381]),
    )
    assert exact is not None
    assert (exact[1], feasible) == (False, False)
    np.testing.assert_allclose(u, [float(c) for c in exact[0]], rtol=1e-9)


def test_rounding_of_a_way_of_a_million_makes_no_row_infeasible():
    # The last two inputs go to their rows by ways of 1e6 and 1, whose rounding is more than the
    # rows allow.
    a = [
        [-0.0002517655585092737, 4.172288702672463e-07, -1.5094574851107956, -3.72511864414773e-07]
    ]
    a += [
        [
            -3.6470802386148696e-05,
            -1.030246137748674e-06,
            0.6242011531473187,
            -4.361699173632114e-08,
        ]
    ]
    b, v = (
        [1.3032068751995545, -0.8993053416602996],
        [-1344.9906588339315, 843534.2707760541, 0.20908820645082052, 109003.3633315919],
    )
    low = [-733.2585068425497, -1018841.2850137962, -1.0389243788772098, -1088294.5766171087]
    high = [953.7441083930224, 1035622.8909829491, 1.5325121588809307, 1275631.2915935216]
    w, priority = (
        [1.0372023271717195, 0.8272750006418648, 0.6081565564645655, 1.078193157759883],
        [2.997265185756112, 4.451373739084678],
    )
    u, _, _, feasible = project_floats(a, b, v, low, high, w, priority)
    exact = nearest_of_least_violating(
        *map(np.array, (a, b, v, low, high, w, priority)), np.array(u)
    )
    assert exact is not None
    assert exact[1] is feasible is True
    np.testing.assert_allclose(u, [float(c) for c in exact[0]], rtol=1e-9)


def test_a_proposal_of_1e16_drowns_no_row():
    for m in (2, 3):
        rest = [0.0] * (m - 2)
        for a, b in (
            ([[1.0, 1.0, *rest]], [-0.5]),
            ([[1.0, 1.0, *rest], [0.3, 1.0, *rest]], [-0.5, 2.0]),
        ):
            u, margin, _, feasible = project_floats(
                a, b, [-1e16, 0.3, *rest], [-1.0] * m, [1.0] * m, [1.0] * m, [1.0] * len(b)
            )
            assert feasible
            assert -ROUNDING <= margin[0] <= 1e-12
            np.testing.assert_allclose(u, [-0.5, 1.0, *rest], atol=1e-12)


def test_a_row_that_binds_beside_slacks_by_rounding_does_not_fix_two_inputs():
    # Among twelve rows, most of them parallel, one that binds is violated by some of its rounding.
    rng = np.random.default_rng([KINDS.index("parallel"), 2, 12, 1, 77])
    problems, priority = (
        random_batch(rng, 8, 12, 2, "parallel", 1.8),
        10.0 ** rng.uniform(-1, 1, 12),
    )
    u, _, _, feasible = solve(*problems, priority)
    error, wrong = off([part[5] for part in problems], priority, u[5], feasible[5])
    assert error < 1e-9
    assert not wrong
