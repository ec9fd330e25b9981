"""The check of a policy finds what is wrong with one, and nothing where nothing is."""

from __future__ import annotations

import numpy as np
import pytest

from safe_envs import InvalidInputError
from safe_envs.agents import POLICIES, NominalController, Policy
from safe_envs.agents.policies.best import BestPolicy
from safe_envs.registry import make_problem
from safe_envs.testing.policy import check_policy
from tests.agents.policies.coarse import COARSE, SHORT


class Base:
    def __init__(self, problem):
        self.calls, self.m = 0, len(problem.inputs)

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        self.calls += 1
        return self.act(observation), state

    def act(self, observation):
        return np.tanh(observation[:, : self.m])


class Flat(Base):
    def act(self, observation):
        return np.tanh(observation[:, 0])


class Wide(Base):
    def act(self, observation):
        return 2.0 + observation[:, : self.m]


class Undefined(Base):
    def act(self, observation):
        return np.full((len(observation), self.m), np.nan)


class Counting(Base):
    def act(self, observation):
        return np.full((len(observation), self.m), 1.0 / self.calls)


class Centred(Base):
    def act(self, observation):
        return np.tanh(observation[:, : self.m] - observation[:, : self.m].mean(axis=0))


class Overwriting(Base):
    def act(self, observation):
        observation *= 0.5
        return np.tanh(observation[:, : self.m])


class Drawing(Base):
    def act(self, observation):
        return np.random.default_rng().uniform(-1, 1, (len(observation), self.m))


class Bare(Base):
    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return np.zeros((len(observation), self.m))


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
        (Flat, "shape"),
        (Wide, "range"),
        (Undefined, "finite"),
        (Counting, "repeatability"),
        (Centred, "independence"),
        (Overwriting, "observation"),
        (Drawing, "repeatability"),
        (Bare, "interface"),
        (lambda problem: Seeded(), "deterministic"),
        (lambda observation: observation.mean(axis=0), None),
    ],
)
def test_broken_policies_are_found(policy, name):
    made = policy(None) if name == "deterministic" else policy
    if name is None:
        with pytest.raises(InvalidInputError, match="returned actions of shape"):
            check_policy(made, "StochasticDubins-v0")
    else:
        with pytest.raises(AssertionError, match=rf"{name}: "):
            check_policy(made)


@pytest.mark.parametrize("policy", [name for name in POLICIES if name not in ("best", "clf")])
def test_policies_of_this_project_are_sound(policy):
    check_policy(policy, "StochasticDubins-v0")


def test_classes_functions_and_objects_are_sound():
    check_policy(Base)
    check_policy(Admitted())
    check_policy(NominalController, "Quadrotor-v0")
    check_policy(lambda observation: np.tanh(observation[:, 0]))
    check_policy("clf", "CubicSDE-v0")


def test_the_best_policy_is_sound():
    problem = make_problem("Scalar-v0", **SHORT)
    check_policy(BestPolicy(problem, COARSE), problem)
