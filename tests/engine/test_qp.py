"""The quadratic programs of filters, against rational arithmetic.

Properties hold for QPs of one to four inputs and up to twelve constraints of every kind, solved in
every way: a batch, one state in floats, the filter, and its program.
"""

from __future__ import annotations

import functools
import itertools
from fractions import Fraction

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest

from safe_envs.engine.qp import ROUNDING
from tests.oracles.qps import KINDS, WAYS, Answers, QPs, by_batch, by_floats, random_qps
from tests.oracles.rational_oracle import nearest_of_least_violating

SIZES = [(1, 1), (1, 2), (1, 3), (3, 1), (7, 1), (2, 2), (5, 2), (2, 3), (5, 3), (3, 4), (7, 4)]


@functools.cache
def solved(kind: str) -> list[tuple[QPs, dict[str, Answers]]]:
    """A few QPs of every size, solved in every way."""
    found = []
    for k, m in SIZES:
        for shift in (0.0, 1.8):
            rng = np.random.default_rng([KINDS.index(kind), m, k, int(shift)])
            qps = random_qps(rng, 4, k, m, kind, shift)
            found.append((qps, {name: way(qps) for name, way in WAYS.items()}))
    return found


def judge(qps: QPs, i: int, answers: Answers) -> tuple[float, bool] | None:
    """By how much inputs are off, and whether the flag is wrong; None where the oracle does not
    know."""
    u = answers.u[i]
    exact = nearest_of_least_violating(*[part[i] for part in qps[:6]], qps.priority, u)
    if exact is None:
        return None
    best = np.array([float(c) for c in exact[0]])
    error = np.abs(u - best) / qps.states([i]).reach(best[None])[0]
    return float(error.max()), bool(exact[1] != answers.feasible[i])


def assert_right(qps: QPs, answers: Answers, tolerance: float = 1e-9) -> int:
    """Return how many states the oracle does not know."""
    found = [judge(qps, i, answers) for i in range(len(qps.b))]
    known = [each for each in found if each is not None]
    assert all(error < tolerance and not wrong for error, wrong in known), found
    return len(found) - len(known)


def assert_feasible(qps: QPs, answers: Answers) -> None:
    """Inputs keep their bounds, flags are what margins say, and what changes an input acts."""
    u, margin, active, feasible = answers
    assert ((u >= qps.low) & (u <= qps.high)).all()
    terms = qps.terms(u)
    assert (np.abs(margin - qps.values(u)) <= ROUNDING * terms).all()
    assert ((margin >= -1.001 * ROUNDING * terms).all(axis=1) == feasible).all()
    start = qps.clipped()
    changed = (qps.values(start) < 0.0).any(axis=1)
    assert (active.any(axis=1) >= changed).all()
    assert not active[(qps.values(start) > ROUNDING * qps.terms(start)).all(axis=1)].any()
    idle = ~active.any(axis=1)
    assert (u[idle] == start[idle]).all()


def assert_equal(qps: QPs, found: Answers, expected: Answers, tolerance: float = 1e-9) -> None:
    near = np.abs(found.u - expected.u) <= tolerance * qps.reach(expected.u)
    assert near.all()
    assert (found.feasible == expected.feasible).all()


@pytest.mark.parametrize("kind", KINDS)
def test_answers_are_the_nearest_of_the_least_violating(kind):
    unknown = judged = missed = 0
    for qps, answers in solved(kind):
        unknown += assert_right(qps, answers["floats"])
        judged += len(qps.b)
        missed += (~answers["floats"].feasible).sum()
    assert unknown <= 0.06 * judged
    assert 0.1 * judged < missed < 0.8 * judged


@pytest.mark.parametrize("kind", KINDS)
def test_answers_are_feasible_in_every_way(kind):
    for qps, answers in solved(kind):
        for name in ("batch", "floats", "filter"):
            assert_feasible(qps, answers[name])


@pytest.mark.parametrize("kind", KINDS)
def test_a_batch_a_state_a_filter_and_a_program_decide_alike(kind):
    for qps, answers in solved(kind):
        expected = answers["floats"]
        for name in ("batch", "filter", "program"):
            assert_equal(qps, answers[name], expected)
            acts = answers[name].active.any(axis=1)
            assert (acts == expected.active.any(axis=1)).all(), name


