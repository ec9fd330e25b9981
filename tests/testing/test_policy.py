"""The check of a policy finds what is wrong with one, and nothing where nothing is."""

from __future__ import annotations

import numpy as np
import pytest

from safe_envs import InvalidInputError
from safe_envs.agents import POLICIES, NominalController, Policy
from safe_envs.agents.policies.best import BestPolicy
from safe_envs.registry import make_problem
from safe_envs.testing.policy import check_policy
from safe_envs.values.tables import ValueSettings


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
