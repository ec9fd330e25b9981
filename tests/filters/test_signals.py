"""Signals and the time in constraints, against the same quantities as states."""

from __future__ import annotations

import random
from dataclasses import replace
from typing import Any

import pytest
import sympy as sp

from safe_envs import CLF, Barrier, ConfigurationError, ControlAffineSDE, RelativeDegreeError
from safe_envs.dynamics.identities import is_zero
from safe_envs.dynamics.lie import relative_degree
from safe_envs.filters.conditions.certified import Certified
from safe_envs.filters.conditions.learned import LearnedCondition
from safe_envs.problem.signals import TIME
from safe_envs.wrappers import CBF, ECBF, HOCBF, RCBF, SCBF, SRCBF, SZCBF, ClassK, Condition

x, y, u, w, p, q, clock = sp.symbols("x y u w p q clock", real=True)
mass = sp.Symbol("mass", positive=True)
MEASURED = (x, y, p, q, TIME)
FIRST = {"sampling_margin": "first-order"}
SEEDS = [1, *[pytest.param(seed, marks=pytest.mark.oracle) for seed in (0, 2, 3)]]
ONE: Any = {TIME: clock, mass: sp.Symbol("mass", real=True)}


def some(rng: random.Random, symbols: tuple[sp.Symbol, ...]) -> sp.Expr:
    """Return a random smooth function of symbols."""
    factors = [*symbols, sp.sin(rng.choice(symbols)), sp.exp(-(rng.choice(symbols) ** 2))]
    terms = [rng.randint(-3, 3) * rng.choice(factors) * rng.choice(factors) for _ in range(3)]
    return sp.Add(*terms, rng.randint(-2, 2))


def random_system(seed: int, degree: int, *, noisy: bool) -> tuple[ControlAffineSDE, Barrier]:
    """Return a system with signals and the time everywhere, and a barrier of a relative degree."""
    rng = random.Random(seed)
    fast = (u, w) if seed % 2 else (u,)
    gain = 2 + sp.sin(p + TIME) / mass
    matrix = [[0] * len(fast), [gain, *([some(rng, (x, q))] * (len(fast) - 1))]]
    noise = [rng.randint(1, 3) * p / 4, sp.cos(y + TIME)] if noisy else [0, 0]
    system = ControlAffineSDE(
        (x, y),
        fast,
        [y + some(rng, (x, p, TIME)), some(rng, (*MEASURED, mass))],
        matrix,
        [[entry] for entry in noise] if degree == 1 or not noisy else [[0], [noise[1]]],
        signals={p: q + some(rng, (q, TIME)), q: some(rng, (p, q)), mass: 0},
    )
    of = (x, y, p, q, TIME) if degree == 1 else (x, p, TIME)
    return system, Barrier(some(rng, of) + (y + y * p**2 if degree == 1 else 2 * x + x * TIME))


def as_states(system: ControlAffineSDE) -> ControlAffineSDE:
    """Return the system with its signals and the time as states with their rates."""
    extra, no_input = len(system.signals) + 1, [0] * system.m
    return ControlAffineSDE(
        tuple(s.subs(ONE) for s in (*system.states, *system.signals, TIME)),
        system.inputs,
        [sp.sympify(e).subs(ONE) for e in (*system.drift, *system.signals.values(), 1)],
        [*system.input_matrix.subs(ONE).tolist(), *[no_input] * extra],
        [*system.diffusion.subs(ONE).tolist(), *[[0] * system.diffusion.cols] * extra],
    )


