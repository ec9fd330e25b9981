"""What an evaluation simulates: a problem of this project, or a third-party env."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym

from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.errors import ConfigurationError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.registry import full_id, make_problem, title_of
from safe_envs.wrappers import FilterSpec, SafetyFilterVectorWrapper, SafetyMonitorVector

Env = SafeVectorEnv | SafetyMonitorVector | SafetyFilterVectorWrapper
"""A batch of envs."""

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
        spaces: None, those of the problem's env.
        problem: what is simulated.
        filter: its default one.
        title: what results call it.
        why_no_bound: None; a bound may be looked for.

    Raises:
        ConfigurationError: The id or an option is unknown, or options are given for a problem.
    """

    filter_spec = spaces = why_no_bound = None

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
        self.filter = self.problem.filter
        self.title = self.problem.name if self.env_id is None else title_of(self.env_id, options)

    def env(self, num_envs: int) -> Env:
        """Return a batch of unfiltered envs."""
        return SafeVectorEnv(self.problem, num_envs)


class ExternalTarget:
    """A registered third-party env, with the model of it that filters believe as its problem.

    Args:
        env_id: its id.
        filter_spec: how a filter sees it.

    Attributes:
        env_id: as given.
        options: none.
        filter_spec: as given.
        spaces: of observations and actions.
        problem: the model as a problem.
        filter: the one that the filter spec names, or else the default one of the model.
        title: the id.
        why_no_bound: that the model may not be the env.

    Raises:
        ConfigurationError: The env is one of this project, has no time limit, or does not fit the
            spec.
        gymnasium.error.Error: There is no such env.
    """

    why_no_bound = "the env is not this project's, and may differ from the model"

    def __init__(self, env_id: str, filter_spec: FilterSpec) -> None:
        self.env_id = self.title = env_id
        self.filter_spec = filter_spec
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
            self.spaces = env.observation_space, env.action_space
        self.filter = filter_spec.filter or self.problem.filter

    def env(self, num_envs: int) -> Env:
        """Return a batch of unfiltered envs."""
        size = min(num_envs, _MOST_ENVS)
        env = gym.make_vec(self.env_id, num_envs=size, vectorization_mode="sync")
        return SafetyMonitorVector(env, self.filter_spec)


def make_target(
    problem: SafetyProblem | str, options: Mapping[str, Any], filter_spec: FilterSpec | str | None
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
