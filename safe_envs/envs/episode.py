"""What the episodes of one env and of a batch have had so far."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from safe_envs.envs.info import Info, safety_info, with_masks
from safe_envs.errors import ConfigurationError
from safe_envs.problem.actuators import Limits, resting_input
from safe_envs.problem.problem import SafetyProblem

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


class DelayLine:
    """The inputs that are under way: what goes in comes out `delay` control periods later.

    Inputs are components: floats of one env, or arrays (num_envs,) of a batch. Before the first
    arrives, the resting input comes out.

    Attributes:
        under_way: the inputs that were sent and not executed yet, the oldest first.

    Args:
        delay: whole control periods, 0 for none.
        rest: the resting input, m floats.
        num_envs: size of a batch; None for one env.
    """

    def __init__(self, delay: int, rest: Sequence[float], num_envs: int | None = None) -> None:
        self._rest = tuple(rest)
        self._num_envs = num_envs
        self.under_way: deque[tuple[Any, ...]] = deque([self.rest] * delay)

    @property
    def rest(self) -> tuple[Any, ...]:
        """The components of the resting input, of every env."""
        if self._num_envs is None:
            return self._rest
        return tuple([np.full(self._num_envs, u) for u in self._rest])

    def exchange(self, u: Sequence[Any]) -> tuple[Any, ...]:
        """Send an input, and return the one that arrives in the same control period."""
        # What others do to their arrays must not reach what is under way.
        own = tuple(u) if self._num_envs is None else tuple([np.array(c, dtype=float) for c in u])
        self.under_way.append(own)
        return self.under_way.popleft()

    def restart(self, envs: np.ndarray | None = None) -> None:
        """Put resting inputs in the place of those under way.

        Args:
            envs: whose, indices or a mask; None for all.
        """
        rest = self.rest
        self.under_way = deque(
            [rest if envs is None else _replaced(u, rest, envs) for u in self.under_way]
        )

    def snapshot(self) -> np.ndarray:
        """Return the inputs under way, shape (num_envs, delay, m); of one env (delay, m)."""
        shape = () if self._num_envs is None else (self._num_envs,)
        found = np.array([np.stack(u, axis=-1) for u in self.under_way], dtype=float)
        return np.moveaxis(found.reshape(len(self.under_way), *shape, len(self._rest)), 0, -2)

    def restore(self, snapshot: np.ndarray) -> None:
        """Take the inputs under way from a snapshot."""
        values = np.moveaxis(np.array(snapshot, dtype=float), (-2, -1), (0, 1))
        self.under_way = deque(
            [tuple(u.tolist() if self._num_envs is None else list(u)) for u in values]
        )


class Actuators:
    """What executes the inputs that are sent: after a delay, and with limited rates.

    In each control period the input that arrives is the command u_c; executed is u_c, or with rates
    within [r-, r+] what is nearest to it in [u + dt r-, u + dt r+], where u was executed before.

    Attributes:
        sent: components of the input that was sent last.
        executed: components of the one that was executed last.

    Args:
        problem: with the delay and the rates.
        num_envs: size of a batch; None for one env.
    """

    def __init__(self, problem: SafetyProblem, num_envs: int | None = None) -> None:
        rest = resting_input(problem.input_bounds)
        self._line = DelayLine(problem.delay, rest, num_envs)
        self._steps: Limits = tuple(
            (problem.dt * low, problem.dt * high) for low, high in problem.slew_limit
        )
        self._batch = num_envs is not None
        self.sent = self.executed = self._line.rest

    def execute(self, u: Sequence[Any]) -> Sequence[Any]:
        """Send an input, and return the one that is executed in the same control period."""
        self.sent = tuple(u)
        command = self._line.exchange(u)
        if self._steps:
            clipped = np.clip if self._batch else _clipped
            command = tuple(
                [
                    clipped(c, last + down, last + up)
                    for c, last, (down, up) in zip(command, self.executed, self._steps, strict=True)
                ]
            )
        self.executed = command
        return command

    def restart(self, envs: np.ndarray | None = None) -> None:
        """Begin episodes, at rest.

        Args:
            envs: in which, indices or a mask; None for all.
        """
        self._line.restart(envs)
        rest = self._line.rest
        self.sent, self.executed = (
            rest if envs is None else _replaced(u, rest, envs) for u in (self.sent, self.executed)
        )

    def report(self) -> Info:
        """Return what they add to the info; see `safe_envs.envs.info`."""
        return {
            "sent_action": np.stack(self.sent, axis=-1),
            "executed_action": np.stack(self.executed, axis=-1),
        }

    def snapshot(self) -> dict[str, np.ndarray]:
        """Return the inputs under way, sent last and executed last, in arrays."""
        return {"inputs_under_way": self._line.snapshot(), **self.report()}

    def restore(self, snapshot: Mapping[str, np.ndarray]) -> None:
        """Take them from a snapshot."""
        self._line.restore(snapshot["inputs_under_way"])
        self.sent, self.executed = (
            tuple(values.T.copy() if self._batch else values.tolist())
            for key in ("sent_action", "executed_action")
            for values in (np.array(snapshot[key], dtype=float),)
        )


def _clipped(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)


def _replaced(u: Sequence[Any], other: Sequence[Any], envs: np.ndarray) -> tuple[Any, ...]:
    """Return components with those of other inputs in some envs."""
    found = tuple([np.array(c, dtype=float) for c in u])
    for c, o in zip(found, other, strict=True):
        c[envs] = o[envs]
    return found
