"""What an evaluation simulates: a problem of this project, or a third-party env."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from safe_envs.agents.evaluation.rollout import Env
from safe_envs.agents.policies.base import Policy, saved_policy_file
from safe_envs.agents.policies.custom import as_policy
from safe_envs.agents.policies.registry import POLICIES, make_policy
from safe_envs.dynamics.integrators import Integrator
from safe_envs.envs.spaces import center_and_half_width
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.errors import ConfigurationError, shown
from safe_envs.problem.problem import SafetyProblem
from safe_envs.registry import full_id, make_problem, title_of
from safe_envs.wrappers import (
    Condition,
    FilterSpec,
    SafetyFilterVectorWrapper,
    SafetyMonitorVector,
)

_MOST_ENVS = 64
"""Third-party envs are stepped one by one: more of them at once would only take memory."""


class NativeTarget:
    """A problem of this project.

    Args:
        problem: the problem, or the id of a registered env.
        options: arguments of `gym.make` for an id.

    Attributes:
        env_id: full id, None for a problem.
        options: as given.
        filter_spec: None.
        problem: what is simulated.
        why_no_bound: None; a bound may be looked for.

    Raises:
        ConfigurationError: The id or an option is unknown, or options are given for a problem.
    """

    filter_spec = None
    why_no_bound = None

    def __init__(self, problem: SafetyProblem | str, options: Mapping[str, Any]) -> None:
        self.env_id = full_id(problem) if isinstance(problem, str) else None
        if self.env_id is None and options:
            raise ConfigurationError(
                "options are the arguments of a registered id; configure the problem itself instead"
            )
        self.options = dict(options)
        self.problem = (
            problem if isinstance(problem, SafetyProblem) else make_problem(problem, **self.options)
        )

    @property
    def filter(self) -> str:
        """The default filter of the problem."""
        return self.problem.filter

    @property
    def title(self) -> str:
        """How results call it."""
        return self.problem.name if self.env_id is None else title_of(self.env_id, self.options)

    def make_policy(self, name: str, trust: bool) -> Any:
        """Make a policy from its name; see `make_policy`."""
        return make_policy(name, self.problem, trust)

    def adapt_policy(self, given: Any) -> Any:
        """Return a policy for an object, a class or a function; see `as_policy`."""
        return as_policy(given, self.problem)

    def env(
        self, conditions: Sequence[Condition], knowledge: str, objective: str, num_envs: int
    ) -> Env:
        """Return a batch of envs behind the filter of conditions, or unfiltered."""
        env = SafeVectorEnv(self.problem, num_envs)
        return (
            SafetyFilterVectorWrapper(env, conditions, knowledge, objective) if conditions else env
        )

    def is_deterministic(self, policy: Any) -> bool:
        """Return whether all episodes are one and the same."""
        noise = Integrator(
            self.problem.plant, self.problem.dt, self.problem.substeps, "arrays"
        ).channels
        acts_alike = policy.deterministic if isinstance(policy, Policy) else True
        return acts_alike and not noise and not self.problem.starts[self.problem.start].uniforms


class ExternalTarget:
    """A registered third-party env, with the model of it that filters believe as its problem.

    Args:
        env_id: its id.
        filter_spec: how a filter sees it.

    Attributes:
        env_id: as given.
        options: none.
        filter_spec: as given.
        problem: the model as a problem.
        why_no_bound: that the model may not be the env.

    Raises:
        ConfigurationError: The env is one of this project, has no time limit, or does not fit the
            spec.
        gymnasium.error.Error: There is no such env.
    """

    why_no_bound = "the env is not this project's, and may differ from the model"

    def __init__(self, env_id: str, filter_spec: FilterSpec) -> None:
        self.env_id, self.filter_spec = env_id, filter_spec
        self.options: dict[str, Any] = {}
        with gym.make(env_id) as env:
            if isinstance(getattr(env.unwrapped, "problem", None), SafetyProblem):
                raise ConfigurationError(
                    f"{env_id} has barriers of its own; leave the filter spec out"
                )
            steps = env.spec.max_episode_steps if env.spec else None
            if steps is None:
                raise ConfigurationError(
                    f"{env_id} has no time limit, so that its episodes have no length; register it"
                    " with max_episode_steps"
                )
            self.problem = filter_spec.problem(env.unwrapped, env.action_space, env_id, steps)
            self._spaces = env.observation_space, env.action_space

    @property
    def filter(self) -> str:
        """The filter that the filter spec names, or else the default one of the model."""
        return self.filter_spec.filter or self.problem.filter

    @property
    def title(self) -> str:
        """How results call it."""
        return self.env_id

    def adapt_policy(self, given: Any) -> Any:
        """Return a policy for the env's own observations and actions; see `as_policy`."""
        return as_policy(given, self.problem, self._spaces)

    def make_policy(self, name: str, trust: bool) -> Any:
        """Make a policy from its name; see `make_policy`. The built-in ones see the model's state.

        Args:
            name: of the policy, or a place or path.
            trust: load a .zip, which runs code in it.

        Raises:
            ConfigurationError: There is no such policy, or none for such an env.
        """
        if name == "nominal" and self.filter_spec.nominal is None:
            raise ConfigurationError(
                "the filter spec has no nominal controller; give it one, or --policy zero, random"
                " or a .zip"
            )
        if name in POLICIES:
            return _ModelPolicy(
                make_policy(name, self.problem), self.filter_spec, self.problem, self._spaces[1]
            )
        if saved_policy_file(Path(name)) is not None:
            raise ConfigurationError(
                f"{name} holds a policy for envs of this project; give a .zip of Stable-Baselines3"
                f" for {self.env_id}"
            )
        return make_policy(name, self.problem, trust, self._spaces)

    def env(
        self, conditions: Sequence[Condition], knowledge: str, objective: str, num_envs: int
    ) -> Env:
        """Return a batch of envs behind the filter of conditions, or unfiltered."""
        if knowledge != "model":
            raise ConfigurationError(
                f"knowledge = {shown(knowledge)}: of a third-party env nothing is known but the"
                " model"
            )
        env = SafetyMonitorVector(
            gym.make_vec(
                self.env_id, num_envs=min(num_envs, _MOST_ENVS), vectorization_mode="sync"
            ),
            self.filter_spec,
        )
        return (
            SafetyFilterVectorWrapper(env, conditions, knowledge, objective) if conditions else env
        )

    def is_deterministic(self, policy: Any) -> bool:
        """Return False: whether all episodes are one and the same is unknown."""
        return False


