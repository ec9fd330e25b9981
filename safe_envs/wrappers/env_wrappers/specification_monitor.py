"""A temporal specification of an env, judged while it runs, in `info`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import Components
from safe_envs.envs.env import SafeEnv
from safe_envs.envs.info import Info
from safe_envs.envs.reset_options import refuse_time
from safe_envs.independent_copies import IndependentCopies
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.env_wrappers.monitor import SafetyMonitor
from safe_envs.wrappers.env_wrappers.state_layer import state_layer
from safe_envs.wrappers.value.specification_tracker import SpecificationTracker


class SpecificationMonitor(
    IndependentCopies,
    gym.Wrapper[np.ndarray, Any, np.ndarray, Any],
    gym.utils.RecordConstructorArgs,
):
    """Adds robustness, satisfied, verdict and automaton_state to `info`.

    Actions, rewards and ends of episodes pass unchanged. The trace is of the states at reset and
    after each step; a state that is set between steps is not in it. At the last step of an episode
    `info["satisfied"]` says whether it met the specification.

    Args:
        env: one of this project's envs, or any under a `SafetyMonitor`; possibly filtered.
        specification: such as "always safe & eventually goal", over `safe`, the problem's `goal`
            and its regions; see `safe_envs.wrappers.value.specification_text`.
        regions: further ones, expressions of the states by name, >= 0 inside.

    Attributes:
        tracker: automaton, and where the episode stands.

    Raises:
        ConfigurationError: the env does not show its state, or the text is no specification over
            its sets.
        SystemDefinitionError: a region is no expression of the states.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        specification: str,
        regions: Mapping[str, sp.Expr] | None = None,
    ) -> None:
        gym.utils.RecordConstructorArgs.__init__(self, specification=specification, regions=regions)
        gym.Wrapper.__init__(self, env)
        self._inner = state_layer(env, (SafeEnv, SafetyMonitor), vector=False)
        problem = with_regions(self._inner.problem, regions)
        self.tracker = SpecificationTracker(problem, specification, 1)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, Info]:
        """Start an episode, at time 0; see `SafeEnv.reset`.

        Raises:
            ConfigurationError: see `SafeEnv.reset`; or another time is given.
        """
        if self._inner is self._inner.unwrapped:
            refuse_time(options, "the specification")
        observation, info = self.env.reset(seed=seed, options=options)
        self.tracker.begin(self._x, np.ones(1, dtype=bool))
        return observation, {**info, **self._report()}

    def step(self, action: Any) -> tuple[np.ndarray, Any, bool, bool, Info]:
        """Pass on an action, and judge the trace."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.tracker.advance(self._x)
        return observation, reward, terminated, truncated, {**info, **self._report()}

    @property
    def _x(self) -> Components:
        return tuple(np.array(self._inner.components)[:, None])

    def _report(self) -> Info:
        return {key: value.item() for key, value in self.tracker.report().items()}


def with_regions(problem: SafetyProblem, regions: Mapping[str, sp.Expr] | None) -> SafetyProblem:
    """Return a problem with further regions; raises as `SpecificationMonitor`.

    Args:
        problem: which may have some.
        regions: expressions by name; None for no further ones.
    """
    return replace(problem, regions={**problem.regions, **regions}) if regions else problem
