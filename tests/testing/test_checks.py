"""The checks for authors of conditions, policies and systems pass what is right, and name what is
broken."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
import pytest
import sympy as sp

from safe_envs import Barrier, ControlAffineSDE, InvalidInputError, SafetyProblem, define_problem
from safe_envs.agents import POLICIES, NominalController, Policy
from safe_envs.agents.policies.best import BestPolicy
from safe_envs.dynamics.lie import generator, lie_derivative_f
from safe_envs.errors import ConfigurationError, RelativeDegreeError
from safe_envs.filters.safety_filter import SafetyFilter
from safe_envs.problem.signals import Feature
from safe_envs.problem.starts import Start
from safe_envs.registry import make_problem
from safe_envs.testing.condition import check_condition
from safe_envs.testing.policy import check_policy
from safe_envs.testing.system import check_system
from safe_envs.values.tables import ValueSettings
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


# The check of a policy finds what is wrong with one, and nothing where nothing is.


class Sound:
    """A policy that each case below breaks in one way."""

    def __init__(self, problem):
        self.calls, self.m = 0, len(problem.inputs)

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        self.calls += 1
        return self.act(observation), state

    def act(self, observation):
        return np.tanh(observation[:, : self.m])


class Bare(Sound):
    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return self.act(observation)


def overwrite(policy, observation):
    observation *= 0.5
    return np.tanh(observation[:, : policy.m])


def acting(act):
    return type("Broken", (Sound,), {"act": act})


class Seeded(Policy):
    """Draws for each episode, but does not say so."""

    def begin(self, episodes, seed):
        self.rngs = [np.random.default_rng([seed, i]) for i in episodes]

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return np.stack([rng.uniform(-1, 1, 1) for rng in self.rngs]), state


class Admitted(Seeded):
    deterministic = False


@pytest.mark.parametrize(
    ("policy", "name"),
    [
        (acting(lambda self, o: np.tanh(o[:, 0])), "shape"),
        (acting(lambda self, o: 2.0 + o[:, : self.m]), "range"),
        (acting(lambda self, o: np.full((len(o), self.m), np.nan)), "finite"),
        (acting(lambda self, o: np.full((len(o), self.m), 1.0 / self.calls)), "repeatability"),
        (acting(lambda self, o: np.tanh(o[:, : self.m] - o[:, : self.m].mean(0))), "independence"),
        (acting(overwrite), "observation"),
        (
            acting(lambda self, o: np.random.default_rng().uniform(-1, 1, (len(o), self.m))),
            "repeat",
        ),
        (Bare, "interface"),
        (Seeded(), "deterministic"),
    ],
)
def test_broken_policies_are_found(policy, name):
    with pytest.raises(AssertionError, match=rf"{name}.*: "):
        check_policy(policy)


def test_a_function_returns_an_action_for_each_observation():
    with pytest.raises(InvalidInputError, match="shape"):
        check_policy(lambda observation: observation.mean(axis=0), "StochasticDubins-v0")


@pytest.mark.parametrize(
    ("policy", "env_id"),
    [
        *((name, "StochasticDubins-v0") for name in POLICIES if name not in ("best", "clf")),
        ("clf", "CubicSDE-v0"),
        (NominalController, "Quadrotor-v0"),
        (Sound, "StochasticDubins-v0"),
        (Admitted(), "StochasticDubins-v0"),
        (lambda observation: np.tanh(observation[:, 0]), "StochasticDubins-v0"),
    ],
)
def test_names_classes_objects_and_functions_are_sound(policy, env_id):
    check_policy(policy, env_id)


def test_the_best_policy_is_sound():
    problem = make_problem("Scalar-v0", horizon=0.3)
    settings = ValueSettings(knowledge="plant", cells=(400,), inputs=9)
    check_policy(BestPolicy(problem, settings), problem)


# The check of a system passes what is sound, and names what is broken.


x, u, s = sp.symbols("x u s", real=True)
SLOW = ControlAffineSDE((x,), (u,), [-x], [1], [s], {s: 0.1})


def stated(barrier=1 - x, system=SLOW, **changes) -> SafetyProblem:
    numbers = {"input_bounds": (-1, 1), "start": [(-0.5, 0.5)], "dt": 0.1, "horizon": 10.0}
    return define_problem(system, barrier, **{**numbers, **changes})


def test_every_registered_system_passes(env_id):
    check_system(problem_of(env_id))


@pytest.mark.parametrize("system", [stated, stated(), f"{__name__}:stated", "Scalar-v0"])
def test_a_problem_a_function_and_a_place_pass(system):
    check_system(system)


class Other(SafetyProblem):
    """Comes back from a pickle as something else."""

    def __reduce__(self):
        return stated, ()


def other() -> SafetyProblem:
    given = stated()
    return Other(**{f.name: getattr(given, f.name) for f in fields(given) if f.init})


def often_unsafe() -> SafetyProblem:
    given = stated()
    uniform = sp.Symbol("uniform", real=True)
    return replace(given, starts={"wide": Start((4 * uniform,), (uniform,))}, start="wide")


def chaotic() -> SafetyProblem:
    """x goes to .97 sin(pi x), which doubles an error of rounding at each step."""
    moved = (sp.Rational(97, 100) * sp.sin(sp.pi * x) - x) * 10
    system = ControlAffineSDE((x,), (u,), [moved], [1], [s], {s: 1e-9})
    return stated(2 - x, system, start=[(0.2, 0.8)], input_bounds=(-1e-9, 1e-9))


CALLS = itertools.count()
BROKEN = {
    "definition: .* gives 3": lambda: 3,
    "definition: input u never": lambda: replace(stated(), plant=replace(SLOW, input_matrix=[0])),
    "definition: every start is unsafe": lambda: replace(stated(), barriers=(Barrier(x - 2),)),
    "reproducible: ": lambda: stated(1 + next(CALLS) - x),
    "round trip: noise names": lambda: replace(stated(), noise=("sigma",)),
    "round trip: unpickled": other,
    "reset: the start": often_unsafe,
    "bounds: the observation": lambda: stated(features=(Feature("x", x, -0.1, 0.1),)),
    "batch: .* rounding": chaotic,
    "derivatives: that of .* too fast": lambda: stated(1 - x + 1e-8 * sp.sin(1e9 * x)),
}


@pytest.mark.parametrize("message", BROKEN)
def test_what_is_broken_of_a_system_is_named(message):
    with pytest.raises(AssertionError, match=f"^{message}"):
        check_system(BROKEN[message], steps=100)
