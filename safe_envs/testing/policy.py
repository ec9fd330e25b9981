"""Checks of a policy, for its author."""

from __future__ import annotations

from typing import Any

import numpy as np

from safe_envs.agents.evaluation.episodes import episode_seed
from safe_envs.agents.policies.base import Policy
from safe_envs.agents.policies.registry import make_policy, policy_name
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.problem.problem import SafetyProblem
from safe_envs.registry import make_problem

_TOLERANCE = 1e-5
"""Between the actions in a batch and in single episodes, where a network may round differently."""


def check_policy(
    policy: Any,
    problem: SafetyProblem | str = "Scalar-v0",
    *,
    episodes: int = 5,
    steps: int = 8,
    seed: int = 0,
    trust: bool = False,
) -> None:
    """Check that a policy does what evaluations take for granted.

    Its actions have the shape (B, m), are finite and in [-1, 1]; observations stay as they are; the
    same episodes get the same actions again, so that nothing leaks from one evaluation to the next;
    the actions in an episode do not depend on the other episodes of its batch; and equal
    observations get equal actions, unless the policy says that it is not deterministic.

    Args:
        policy: as for `evaluate`: a name or FILE.py:NAME, an object with `predict`, a class of such
            objects, or a function of a batch of observations.
        problem: problem, or the id of its env.
        episodes: number of episodes side by side.
        steps: control periods of each, at most.
        seed: of the episodes.
        trust: load a .zip, which runs code in it.

    Raises:
        AssertionError: A property does not hold; the message begins with its name.
        ConfigurationError: There is no such policy.
    """
    if isinstance(problem, str):
        problem = make_problem(problem)
    actor = make_policy(policy, problem, trust)
    found = _Checked(actor, problem, seed, min(steps, problem.steps))
    together = found.actions(range(episodes))
    again = found.actions(range(episodes))
    _require_equal(
        together,
        again,
        f"repeatability: {found.name} acts differently in the same episodes the second time; reset"
        " what it remembers in begin(), keep memory in the hidden state, and draw random numbers"
        " from generators that begin() seeds",
    )
    for i in range(episodes):
        _require_equal(
            together[:, i : i + 1],
            found.actions(range(i, i + 1)),
            f"independence: {found.name} acts differently in episode {i} alone than in a batch of"
            f" {episodes}; the action of a row may depend on that row only",
        )
    found.check_deterministic(episodes)


class _Checked:
    """A policy whose every call is checked."""

    def __init__(self, policy: Any, problem: SafetyProblem, seed: int, steps: int) -> None:
        self._policy, self._problem = policy, problem
        self._seed, self._steps = seed, steps
        self.name = policy_name(policy)

    def actions(self, episodes: range) -> np.ndarray:
        """Return the actions in the first steps of episodes, shape (K, B, m).

        After its end an episode goes on with the observation of the next one.
        """
        env = SafeVectorEnv(self._problem, len(episodes))
        self._begin(episodes)
        observation, _ = env.reset(seed=[episode_seed(self._seed, i) for i in episodes])
        state, start = None, np.ones(len(episodes), dtype=bool)
        running, found = start.copy(), []
        for _ in range(self._steps):
            actions, state = self._predict(observation, state, start)
            found.append(np.where(running[:, None], actions, 0.0))
            observation, _, terminated, truncated, _ = env.step(np.asarray(actions))
            start = terminated | truncated
            running &= ~start
        return np.stack(found)

    def check_deterministic(self, count: int) -> None:
        """Check that equal observations get equal actions, where the policy says so.

        Args:
            count: number of equal observations.
        """
        if not getattr(self._policy, "deterministic", True):
            return
        env = SafeVectorEnv(self._problem, 1)
        observation, _ = env.reset(seed=[episode_seed(self._seed, 0)])
        self._begin(range(count))
        actions, _ = self._predict(
            np.repeat(observation, count, axis=0), None, np.ones(count, dtype=bool)
        )
        assert np.ptp(actions, axis=0).max() <= _TOLERANCE, (
            f"deterministic: {self.name} answers equal observations with different actions; set"
            " deterministic = False in its class"
        )

    def _begin(self, episodes: range) -> None:
        if isinstance(self._policy, Policy):
            self._policy.begin(episodes, self._seed)

    def _predict(
        self, observation: np.ndarray, state: Any, start: np.ndarray
    ) -> tuple[np.ndarray, Any]:
        given = observation.copy()
        found = self._policy.predict(given, state, start, deterministic=True)
        assert isinstance(found, tuple) and len(found) == 2, (  # noqa: PT018
            f"interface: predict of {self.name} returned a {type(found).__name__}; return the"
            " actions and the hidden state, which is None without one"
        )
        assert np.array_equal(given, observation), (
            f"observation: {self.name} changes it in place; work on a copy"
        )
        actions, wanted = np.asarray(found[0]), (len(observation), len(self._problem.inputs))
        assert actions.shape == wanted, (
            f"shape: {self.name} returned actions of shape {actions.shape} for observations of"
            f" shape {observation.shape}; return {wanted}"
        )
        assert np.isfinite(actions).all(), (
            f"finite: {self.name} returned {actions[~np.isfinite(actions)][0]}"
        )
        assert abs(actions).max() <= 1.0 + _TOLERANCE, (
            f"range: {self.name} returned {actions.flat[abs(actions).argmax()]:g}; actions are in"
            " [-1, 1], which are the input bounds"
        )
        return actions, found[1]


def _require_equal(first: np.ndarray, second: np.ndarray, message: str) -> None:
    assert np.allclose(first, second, rtol=0.0, atol=_TOLERANCE), message