class _ModelPolicy(Policy):
    """A policy for the model's problem, from the env's observations to the env's actions."""

    def __init__(
        self, policy: Policy, filter_spec: FilterSpec, problem: SafetyProblem, space: Any
    ) -> None:
        self._policy, self._filter_spec, self._space = policy, filter_spec, space
        self.deterministic = policy.deterministic
        self._center, self._half = (np.array(part) for part in center_and_half_width(problem))

    def begin(self, episodes: range, seed: int) -> None:
        """See `Policy.begin`."""
        self._policy.begin(episodes, seed)

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, Any]:
        """Choose actions of the env; see `Policy.predict`."""
        x = self._filter_spec.state(observation, np.shape(observation)[:-1])
        actions, state = self._policy.predict(x, state, episode_start, deterministic)
        space = self._space
        return (
            np.clip(
                self._filter_spec.actions(self._center + self._half * actions),
                space.low,
                space.high,
            ).astype(space.dtype),
            state,
        )


def make_target(
    problem: SafetyProblem | str,
    options: Mapping[str, Any],
    filter_spec: FilterSpec | str | None,
) -> NativeTarget | ExternalTarget:
    """Return what to simulate; see `EvaluationSpec` for the arguments.

    Raises:
        ConfigurationError: See the classes; or a filter spec comes with a problem or with options.
    """
    if filter_spec is None:
        return NativeTarget(problem, options)
    given = list(options)
    if not isinstance(problem, str) or given:
        wrong = ", ".join(given) or "a SafetyProblem"
        raise ConfigurationError(
            f"a filter spec is for the id of a third-party env, without {wrong}"
        )
    if isinstance(filter_spec, str):
        filter_spec = FilterSpec.load(filter_spec)
    return ExternalTarget(problem, filter_spec)
