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


@pytest.mark.parametrize(
    ("text", "env_id"),
    [
        ("cbf:alpha=s+s**3", "Scalar-v0"),
        ("rcbf", "Pendulum-v0"),
        ("srcbf:form=log", "CubicSDEDisk-v0"),
        ("hocbf:p=2,s*Abs(s)", "DubinsDisk-v0"),
        ("ecbf:sampling_margin=first-order", "StochasticDubins-v0"),
        ("szcbf:sampling_margin=first-order", "ACCGap-v0"),
        ("scbf:sampling_margin=0.1", "QuadrotorLimits-v0"),
        ("hocbf", "DubinsObstacles-v0"),
    ],
)
def test_the_conditions_of_this_package_pass(text, env_id):
    check_condition(text, env_id)


@dataclass(frozen=True)
class Right(Condition):
    """L_f h + L_g h u + gain h^3 >= 0, of which each class below changes one thing."""

    gain: float = 1.0

    def derived(self, model, barrier):
        h = barrier.expression
        return AffineConstraint.after(model, (h,), lie_derivative_f(model, h) + self.gain * h**3)


@dataclass(frozen=True)
class WrongCoefficient(Right):
    def derived(self, model, barrier):
        found = super().derived(model, barrier)
        return replace(found, coefficient=tuple(1.01 * a for a in found.coefficient))


@dataclass(frozen=True)
class WrongDrift(Right):
    def derived(self, model, barrier):
        found = super().derived(model, barrier)
        return replace(found, offset=found.offset - 2 * lie_derivative_f(model, barrier.expression))


@dataclass(frozen=True)
class WrongRates(Right):
    def chain_rates(self, degree):
        return (self.gain,)


@dataclass(frozen=True)
class HalfOfIto(Right):
    stochastic = True

    def derived(self, model, barrier):
        h = barrier.expression
        half = (generator(model, h) + lie_derivative_f(model, h)) / 2
        return AffineConstraint.after(model, (h,), half + self.gain * h)

    def chain_rates(self, degree):
        return (self.gain,)


@dataclass(frozen=True)
class WrongMargin(Right):
    def derived(self, model, barrier):
        found = super().derived(model, barrier)
        return replace(found, change=sp.Integer(1))


@dataclass(frozen=True)
class TooManyCoefficients(Right):
    def derived(self, model, barrier):
        found = super().derived(model, barrier)
        return replace(found, coefficient=found.coefficient * 2)


@dataclass(frozen=True)
class WithoutChain(Right):
    def derived(self, model, barrier):
        return replace(super().derived(model, barrier), chain=())


@dataclass(frozen=True)
class WithoutValue(Right):
    def derived(self, model, barrier):
        found = super().derived(model, barrier)
        return replace(found, offset=found.offset + sp.log(barrier.expression - 0.5))


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
        (TooManyCoefficients(), "derived: TooManyCoefficients .*2 coefficients for 1 inputs"),
        (WithoutChain(), "chain: WithoutChain on h has none"),
        (WithoutValue(), "finite: WithoutValue on h has no value"),
        (WithList(), "parameters: WithList cannot be hashed"),
        (Unreadable(), "text: Unreadable writes .* cannot be read"),
        (Forgetful(3.0), "text: Forgetful writes .*gain=1.0"),
    ],
    ids=lambda part: type(part).__name__ if isinstance(part, Condition) else "",
)
def test_what_is_broken_is_named(condition, broken):
    disk = problem_of("safe_envs/CubicSDEDisk-v0")
    check_condition(Right(), disk)
    with pytest.raises(AssertionError, match=broken):
        check_condition(condition, disk)


def broken_filter(monkeypatch, change):
    """Let decisions be changed, as by a condition whose constraint is not what is compiled."""
    decide = SafetyFilter.filter
    monkeypatch.setattr(SafetyFilter, "filter", lambda *args: change(decide(*args)))


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
    broken_filter(monkeypatch, change)
    with pytest.raises(AssertionError, match=broken):
        check_condition("cbf", problem_of("safe_envs/CubicSDEDisk-v0"))


def test_what_does_not_suit_the_problem_is_no_broken_property():
    with pytest.raises(RelativeDegreeError):
        check_condition("cbf", "DubinsDisk-v0")
    with pytest.raises(ConfigurationError, match="unknown filter"):
        check_condition("scfb")