def assert_same(system: ControlAffineSDE, barrier: Barrier, condition: Condition) -> None:
    found = condition.constraint(system, barrier)
    expected = condition.constraint(
        as_states(system), replace(barrier, expression=barrier.expression.subs(ONE))
    )
    for name in ("coefficient", "chain"):
        pairs = zip(getattr(found, name), getattr(expected, name), strict=True)
        assert all(is_zero(a.subs(ONE) - b) for a, b in pairs), name
    for name in ("offset", "demand", "change"):
        a, b = getattr(found, name), getattr(expected, name)
        assert (a is None) == (b is None), name
        assert a is None or is_zero(a.subs(ONE) - b), name


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(
    "condition",
    [
        CBF(2.0),
        CBF(ClassK("s**3 + s")),
        CBF(2.0, **FIRST),
        HOCBF((3.0,)),
        ECBF((2.0,)),
        SCBF(),
        SCBF(**FIRST),
        SZCBF((0.5,)),
        RCBF(2.0),
        RCBF(2.0, "log", **FIRST),
        SRCBF(0.5),
    ],
    ids=str,
)
def test_signals_and_time_are_states_that_nothing_drives(condition: Condition, seed: int) -> None:
    system, barrier = random_system(seed, 1, noisy=True)
    assert_same(system, barrier, condition)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(
    "condition",
    [
        HOCBF((2.0, 5.0)),
        HOCBF((ClassK("s**3 + s"), 1.0)),
        HOCBF((2.0, 5.0), **FIRST),
        ECBF(poles=(-1.0, -2.0)),
        SCBF(),
        SZCBF((2.0, 3.0)),
    ],
    ids=str,
)
def test_their_rates_enter_at_every_level_of_a_chain(condition: Condition, seed: int) -> None:
    system, barrier = random_system(seed, 2, noisy=condition.stochastic)
    assert relative_degree(system, barrier.expression) == 2
    assert_same(system, barrier, condition)


def test_a_chain_through_a_rate_by_hand() -> None:
    # h = (x - p)^2 - 1 with p' = q, q' = -p and x' = u.
    system = ControlAffineSDE((x,), (u,), [0], [[1]], [[0]], signals={p: q, q: -p})
    found = CBF(3.0).constraint(system, Barrier((x - p) ** 2 - 1 - TIME))
    assert is_zero(found.coefficient[0] - 2 * (x - p))
    assert is_zero(found.offset - (-2 * (x - p) * q - 1 + 3 * ((x - p) ** 2 - 1 - TIME)))


def test_a_goal_may_move() -> None:
    system = ControlAffineSDE((x,), (u,), [0], [[1]], [[2]], signals={p: q, q: 0})
    growth, (along,) = CLF((x - p) ** 2 * (1 + TIME), rate=3.0).growth(system)
    # A V = dV/dt - 2 (x - p) q (1 + t) + 1/2 4 2 (1 + t), plus 3 V.
    expected = (x - p) ** 2 - 2 * (x - p) * q * (1 + TIME) + 4 * (1 + TIME)
    assert is_zero(growth - expected - 3 * (x - p) ** 2 * (1 + TIME))
    assert is_zero(along - 2 * (x - p) * (1 + TIME))


def test_a_barrier_that_inputs_do_not_reach_has_no_relative_degree() -> None:
    system = ControlAffineSDE((x,), (u,), [0], [[1]], [[0]], signals={p: q, q: p})
    with pytest.raises(RelativeDegreeError, match="no input"):
        HOCBF().constraint(system, Barrier(1 - p**2 - TIME))


class Learned(LearnedCondition):
    """A condition of a model that was learned without signals."""

    def derived(self, model, barrier):
        """Fail, since nothing is to be derived."""
        raise AssertionError


@pytest.mark.parametrize(
    ("signals", "h", "names"),
    [({p: q, q: 0}, 1 - x, "p, q"), ({}, 1 - x - TIME, "t")],
)
def test_what_was_learned_or_proved_takes_no_signals(signals, h, names) -> None:
    system = ControlAffineSDE((x,), (u,), [0], [[1]], [[0]], signals=signals)
    learned = object.__new__(Learned)
    with pytest.raises(ConfigurationError, match=f"depends on {names}. Take a condition"):
        learned.constraint(system, Barrier(h))
    assert LearnedCondition.autonomous
    assert Certified.autonomous
