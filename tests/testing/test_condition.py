"""The checks for authors of conditions pass what is right, and name what is broken."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import pytest
import sympy as sp

from safe_envs.dynamics.lie import generator, lie_derivative_f
from safe_envs.errors import ConfigurationError, RelativeDegreeError
from safe_envs.filters.safety_filter import SafetyFilter
from safe_envs.testing.condition import check_condition
from safe_envs.wrappers import AffineConstraint, Condition
from tests.conftest import problem_of

DISK = problem_of("safe_envs/CubicSDEDisk-v0")


@pytest.mark.parametrize(
    ("text", "env_id"),
    [
        ("cbf:alpha=s+s**3", "Scalar-v0"),
        ("rcbf", "Pendulum-v0"),
        ("srcbf:form=log", "CubicSDEDisk-v0"),
        ("hocbf:alpha=2,s*Abs(s)", "DubinsDisk-v0"),
        ("ecbf:sampling_margin=first-order", "StochasticDubins-v0"),
        ("szcbf:sampling_margin=first-order", "ACCGap-v0"),
        ("scbf:sampling_margin=0.1", "QuadrotorLimits-v0"),
        pytest.param("hocbf", "DubinsObstacles-v0", marks=pytest.mark.oracle),
    ],
)
def test_the_conditions_of_this_package_pass(text, env_id):
    check_condition(text, env_id)


def test_a_condition_of_ones_own_passes():
    check_condition(Right(), DISK)


@dataclass(frozen=True)
class Right(Condition):
    """L_f h + L_g h u + gain h^3 >= 0, of which each class below changes one thing."""

    gain: float = 1.0

    def derived(self, model, barrier):
        h = barrier.expression
        return AffineConstraint.after(model, (h,), lie_derivative_f(model, h) + self.gain * h**3)


def changed(name, **changes):
    """Return a class of conditions whose constraint has some parts changed."""

    def derived(self, model, barrier):
        found = Right.derived(self, model, barrier)
        parts = {key: change(found, model, barrier) for key, change in changes.items()}
        return replace(found, **parts)

    return dataclass(frozen=True)(
        type(name, (Right,), {"derived": derived, "__module__": __name__})
    )


WrongCoefficient = changed(
    "WrongCoefficient", coefficient=lambda found, *_: tuple(1.01 * a for a in found.coefficient)
)
WrongDrift = changed(
    "WrongDrift",
    offset=lambda found, model, b: found.offset - 2 * lie_derivative_f(model, b.expression),
)
WrongMargin = changed("WrongMargin", change=lambda *_: sp.Integer(1))
TooManyCoefficients = changed(
    "TooManyCoefficients", coefficient=lambda found, *_: found.coefficient * 2
)
WithoutChain = changed("WithoutChain", chain=lambda *_: ())
WithoutValue = changed(
    "WithoutValue", offset=lambda found, _, b: found.offset + sp.log(b.expression - 0.5)
)


@dataclass(frozen=True)
class WrongRates(Right):
    def chain_rates(self, degree):
        return (self.gain,)


@dataclass(frozen=True)
class HalfOfIto(WrongRates):
    stochastic = True

    def derived(self, model, barrier):
        h = barrier.expression
        half = (generator(model, h) + lie_derivative_f(model, h)) / 2
        return AffineConstraint.after(model, (h,), half + self.gain * h)


@dataclass(frozen=True)
class WithList(Right):
    weights: Any = field(default_factory=lambda: [1.0])


@dataclass(frozen=True)
class Unreadable(Right):
    note: str = "a:b"


@dataclass(frozen=True)
class Forgetful(Right):
    @property
    def parameters(self):
        return {}


@pytest.mark.parametrize(
    ("condition", "broken"),
    [
        (WrongCoefficient(), "derivatives: the coefficient of u"),
        (WrongDrift(), "class K: the offset of WrongDrift on h"),
        (WrongRates(2.0), "derivatives: the offset of WrongRates"),
        (HalfOfIto(), "derivatives: the offset of HalfOfIto"),
        (WrongMargin(), "derivatives: the change of WrongMargin"),
        (TooManyCoefficients(), "derived: TooManyCoefficients .*2 coefficients"),
        (WithoutChain(), "chain: WithoutChain on h"),
        (WithoutValue(), "finite: WithoutValue on h"),
        (WithList(), "parameters: WithList"),
        (Unreadable(), "text: Unreadable"),
        (Forgetful(3.0), "text: Forgetful .*gain=1.0"),
    ],
    ids=lambda part: type(part).__name__ if isinstance(part, Condition) else "",
)
def test_what_is_broken_is_named(condition, broken):
    with pytest.raises(AssertionError, match=broken):
        check_condition(condition, DISK)


@pytest.mark.parametrize(
    ("change", "broken"),
    [
        (lambda d: d._replace(action=d.action + 1e3), "bounds"),
        (lambda d: d._replace(slack=d.slack + 1.0), "infeasible: cbf has a slack"),
        (lambda d: d._replace(feasible=d.feasible | True), "infeasible: cbf"),
        (lambda d: d._replace(action=d.action + 0.1 * d.action.ndim), "batch: cbf decides"),
    ],
)
def test_decisions_that_are_broken_are_named(monkeypatch, change, broken):
    # As by a condition whose constraint is not what is compiled.
    decide = SafetyFilter.filter
    monkeypatch.setattr(SafetyFilter, "filter", lambda *args: change(decide(*args)))
    with pytest.raises(AssertionError, match=broken):
        check_condition("cbf", DISK)


def test_what_does_not_suit_the_problem_is_no_broken_property():
    with pytest.raises(RelativeDegreeError):
        check_condition("cbf", "DubinsDisk-v0")
    with pytest.raises(ConfigurationError, match="unknown filter"):
        check_condition("scfb")
