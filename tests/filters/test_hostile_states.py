"""Filters at any state: an answer inside the bounds with the right flags, or a NumericalError, the
same for one state and a batch."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import sympy as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from safe_envs import Barrier, ControlAffineSDE, NumericalError
from safe_envs.dynamics.codegen import compile_function, filled
from safe_envs.engine.qp import ROUNDING
from safe_envs.systems import ENV_IDS
from safe_envs.wrappers import CBF, RCBF, SCBF, SafetyFilter
from tests.conftest import problem_of

FILTERS = {
    "Scalar": ["rcbf nearest", "szcbf nearest"],
    "ACC": ["cbf clf", "srcbf clf", "rcbf:sampling_margin=first-order clf"],
    "ACCGap": ["hocbf clf", "scbf nearest"],
    "CubicSDE": ["scbf clf", "rcbf nearest", "srcbf:form=log clf"],
    "CubicSDEDisk": ["srcbf nearest", "rcbf nearest", "scbf:sampling_margin=first-order nearest"],
    "DubinsObstacles": ["scbf nearest"],
    "QuadrotorLimits": ["hocbf nearest"],
}
ALL = [
    f"{condition}{margin} {objective}"
    for condition in (
        *("cbf", "hocbf", "ecbf", "scbf", "szcbf"),
        *("rcbf", "rcbf:form=log", "srcbf", "srcbf:form=log"),
    )
    for margin in ("", ":sampling_margin=first-order")
    for objective in ("nearest", "clf")
]

# Log-uniform over all magnitudes and signs, zeros, denormals, and the round numbers at which h and
# gains vanish.
NUMBER = st.builds(
    lambda sign, exponent: sign * 10.0**exponent, st.sampled_from([-1, 1]), st.floats(-320, 300)
)
ENTRY = st.one_of(st.sampled_from([0.0, 1.0, -1.0, 2.0, 5e-324, 1e-160]), st.floats(-3, 3), NUMBER)


@cache
def filter_of(name: str, text: str) -> SafetyFilter:
    condition, objective = text.rsplit(" ", 1)
    return SafetyFilter.for_problem(
        problem_of(f"safe_envs/{name}-v0"), condition, objective=objective
    )


@cache
def gains_of(safety_filter: SafetyFilter):
    model = safety_filter.model
    entries = [
        model.numeric(e) for constraint in safety_filter.constraints for e in constraint.coefficient
    ]
    return compile_function(model.states, entries, "arrays")


def answer(safety_filter, x, u):
    try:
        found = safety_filter.filter(x, u)
    except NumericalError:
        return None
    return [np.asarray(part)[0] if x.ndim == 2 else np.asarray(part) for part in found]


def assert_sound(safety_filter, x, u):
    x, u = np.array(x), np.array(u)
    one, batch = answer(safety_filter, x, u), answer(safety_filter, x[None], u[None])
    assert (one is None) == (batch is None)
    if one is None:
        return
    low, high = safety_filter.qp.low, safety_filter.qp.high
    with np.errstate(all="ignore"):
        gains = [filled(c, (1,))[0] for c in gains_of(safety_filter)(*[np.array([c]) for c in x])]
    for action, margin, active, feasible, slack, cause, _, barrier in (one, batch):
        assert all(np.isfinite(part).all() for part in (action, barrier, margin, slack))
        assert np.all((low <= action) & (action <= high))
        assert (cause >= 0) <= active.any()
        products = np.reshape(gains, (len(margin), -1)) * action
        offset = margin - products.sum(axis=1)
        allowed = (ROUNDING * abs(products)).sum(axis=1) + ROUNDING * abs(offset)
        if feasible:
            assert np.all(margin >= -allowed)
            assert not slack.any()
        else:
            assert active.any()
    assert one[3] == batch[3]
    np.testing.assert_allclose(
        one[0], batch[0], rtol=1e-9, atol=1e-9 * max(map(abs, [*low, *high]))
    )


@st.composite
def situations(draw, names):
    safety_filter = filter_of(*draw(st.sampled_from(names)))
    n, ends = (safety_filter.model.n, zip(safety_filter.qp.low, safety_filter.qp.high, strict=True))
    x = draw(st.lists(ENTRY, min_size=n, max_size=n))
    near = st.tuples(*[st.floats(2 * lo - hi, 2 * hi - lo) for lo, hi in ends])
    return safety_filter, x, draw(st.one_of(near, st.tuples(*[NUMBER] * safety_filter.model.m)))


@pytest.mark.slow
@settings(max_examples=30)
@given(situations([(name, text) for name, texts in FILTERS.items() for text in texts]))
def test_answers_are_sound_or_errors(situation):
    assert_sound(*situation)


@pytest.mark.oracle
def test_answers_of_every_filter_are_sound_or_errors():
    rng = np.random.default_rng(0)
    tried = 0
    for env_id in ENV_IDS:
        name = env_id.removeprefix("safe_envs/").removesuffix("-v0")
        for text in ALL:
            try:
                safety_filter = filter_of(name, text)
            except ValueError:
                continue  # of another relative degree, or without a goal
            n, qp = safety_filter.model.n, safety_filter.qp
            low, high = np.array(qp.low), np.array(qp.high)
            for top in rng.choice([3, 8, 60, 90, 170, 300], 200):
                x = rng.choice([-1, 1], n) * 10.0 ** rng.uniform(rng.choice([-5, -320]), top, n)
                x = np.where(rng.random(n) < 0.2, rng.choice([0.0, 1.0, 2.0, 5e-324], n), x)
                far = rng.choice([-1, 1], len(low)) * 10.0 ** rng.uniform(-300, 300, len(low))
                near = low + (high - low) * rng.uniform(-1, 2, len(low))
                assert_sound(safety_filter, x, near if rng.random() < 0.7 else far)
                tried += 1
    assert tried > 20_000


@pytest.mark.parametrize(
    ("name", "text", "state"),
    [
        ("CubicSDE", "rcbf nearest", [2.0, 1e-160]),
        ("CubicSDE", "srcbf nearest", [2.0, 1e-160]),
        ("CubicSDEDisk", "rcbf nearest", [2.0, 1e-160]),
        ("CubicSDEDisk", "srcbf nearest", [2.0, 1e-160]),
        ("ACC", "cbf clf", [-1e81, 0.0, 0.0]),
        ("ACCGap", "hocbf clf", [-1e65, 1e22]),
        ("CubicSDE", "scbf clf", [0.0, 1e77]),
    ],
)
def test_states_that_gave_no_number_have_an_answer(name, text, state):
    safety_filter = filter_of(name, text)
    assert_sound(safety_filter, state, [0.0])
    assert answer(safety_filter, np.array(state), np.zeros(1)) is not None


def test_a_tiny_gain_decides_where_h_rises():
    # h = -1 at x = 2 falls along x_1 whatever is done; x_2 u is all that the input has, and 1e-160
    # is more than nothing.
    safety_filter = filter_of("CubicSDE", "rcbf nearest")
    gain = gains_of(safety_filter)(2.0, 1e-160)[0]
    found = safety_filter.filter([2.0, 1e-160], [0.0])
    qp = safety_filter.qp
    assert found.action.tolist() == [qp.high[0] if gain > 0 else qp.low[0]]
    assert found.cause == 0
    assert not found.feasible


@pytest.mark.parametrize("size", [1e165, 1e200, 1e300])
def test_states_beyond_the_squares_of_floats_are_errors_that_name_them(size):
    safety_filter = filter_of("QuadrotorLimits", "hocbf nearest")
    for x in (np.full(12, size), np.full((2, 12), size)):
        with pytest.raises(NumericalError, match=r"no finite value at x = 1e\+"):
            safety_filter.filter(x, np.zeros((*x.shape[:-1], 4)))


def test_a_barrier_that_overflows_where_its_row_does_not_is_an_error():
    x, u = sp.symbols("x u", real=True)
    system = ControlAffineSDE((x,), (u,), [0], [1 / x], [0])
    safety_filter = SafetyFilter(system, [(Barrier(x**2), SCBF())], input_bounds=[(-1.0, 1.0)])
    for state in ([1e160], [[1.0], [1e160]]):
        with pytest.raises(
            NumericalError, match=r"the barrier on .* has no finite value at x = 1e\+160"
        ):
            safety_filter.filter(state, np.zeros_like(state))


def test_what_overflows_on_the_way_to_a_number_is_that_number_for_one_state_too():
    # Plain floats raise at exp(800); its inverse is 0.
    x, u = sp.symbols("x u", real=True)
    system = ControlAffineSDE((x,), (u,), [1 / (1 + sp.exp(x))], [1], [0])
    safety_filter = SafetyFilter(system, [(Barrier(x), CBF(1.0))], input_bounds=[(-1.0, 1.0)])
    one, batch = safety_filter.filter([800.0], [0.5]), safety_filter.filter([[800.0]], [[0.5]])
    assert one.barrier.tolist() == batch.barrier[0].tolist() == [800.0]
    assert (one.action.tolist(), one.feasible) == ([0.5], True)
    assert isinstance(one.feasible, bool)


def test_a_root_of_a_negative_number_is_not_safe_and_not_complex():
    x, u = sp.symbols("x u", real=True)
    system = ControlAffineSDE((x,), (u,), [0], [1], [0])
    safety_filter = SafetyFilter(
        system, [(Barrier((x + 1) ** sp.Rational(4, 3)), CBF(1.0))], input_bounds=[(-1.0, 1.0)]
    )
    for state in ([-2.0], [[-2.0]]):
        found = safety_filter.filter(state, np.zeros_like(state))
        assert not np.any(found.feasible)
        assert np.all(found.slack == np.inf)


def test_two_conditions_without_meaning_and_gains_that_nearly_cancel():
    # Both ask for all they can get, in opposite directions but for 1e-160 of the second input.
    x, y, u, w = sp.symbols("x y u w", real=True)
    system = ControlAffineSDE((x, y), (u, w), [0, 0], [[1, 0], [0, 1]], [0, 0])
    rows = [(Barrier(x - 5), RCBF()), (Barrier(-x - 5 + sp.Float(1e-160) * y), RCBF())]
    found = SafetyFilter(system, rows, input_bounds=[(-3.0, 3.0)] * 2).filter(
        [0.0, 0.0], [1.0, 0.5]
    )
    assert np.isfinite(found.action).all()
    assert not found.feasible
