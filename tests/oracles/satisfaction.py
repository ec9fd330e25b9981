"""How often episodes meet a temporal specification, such as reaching a goal before leaving C."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from safe_envs.agents.evaluation.episodes import acted
from safe_envs.agents.evaluation.resolve import Env
from safe_envs.agents.evaluation.statistics import rate_interval
from safe_envs.agents.jobs import job
from safe_envs.agents.policies.base import Policy
from safe_envs.dynamics.noise import episode_seeds
from safe_envs.errors import ConfigurationError, require_whole
from safe_envs.wrappers.safety_filter import readable
from safe_envs.wrappers.specification import SpecificationMonitorVector


@dataclass(frozen=True)
class Satisfaction:
    """What episodes make of a specification.

    Attributes:
        specification: as text.
        satisfied: which episodes meet it, bool (E,).
        robustness: of each episode at its end, (E,).
    """

    specification: str
    satisfied: np.ndarray
    robustness: np.ndarray

    @property
    def rate(self) -> float:
        """Share of the episodes that meet it."""
        return float(self.satisfied.mean())

    def interval(self, confidence: float = 0.95) -> tuple[float, float]:
        """Return the interval of the probability; see `rate_interval`."""
        return rate_interval(int(self.satisfied.sum()), self.satisfied.size, confidence)


def measure_satisfaction(
    env: Env, policy: Any, specification: str, episodes: int, seed: int = 0
) -> Satisfaction:
    """Simulate episodes and judge them.

    They have the starts and the noise of the episodes that `evaluate` simulates with this seed.

    Args:
        env: with next-step autoreset, possibly filtered.
        policy: anything with Stable-Baselines3's `predict`.
        specification: see `SpecificationMonitor`.
        episodes: how many.
        seed: of the evaluation.

    Raises:
        ConfigurationError: The text is no specification over the env's sets, episodes < 1, or the
            env resets in another way.
        InvalidInputError: The policy failed.
    """
    require_whole("episodes", episodes, 1)
    if env.metadata["autoreset_mode"] != AutoresetMode.NEXT_STEP:
        raise ConfigurationError(
            f"autoreset_mode = {env.metadata['autoreset_mode']}; episodes are measured on envs with"
            " AutoresetMode.NEXT_STEP"
        )
    monitor = SpecificationMonitorVector(env, specification)
    steps, size = readable(env).problem.steps, env.num_envs
    satisfied, robustness = np.zeros(episodes, dtype=bool), np.zeros(episodes)
    for first in range(0, episodes, size):
        rows = range(first, first + size)
        alive = np.arange(first, first + size) < episodes
        with job.limited():
            if isinstance(policy, Policy):
                policy.begin(rows, seed)
            observation, _ = monitor.reset(seed=episode_seeds(seed, rows))
            state, start = None, np.ones(size, dtype=bool)
            for _ in range(steps):
                actions, state = acted(policy, observation, state, start)
                observation, _, terminated, truncated, info = monitor.step(actions)
                start = terminated | truncated
                over = np.flatnonzero(alive & start)
                satisfied[first + over] = info["satisfied"][over]
                robustness[first + over] = info["robustness"][over]
                alive &= ~start
                if not alive.any():
                    break
    return Satisfaction(specification, satisfied, robustness)