@pytest.mark.parametrize("kind", KINDS)
def test_forces_of_what_is_missed_balance(kind):
    # sum_i priority_i slack_i a_i is 0 for every input within its bounds, and pushes against them.
    rng = np.random.default_rng(5)
    missed = 0
    for k, m in SIZES[3:]:
        qps = random_qps(rng, 60, k, m, kind, 1.8)
        u, margin, _, feasible = by_batch(qps)
        slack = qps.priority * np.maximum(-margin, 0.0)
        force = (qps.a.transpose(0, 2, 1) @ slack[:, :, None])[:, :, 0]
        loose = 1e-12 * slack + 4 * ROUNDING * qps.priority * qps.terms(u)
        loose = (np.abs(qps.a).transpose(0, 2, 1) @ loose[:, :, None])[:, :, 0]
        held = np.where(force > 0.0, u == qps.high, u == qps.low)
        assert (held | (np.abs(force) <= loose) | feasible[:, None]).all()
        missed += (~feasible).sum()
    assert missed > 30


@pytest.mark.parametrize("kind", KINDS)
def test_units_of_constraints_and_inputs_do_not_matter(kind):
    rng = np.random.default_rng(6)
    for k, m in SIZES:
        qps = random_qps(rng, 25, k, m, kind, 0.9)
        row, column = 2.0 ** rng.integers(-10, 10, k), 2.0 ** rng.integers(-10, 10, m)
        a, b, v, low, high, w, priority = qps
        scaled = QPs(
            a * row[:, None] / column,
            b * row,
            *[part * column for part in (v, low, high)],
            w / column**2,
            priority / row**2,
        )
        found, expected = by_batch(scaled), by_batch(qps)
        assert_equal(qps, found._replace(u=found.u / column), expected, 1e-8)


@pytest.mark.parametrize("kind", KINDS)
def test_the_order_of_constraints_inputs_and_states_does_not_matter(kind):
    rng = np.random.default_rng(7)
    for k, m in SIZES:
        qps = random_qps(rng, 25, k, m, kind, 0.9)
        state, row, column = (rng.permutation(count) for count in (25, k, m))
        a, b, *rest = qps.states(state)[:6]
        turned = QPs(
            a[:, row][:, :, column],
            b[:, row],
            *[part[:, column] for part in rest],
            qps.priority[row],
        )
        found, expected = by_batch(turned), by_batch(qps)
        back = Answers(*[part[np.argsort(state)] for part in found])
        back = back._replace(u=back.u[:, np.argsort(column)])
        assert_equal(qps, back, expected, 1e-8)
        alone = Answers(*[part[[3]] for part in expected])
        assert_equal(qps.states([3]), by_batch(qps.states([3])), alone, 1e-12)


@pytest.mark.parametrize("top", [20, 150, 280])
def test_proposals_far_beyond_the_bounds_have_the_nearest_answer(top):
    for (k, m), kind in itertools.product(SIZES[4:], ("plain", "weights")):
        rng = np.random.default_rng([k, m, top])
        qps = random_qps(rng, 4, k, m, kind, 0.0)
        far = qps.v * 10.0 ** rng.uniform(top - 10, top, (4, 1))
        assert_right(qps._replace(v=far), by_floats(qps._replace(v=far)))


@pytest.mark.parametrize(("k", "seed"), [(2, 0), (7, 18), (12, 1)])
def test_one_input_without_bounds_violates_contradictory_constraints_least(k, seed):
    qps = random_qps(
        np.random.default_rng([KINDS.index("open"), 1, k, seed]), 60, k, 1, "open", 1.8
    )
    answers = by_floats(qps)
    assert_right(qps, answers)
    assert (np.isinf(qps.low) & np.isinf(qps.high))[~answers.feasible].any()


@pytest.mark.oracle
@pytest.mark.parametrize("kind", KINDS)
def test_equals_rational_arithmetic_in_1e5_qps(kind):
    unknown = judged = 0
    for m in (1, 2, 3, 4):
        for k in range(1, 13):
            for shift in (0.0, 1.8):
                rng = np.random.default_rng([21, KINDS.index(kind), m, k, int(shift)])
                qps = random_qps(rng, 90, k, m, kind, shift)
                for name in ("batch", "floats"):
                    answers = WAYS[name](qps)
                    assert_feasible(qps, answers)
                    unknown += assert_right(qps, answers)
                    judged += len(qps.b)
    assert judged >= 2 * 1e5 / len(KINDS)
    # Where many constraints meet in a point, the oracle does not find its proof at times.
    assert unknown <= (0.06 if kind == "touching" else 0.005) * judged


