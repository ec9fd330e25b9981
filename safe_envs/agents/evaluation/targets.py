"""What an evaluation simulates: an env of this project, or one of somebody else, seen through a
filter's spec."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from safe_envs.agents.evaluation.rollout import Env
from safe_envs.agents.policies.registry import POLICIES, Policy, is_data, make_policy, policy_file
from safe_envs.dynamics.integrators import Integrator
from safe_envs.envs.simulation import center_and_half_width
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.errors import ConfigurationError, shown
from safe_envs.problem.problem import SafetyProblem
from safe_envs.registry import full_id, make_problem, title_of
from safe_envs.wrappers import Condition, FilterSpec, SafetyFilterVectorWrapper, SafetyMonitorVector

_MOST_ENVS = 64
"""Envs of somebody else are stepped one by one: more of them at once would only take memory."""


class NativeTarget:
    """A problem of this project.

    Args:
        problem: the problem, or the id of a registered env.
        options: arguments of `gym.make` for an id.

    Attributes:
        env_id: full id, None for a problem.
        options: those given that are not None.
        spec: None.
        problem: what is simulated.
        why_no_bound: None; a bound may be looked for.

    Raises:
        ConfigurationError: the id or an option is unknown, or options are given for a problem.
    """

    spec = None
    why_no_bound = None

    def __init__(self, problem: SafetyProblem | str, options: Mapping[str, Any] | None) -> None:
        self.env_id = full_id(problem) if isinstance(problem, str) else None
        if self.env_id is None and options:
            raise ConfigurationError(
                "options are the arguments of a registered id; configure the problem itself instead"
            )
        self.options = {k: v for k, v in (options or {}).items() if v is not None}
        self.problem = (
            problem if isinstance(problem, SafetyProblem) else make_problem(problem, **self.options)
        )

    @property
    def filter(self) -> str:
        """The filter that suits it."""
        return self.problem.filter

    @property
    def title(self) -> str:
        """How results call it."""
        return self.problem.name if self.env_id is None else title_of(self.env_id, self.options)

    def policy(self, name: str, trust: bool) -> Policy:
        """Make a policy from its name; see `make_policy`."""
        return make_policy(name, self.problem, trust)

    def env(
        self, conditions: Sequence[Condition], knowledge: str, objective: str, num_envs: int
    ) -> Env:
        """A batch of envs behind the filter of conditions, or bare."""
        env = SafeVectorEnv(self.problem, num_envs)
        return (
            SafetyFilterVectorWrapper(env, conditions, knowledge, objective) if conditions else env
        )

    def is_deterministic(self, policy: Any) -> bool:
        """Whether all episodes are one and the same."""
        noise = Integrator(
            self.problem.plant, self.problem.dt, self.problem.substeps, "arrays"
        ).channels
        acts_alike = policy.deterministic if isinstance(policy, Policy) else True
        return acts_alike and not noise and not self.problem.starts[self.problem.start].uniforms


class ExternalTarget:
    """A registered env that knows nothing of safety, with the model of it that filters believe for
    its problem.

    Args:
        env_id: id of it.
        spec: how a filter sees it.

    Attributes:
        env_id: as given.
        options: none.
        spec: as given.
        problem: the model as a problem.
        why_no_bound: nobody knows whether the model is the env.

    Raises:
        ConfigurationError: the env is one of this project, has no time limit, or does not fit the
            spec.
        gymnasium.error.Error: there is no such env.
    """

    why_no_bound = "the env is not this project's, and may differ from the model"

    def __init__(self, env_id: str, spec: FilterSpec) -> None:
        self.env_id, self.spec = env_id, spec
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
            self.problem = spec.problem(env.unwrapped, env.action_space, env_id, steps)
            self._spaces = env.observation_space, env.action_space

    @property
    def filter(self) -> str:
        """The filter that its spec names, or that suits the model."""
        return self.spec.filter or self.problem.filter

    @property
    def title(self) -> str:
        """How results call it."""
        return self.env_id

    def policy(self, name: str, trust: bool) -> Policy:
        """Make a policy from its name; see `make_policy`. The named ones see the model's state.

        Raises:
            ConfigurationError: there is no such policy, or none for such an env.
        """
        if name == "nominal" and self.spec.nominal is None:
            raise ConfigurationError(
                "the filter spec has no nominal controller; give it one, or --policy zero, random"
                " or a .zip"
            )
        if name in POLICIES:
            return _OfModel(
                make_policy(name, self.problem), self.spec, self.problem, self._spaces[1]
            )
        if is_data(policy_file(name)):
            raise ConfigurationError(
                f"{name} holds a policy for envs of this project; give a .zip of Stable-Baselines3"
                f" for {self.env_id}"
            )
        return make_policy(name, self.problem, trust, self._spaces)

    def env(
        self, conditions: Sequence[Condition], knowledge: str, objective: str, num_envs: int
    ) -> Env:
        """A batch of envs behind the filter of conditions, or bare."""
        if knowledge != "model":
            raise ConfigurationError(
                f"knowledge = {shown(knowledge)}: of an env of somebody else nothing is known but"
                " the model"
            )
        env = SafetyMonitorVector(
            gym.make_vec(
                self.env_id, num_envs=min(num_envs, _MOST_ENVS), vectorization_mode="sync"
            ),
            self.spec,
        )
        return (
            SafetyFilterVectorWrapper(env, conditions, knowledge, objective) if conditions else env
        )

    def is_deterministic(self, policy: Any) -> bool:
        """Nobody knows whether all episodes are one and the same."""
        return False


class _OfModel(Policy):
    """A policy for the model's problem as one for the env: from its observations to its actions."""

    def __init__(
        self, policy: Policy, spec: FilterSpec, problem: SafetyProblem, space: Any
    ) -> None:
        self._policy, self._spec, self._space = policy, spec, space
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
        x = self._spec.state(observation, np.shape(observation)[:-1])
        actions, state = self._policy.predict(x, state, episode_start, deterministic)
        space = self._space
        return (
            np.clip(
                self._spec.actions(self._center + self._half * actions), space.low, space.high
            ).astype(space.dtype),
            state,
        )


def world_of(
    problem: SafetyProblem | str, options: Mapping[str, Any] | None, spec: FilterSpec | str | None
) -> NativeTarget | ExternalTarget:
    """What to simulate; see `safe_envs.agents.evaluation.evaluate.evaluate` for the arguments.

    Raises:
        ConfigurationError: see the classes, or a spec comes with a problem or with options.
    """
    if spec is None:
        return NativeTarget(problem, options)
    given = [name for name, value in (options or {}).items() if value is not None]
    if not isinstance(problem, str) or given:
        wrong = ", ".join(given) or "a SafetyProblem"
        raise ConfigurationError(
            f"a filter spec is for the id of an env of somebody else, without {wrong}"
        )
    return ExternalTarget(problem, FilterSpec.load(spec) if isinstance(spec, str) else spec)
