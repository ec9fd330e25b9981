"""What the episodes of one env and of a batch have had so far."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from safe_envs.envs.info import Info, safety_info, with_masks
from safe_envs.errors import ConfigurationError

_COUNTERS = ("steps", "h_min", "episode_cost", "ended")


class Episode:
    """Counters of the episode of one env.

    Attributes:
        steps: control periods.
        h_min: smallest barrier value.
        cost: sum of the costs.
        placements: how often a state was set that no step led to, in all episodes.
    """

    __slots__ = ("cost", "h_min", "placements", "steps")

    def __init__(self) -> None:
        self.placements = 0
        self.restart()

    def restart(self, steps: int = 0) -> None:
        """Begin an episode, after some control periods of it."""
        self.steps, self.h_min, self.cost = steps, math.inf, 0.0

    def count(self, barriers: Sequence[float], h: float) -> Info:
        """Count a state.

        Args:
            barriers: value of each barrier.
            h: the smallest of them.

        Returns:
            What an env reports of it.
        """
        violation = h < 0.0
        cost = 1.0 if violation else 0.0
        self.cost += cost
        if h < self.h_min:
            self.h_min = h
        return safety_info(violation, cost, np.array(barriers), self.h_min, self.cost)


class Episodes:
    """Counters of the episodes of a batch, and which of them end and begin.

    Attributes:
        steps: control periods, int64 (num_envs,).
        h_min: smallest barrier values, (num_envs,).
        episode_cost: sums of the costs, (num_envs,).
        ended: the envs that are still to be reset, bool (num_envs,).
        begun: the envs whose episode began in the last step, bool (num_envs,).
        everywhere: True for each env; not to be written to.
        started: whether all envs have a state.
        placements: how often a state of each env was set that no step led to, in all episodes;
            another array after each time.
        last_states: with same-step autoreset, the states in which the episodes that ended last did
            so, (num_envs, n); of the other envs anything.
        last_steps: likewise, how many control periods they had, int64 (num_envs,).
        last_sample: likewise, what had arrived from their sensors, a `Sample`; None without any.
    """

    def __init__(self, num_envs: int) -> None:
        self.steps = np.zeros(num_envs, dtype=np.int64)
        self.h_min = np.full(num_envs, np.inf)
        self.episode_cost = np.zeros(num_envs)
        self.ended = np.zeros(num_envs, dtype=bool)
        self.begun = self._nowhere = np.zeros(num_envs, dtype=bool)
        self.everywhere = np.ones(num_envs, dtype=bool)
        self.started = False
        self.placements = np.zeros(num_envs, dtype=np.int64)
        self.last_states = np.empty((num_envs, 0))
        self.last_steps = self.steps
        self.last_sample: Any = None

    def due(self) -> np.ndarray | None:
        """Return the envs that the coming step restarts (next-step autoreset); None without any."""
        due = self.ended.copy() if np.count_nonzero(self.ended) else None
        self.begun = self._nowhere if due is None else due
        return due

    def reset_mask(self, given: Any) -> np.ndarray:
        """Return the envs that a reset is to restart.

        Args:
            given: a bool array of shape (num_envs,) with a True in it; None for all.

        Raises:
            ConfigurationError: The mask is another one.
            ResetNeeded: At the first reset, some envs are left out.
        """
        if given is None:
            return self.everywhere.copy()
        mask = np.asarray(given)
        if mask.shape != self.steps.shape or mask.dtype != np.bool_ or not mask.any():
            raise ConfigurationError(
                f"reset_mask must be a bool array of shape {self.steps.shape} with a True in it;"
                f" given {given!r}"
            )
        if not self.started and not mask.all():
            raise gym.error.ResetNeeded(
                "some envs have no state yet: the first reset takes no reset_mask"
            )
        # It is in the info, and the caller may use theirs again.
        return mask.copy()

    def restart(self, envs: np.ndarray, steps: np.ndarray | int = 0) -> None:
        """Begin the episodes of some envs.

        Args:
            envs: their indices, or a mask.
            steps: control periods that have passed, of all of them or of each.
        """
        self.started = True
        self.steps[envs] = steps
        self.h_min[envs] = np.inf
        self.episode_cost[envs] = 0.0
        self.ended[envs] = False

    def take(
        self,
        steps: np.ndarray,
        h_min: np.ndarray,
        episode_cost: np.ndarray,
        restarted: np.ndarray | None,
    ) -> None:
        """Take the counters of a step that were counted elsewhere.

        Args:
            steps: see the class.
            h_min: see the class.
            episode_cost: see the class.
            restarted: the envs whose episodes began, bool (num_envs,); None for none.
        """
        self.started = True
        self.steps, self.h_min, self.episode_cost = steps, h_min, episode_cost
        if restarted is not None:
            self.ended[restarted] = False

    def count(self, barriers: np.ndarray, h: np.ndarray, counted: np.ndarray | None = None) -> Info:
        """Count the states of a step.

        Args:
            barriers: values of the barriers, shape (num_envs, k).
            h: the smallest of each env, shape (num_envs,).
            counted: the envs whose states are new; None for all.

        Returns:
            What the envs report of them.
        """
        violation = h < 0.0
        cost = violation.astype(np.float64)
        self.episode_cost += cost if counted is None else cost * counted
        # What was counted before cannot lower the smallest value again.
        np.minimum(self.h_min, h, out=self.h_min)
        return safety_info(violation, cost, barriers, self.h_min.copy(), self.episode_cost.copy())

    def keep_last(self, states: np.ndarray, sample: Any) -> None:
        """Keep where all envs are, before those whose episodes have ended begin new ones.

        Args:
            states: shape (num_envs, n).
            sample: a `Sample`, or None.
        """
        self.last_states, self.last_sample = states, sample
        self.last_steps = self.steps.copy()

    def place(self, envs: np.ndarray) -> None:
        """Count that states were set in some envs, given by a mask."""
        self.placements = self.placements + envs

    def snapshot(self) -> dict[str, np.ndarray]:
        """Return copies of the counters, from which `restore` goes on."""
        return {name: getattr(self, name).copy() for name in _COUNTERS}

    def restore(self, snapshot: Mapping[str, np.ndarray]) -> None:
        """Take the counters from a snapshot."""
        self.started = True
        self.place(self.everywhere)
        for name in _COUNTERS:
            setattr(self, name, np.array(snapshot[name]))


def last_of_episode(ended: np.ndarray, observation: np.ndarray, info: Info) -> Info:
    """Return what Gymnasium's same-step autoreset reports of ended episodes.

    Args:
        ended: their envs, bool (num_envs,).
        observation: last observations, (num_envs, k).
        info: last info, changed in place.
    """
    final = np.full(len(ended), None, dtype=object)
    for i in np.flatnonzero(ended).tolist():
        final[i] = observation[i]
    return with_masks({"final_obs": final, "final_info": with_masks(info, ended)}, ended)