@pytest.mark.oracle
@pytest.mark.parametrize("kind", KINDS)
def test_programs_of_many_qps(kind):
    for k, m in SIZES:
        qps = random_qps(np.random.default_rng([8, k, m]), 60, k, m, kind, 0.9)
        assert_equal(qps, WAYS["program"](qps), by_batch(qps))


NUMBERS = st.builds(
    lambda sign, exponent: sign * 10.0**exponent,
    st.sampled_from([-1.0, 0.0, 1.0]),
    st.floats(-300, 300),
)
ENTRIES = st.floats(-2, 2) | st.sampled_from([0.0, 1.0, -1.0]) | NUMBERS


@st.composite
def qps_of_any_scale(draw):
    k, m = draw(st.integers(1, 4)), draw(st.integers(1, 4))
    scale = draw(st.sampled_from([1.0, 1e-300, 1e150, 1e300]))
    entries = draw(st.lists(ENTRIES, min_size=k * (m + 1) + m, max_size=k * (m + 1) + m))
    a, b, v = np.split(np.array(entries), [k * m, k * m + k])
    half = np.array([draw(st.sampled_from([1.0, 1e-6, 1e6, 1e100])) for _ in range(m)])
    weights = [draw(st.sampled_from([1.0, 1e-8, 1e8])), *[1.0] * (m - 1)]
    with np.errstate(over="ignore"):
        b = b * scale
    hypothesis.assume(np.isfinite(b).all())
    return QPs.one(a * min(scale, 1.0), b, v, -half, half, weights)


@hypothesis.settings(max_examples=50)
@hypothesis.given(qps_of_any_scale())
def test_numbers_of_any_size_are_decided_alike_and_never_called_feasible_where_they_are_not(qps):
    u, margin, _, feasible = WAYS["floats"](qps)
    batch = WAYS["batch"](QPs(*[np.concatenate([part, part]) for part in qps[:6]], qps.priority))
    if not np.isfinite([*u[0], *margin[0], *batch.u[0], *batch.margin[0]]).all():
        return  # the filter makes an error of that
    np.testing.assert_allclose(batch.u[:1], u, rtol=1e-9, atol=1e-9 * qps.high.max())
    assert batch.feasible.tolist() == [feasible[0]] * 2
    assert ((u >= qps.low) & (u <= qps.high)).all()
    for row, offset in zip(qps.a[0], qps.b[0], strict=True):
        products = [Fraction(x) * Fraction(y) for x, y in zip(row, u[0], strict=True)]
        terms = [*products, Fraction(offset)]
        # Twice: once for the rounding of the margin itself. Below the normal numbers rounding is
        # absolute.
        allowed = 2 * Fraction(ROUNDING) * sum(map(abs, terms)) + Fraction(1e-307)
        assert not feasible[0] or sum(terms) >= -allowed


def test_no_corner_of_wild_scales_misses_less():
    rng = np.random.default_rng(6)
    qps = random_qps(rng, 80, 3, 4, "plain", 1.8)
    half = np.repeat([0.0, 6.0], 40)[:, None]
    row, side = (
        10.0 ** rng.uniform(half - 6, 6 - half, (80, 3)),
        10.0 ** rng.uniform(-half, half, (80, 4)),
    )
    qps = qps._replace(a=qps.a * row[:, :, None], b=qps.b * row)
    qps = qps._replace(v=qps.v * side, low=qps.low * side, high=qps.high * side)

    def missed(u):
        return (qps.priority * np.minimum(qps.values(u), 0.0) ** 2).sum(axis=1)

    u = by_batch(qps).u
    blur = (qps.priority * (1e-14 * qps.terms(u)) ** 2).sum(axis=1)
    for upper in itertools.product([True, False], repeat=4):
        assert (missed(u) <= missed(np.where(upper, qps.high, qps.low)) * (1 + 1e-9) + blur).all()
