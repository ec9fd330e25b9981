"""A limit on the expected cost of an episode, with the multiplier that enforces it in training."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from safe_envs.agents.training.lazy_info import of_each
from safe_envs.agents.training.multiplier import PIDMultiplier, require_at_least_zero
from safe_envs.envs.info import step_cost
from safe_envs.errors import ConfigurationError, shown

_COUNTS = ("running", "ended", "cost", "squares", "violated")
_LEAST_EPISODES = 100
"""Episodes, at least, that a judgement is made on, once there are as many."""


class EpisodeConstraint:
    """The constraint E[sum of the costs of an episode] <= limit, undiscounted.

    Where an episode ends at its first violation, with cost 1, the expected cost is the probability
    of any violation. Elsewhere it is the expected number of unsafe steps, and `violation_rate` is
    only reported.

    The cost is measured as the mean over the episodes that ended since the last measurement, once
    every env has ended one: the first episodes to end are those that a violation has cut short, so
    that a mean over these alone would be too high. Until then the last measurement stays, and the
    multiplier with it.

    The multiplier sees the excess in units of max(limit, unit), and at most 1 of them, so that the
    same gains serve any limit, and the many unsafe steps of an untrained policy do not wind it up.

    Attributes:
        limit: see above.
        multiplier: that each measurement moves.
        episode_cost: mean cost of an episode at the last measurement; None before the first.
        violation_rate: share of its episodes with any cost; None before the first.
        recent: episodes, sum of their costs, sum of the squares and number with any cost, of the
            last measurements, as many as have 100 episodes together.

    Args:
        limit: see above.
        num_envs: copies of the env.
        unit: of the excess, positive.
        gains: of the multiplier, see `PIDMultiplier`: kp, ki, kd, smoothing and most.

    Raises:
        ConfigurationError: a number is out of range.
    """

    def __init__(
        self, limit: float, num_envs: int, *, unit: float = 1.0, gains: Mapping[str, float]
    ) -> None:
        require_at_least_zero("the limit of the cost", limit)
        require_at_least_zero("the unit of the cost", unit)
        for name, number in gains.items():
            require_at_least_zero(f"multiplier_{name}", number)
        self._unit = max(float(limit), float(unit))
        if self._unit == 0.0:
            raise ConfigurationError("the unit of the cost is 0; give a positive number")
        self.limit = float(limit)
        self.multiplier = PIDMultiplier(self.limit / self._unit, **gains)
        self.episode_cost: float | None = None
        self.violation_rate: float | None = None
        self.recent: list[list[float]] = []
        self._steps = StepCosts(num_envs)
        # Of the episodes that go on, and of those that ended since the last measurement.
        self._running, self._ended, self._cost, self._squares, self._violated = (
            np.zeros(num_envs) for _ in _COUNTS
        )

    @property
    def value(self) -> float:
        """The multiplier, from 0."""
        return self.multiplier.value

    def measure(self, infos: Sequence[Any], dones: np.ndarray) -> np.ndarray:
        """Count a step of every env by its infos, and return its costs; see `StepCosts`.

        Args:
            infos: of the step just taken.
            dones: whether the episode ended with it, shape (num_envs,).
        """
        costs = self._steps.of(infos, dones)
        self.observe(costs, dones)
        return costs

    def observe(self, costs: np.ndarray, dones: np.ndarray) -> None:
        """Count a step of every env.

        Args:
            costs: of the step, shape (num_envs,).
            dones: whether the episode ended with it, shape (num_envs,).
        """
        self._running += costs
        if dones.any():
            ended = np.where(dones, self._running, 0.0)
            self._cost += ended
            self._squares += ended**2
            self._violated += ended > 0.0
            self._ended += dones
            self._running[dones] = 0.0

    def update(self) -> bool:
        """Move the multiplier if the episodes since the last measurement are enough for one.

        Returns:
            Whether they are.
        """
        if not self._ended.all():
            return False
        pools = (self._ended, self._cost, self._squares, self._violated)
        sums = [float(counts.sum()) for counts in pools]
        for counts in pools:
            counts[:] = 0.0
        self.episode_cost, self.violation_rate = sums[1] / sums[0], sums[3] / sums[0]
        self.recent.append(sums)
        while sum(each[0] for each in self.recent[1:]) >= _LEAST_EPISODES:
            del self.recent[0]
        excess = (self.episode_cost - self.limit) / self._unit
        self.multiplier.update(self.multiplier.limit + min(excess, 1.0))
        return True

    def begin_episodes(self) -> None:
        """Forget the episodes that go on: the envs were reset."""
        self._running[:] = 0.0
        self._steps.begin()

    def figures(self) -> dict[str, float]:
        """Return what is logged, by name; the measured costs once there are some."""
        found = {"multiplier": self.value, "limit": self.limit}
        found |= {"multiplier_saturated": float(self.multiplier.saturated)}
        if self.episode_cost is not None and self.violation_rate is not None:
            found |= {"episode_cost": self.episode_cost, "violation_rate": self.violation_rate}
        return found

    def state(self) -> dict[str, Any]:
        """Return all that changes, JSON-able."""
        return {
            "multiplier": self.multiplier.state(),
            "measured": [self.episode_cost, self.violation_rate],
            "recent": self.recent,
            **{name: getattr(self, f"_{name}").tolist() for name in _COUNTS},
        }

    def restore(self, state: Any) -> None:
        """Go on from the `state` of a constraint with the same arguments.

        Raises:
            ValueError: it is not such a state.
        """
        if not isinstance(state, Mapping) or set(state) != {
            "multiplier",
            "measured",
            "recent",
            *_COUNTS,
        }:
            raise ValueError(f"the state of the constraint is {shown(state)}")
        measured = state["measured"]
        if measured != [None, None]:
            _require_numbers("measured", measured, 2)
        for name in _COUNTS:
            _require_numbers(name, state[name], len(self._running))
        for each in state["recent"]:
            _require_numbers("last measurements", each, 4)
        self.multiplier.restore(state["multiplier"])
        self.episode_cost, self.violation_rate = measured
        self.recent = [list(each) for each in state["recent"]]
        self._steps.begin(math.nan)
        for name in _COUNTS:
            getattr(self, f"_{name}")[:] = state[name]


class StepCosts:
    """The costs of steps, which may be of several control periods: see `step_cost`.

    Args:
        num_envs: copies of the env.
    """

    def __init__(self, num_envs: int) -> None:
        self._before = np.zeros(num_envs)

    def begin(self, before: float = 0.0) -> None:
        """Begin episodes in all envs, or go on in their midst.

        Args:
            before: costs of the episodes so far; NaN if they are not known.
        """
        self._before[:] = before

    def of(self, infos: Sequence[Any], dones: np.ndarray) -> np.ndarray:
        """Return the cost of each env's last step, float64 of shape (num_envs,).

        Args:
            infos: see `costs_of`.
            dones: whether the episode ended with it, shape (num_envs,).

        Raises:
            ConfigurationError: see `costs_of`.
        """
        costs = costs_of(infos)
        violation, total = (of_each(infos, key) for key in ("violation", "episode_cost"))
        if any(each is None for each in (*violation, *total)):
            return costs
        total = np.array(total, dtype=np.float64)
        costs = step_cost(costs, np.array(violation), total, self._before)
        self._before = np.where(dones, 0.0, total)
        return costs


def costs_of(infos: Sequence[Any]) -> np.ndarray:
    """Return the cost of each env's last step, float64 of shape (num_envs,).

    Args:
        infos: with the entry "cost"; infos of a `SafeVecEnv` are read at once.

    Raises:
        ConfigurationError: an info has no cost, or one that is negative or no finite number.
    """
    given = of_each(infos, "cost")
    if isinstance(given, list) and any(cost is None for cost in given):
        raise ConfigurationError(
            "the infos have no entry 'cost', on which a constrained algorithm learns; give an env"
            " that reports one, or wrap it so that it does"
        )
    try:
        costs = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        costs = np.empty(0)
    if costs.shape != (len(infos),) or not ((costs >= 0.0) & np.isfinite(costs)).all():
        raise ConfigurationError(
            f"info['cost'] = {shown(given if isinstance(given, list) else given.tolist())}; the"
            " cost of a step is one finite number from 0"
        )
    return costs


def require_one_part(space: spaces.Space[Any]) -> None:
    """Raise ConfigurationError for observations of several parts.

    Args:
        space: of the observations.
    """
    if isinstance(space, spaces.Dict):
        raise ConfigurationError(
            "the observations have several parts; flatten them, as with"
            " gymnasium.wrappers.FlattenObservation"
        )


def _require_numbers(name: str, given: Any, count: int) -> None:
    """Raise ValueError unless a list has so many finite numbers from 0."""
    if (
        not isinstance(given, list)
        or len(given) != count
        or not all(
            type(number) is float and math.isfinite(number) and number >= 0 for number in given
        )
    ):
        raise ValueError(f"the constraint's {name} is {shown(given)}")
