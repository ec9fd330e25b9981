"""A temporal specification of the envs of a batch; see `specification_monitor`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
import sympy as sp
from gymnasium.vector import AutoresetMode

from safe_envs.envs.info import Info, VectorStep, with_masks
from safe_envs.envs.reset_options import refuse_time
from safe_envs.independent_copies import IndependentCopies
from safe_envs.wrappers.env_wrappers.safety_filter_vector import readable
from safe_envs.wrappers.env_wrappers.specification_monitor import with_regions
from safe_envs.wrappers.value.specification_tracker import SpecificationTracker


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
