"""A temporal specification of an env, judged while it runs, in `info`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import sympy as sp
from gymnasium.vector import AutoresetMode

from safe_envs.dynamics.codegen import Components
from safe_envs.envs.env import SafeEnv
from safe_envs.envs.info import Info, VectorStep, with_masks
from safe_envs.envs.starts import refuse_time
from safe_envs.errors import IndependentCopies
from safe_envs.filters.specification import SpecificationTracker
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.layers import state_layer
from safe_envs.wrappers.monitor import SafetyMonitor
from safe_envs.wrappers.safety_filter import readable


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
            and its regions; see `safe_envs.filters.specification`.
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


class SpecificationMonitorVector(IndependentCopies, gym.vector.VectorWrapper):
    """`SpecificationMonitor` over a whole batch: arrays with the batch in front, and masks.

    A step that only resets an env (next-step autoreset) begins its trace. With same-step autoreset
    what is said of a whole episode is in `final_info`.

    Args:
        env: a vector env of this project, or any under a `SafetyMonitorVector`; possibly filtered.
        specification: see `SpecificationMonitor`.
        regions: see there.

    Attributes:
        tracker: automaton, and where the episodes stand.

    Raises:
        ConfigurationError: see `SpecificationMonitor`.
        SystemDefinitionError: see there.
    """

    def __init__(
        self,
        env: gym.vector.VectorEnv,
        specification: str,
        regions: Mapping[str, sp.Expr] | None = None,
    ) -> None:
        gym.vector.VectorWrapper.__init__(self, env)
        self._inner = readable(env)
        problem = with_regions(self._inner.problem, regions)
        self.tracker = SpecificationTracker(problem, specification, self.num_envs)
        self.autoreset_mode = env.metadata["autoreset_mode"]

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, Info]:
        """Start episodes in every env, or those of a mask; see `SpecificationMonitor.reset`."""
        if self._inner is self._inner.unwrapped:
            refuse_time(options, "the specification")
        observation, info = self.env.reset(seed=seed, options=options)
        present = info["_cost"]
        self.tracker.begin(self._inner.components, present)
        return observation, {**info, **with_masks(self.tracker.report(), present)}

    def step(self, actions: Any) -> VectorStep:
        """Pass on actions, and judge the traces."""
        observation, reward, terminated, truncated, info = self.env.step(actions)
        x, episodes = self._inner.components, self._inner.episodes
        begun = episodes.begun
        restarted = bool(np.count_nonzero(begun))
        if restarted and self.autoreset_mode == AutoresetMode.SAME_STEP:
            last = np.where(begun[:, None], episodes.last_states, np.stack(x, axis=-1))
            self.tracker.advance(tuple(last.T))
            info["final_info"].update(with_masks(self.tracker.report(), begun))
        else:
            self.tracker.advance(x)
        if restarted:
            self.tracker.begin(x, begun)
        info.update(with_masks(self.tracker.report(), info["_cost"]))
        return observation, reward, terminated, truncated, info

    def snapshot(self) -> dict[str, np.ndarray]:
        """Return that of the env, and where its traces stand; see `SafeVectorEnv.snapshot`."""
        tracker = self.tracker
        return {
            **self.env.snapshot(),  # pyright: ignore[reportAttributeAccessIssue]
            "specification_steps": tracker.steps.copy(),
            "automaton_state": tracker.states.copy(),
            "specification_registers": tracker.registers.T.copy(),
        }

    def restore(self, snapshot: Mapping[str, np.ndarray], seed: Any = None) -> None:
        """Put each episode where a snapshot has it; see `SafeVectorEnv.restore`."""
        self.env.restore(snapshot, seed)  # pyright: ignore[reportAttributeAccessIssue]
        self.tracker.steps = np.array(snapshot["specification_steps"])
        self.tracker.states = np.array(snapshot["automaton_state"])
        self.tracker.registers = np.array(snapshot["specification_registers"]).T.copy()
