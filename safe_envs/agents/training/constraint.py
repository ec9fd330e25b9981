"""A limit on the expected cost of an episode, with the multiplier that enforces it in training."""

from __future__ import annotations

import math
import numbers
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from safe_envs.agents.evaluation.statistics import rate_interval
from safe_envs.agents.training.vec_env import of_each
from safe_envs.envs.info import step_cost
from safe_envs.errors import ConfigurationError, NumericalError, shown

_STATE = ("integral", "smoothed", "value")


class PIDMultiplier:
    """A multiplier that a proportional-integral-derivative controller moves by the excess cost.

    With the excess e = J - d of the measured cost J over the limit d, each update does

        I <- min(max(I + e, 0), most / k_i),    D = max(S - S', 0),
        value = min(max(k_p (S - d) + k_i I + k_d D, 0), most),

    where S is the smoothed cost, s S' + (1 - s) J after S' of the update before, and J at the
    first, whose D is 0. Gradient ascent on the multiplier is the case k_p = k_d = 0. All costs are
    in the unit of the limit, and all gains per unit of cost and per update.

    Source: Stooke, Achiam, Abbeel, "Responsive Safety in Reinforcement Learning by PID Lagrangian
        Methods", 2020, arXiv:2007.03964, algorithm 2. The upper bound, which also stops the
        integral, and the optional smoothing of the first and third term are additions.

    Attributes:
        limit: d.
        most: greatest value.
        value: of the multiplier, from 0 to `most`.

    Args:
        limit: d >= 0.
        kp: proportional gain k_p >= 0.
        ki: integral gain k_i >= 0.
        kd: derivative gain k_d >= 0.
        smoothing: s in [0, 1).
        most: greatest value of the multiplier, positive.

    Raises:
        ConfigurationError: an argument is out of range.
    """

    def __init__(
        self,
        limit: float,
        kp: float,
        ki: float,
        kd: float,
        *,
        smoothing: float = 0.0,
        most: float = 1000.0,
    ) -> None:
        given = {"limit": limit, "kp": kp, "ki": ki, "kd": kd, "smoothing": smoothing, "most": most}
        for name, number in given.items():
            require_at_least_zero(name, number)
        if smoothing >= 1.0:
            raise ConfigurationError(f"smoothing = {smoothing!r}; give a number from 0 to below 1")
        if most == 0.0:
            raise ConfigurationError("most = 0; give a positive number, or gains of 0")
        self.limit, self.most, self.value = float(limit), float(most), 0.0
        self._kp, self._ki, self._kd = float(kp), float(ki), float(kd)
        self._smoothing = float(smoothing)
        self._integral = 0.0
        self._smoothed: float | None = None

    @property
    def saturated(self) -> bool:
        """Whether the multiplier is at its greatest value."""
        return self.value >= self.most

    def update(self, cost: float) -> float:
        """Move the multiplier by one measured cost, and return it.

        Args:
            cost: J, finite.

        Raises:
            NumericalError: the cost is not finite.
        """
        cost = float(cost)
        if not math.isfinite(cost):
            raise NumericalError(f"the measured cost is {cost}")
        old = cost if self._smoothed is None else self._smoothed
        self._smoothed = self._smoothing * old + (1.0 - self._smoothing) * cost
        self._integral = max(self._integral + cost - self.limit, 0.0)
        if self._ki:
            self._integral = min(self._integral, self.most / self._ki)
        rise = max(self._smoothed - old, 0.0)
        wanted = (
            self._kp * (self._smoothed - self.limit) + self._ki * self._integral + self._kd * rise
        )
        self.value = min(max(wanted, 0.0), self.most)
        return self.value

    def state(self) -> dict[str, float | None]:
        """Return what the next update depends on and the value, JSON-able."""
        return {name: getattr(self, name if name == "value" else f"_{name}") for name in _STATE}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from the `state` of another multiplier with the same arguments.

        Raises:
            ValueError: it is not such a state.
        """
        if not isinstance(state, Mapping) or set(state) != set(_STATE):
            raise ValueError(f"the state of the multiplier is {shown(state)}")
        for name, number in state.items():
            missing = number is None and name == "smoothed"
            if not missing and not (type(number) is float and math.isfinite(number)):
                raise ValueError(f"the multiplier's {name} is {shown(number)}")
        if not (state["integral"] >= 0.0 and 0.0 <= state["value"] <= self.most):
            raise ValueError(f"the state of the multiplier is {shown(state)}")
        self._integral, self._smoothed, self.value = (state[name] for name in _STATE)


def require_at_least_zero(name: str, number: Any) -> None:
    """Raise ConfigurationError unless a number is finite and not negative.

    Args:
        name: in the message.
        number: to check.
    """
    real = isinstance(number, numbers.Real) and not isinstance(number, bool)
    if not real or not 0.0 <= float(number) < math.inf:
        raise ConfigurationError(f"{name} = {shown(number)}; give a finite number from 0")


def require_share(name: str, number: Any) -> None:
    """Raise ConfigurationError unless a number is from 0 to 1.

    Args:
        name: in the message.
        number: to check.
    """
    real = isinstance(number, numbers.Real) and not isinstance(number, bool)
    if not real or not 0.0 <= float(number) <= 1.0:
        raise ConfigurationError(f"{name} = {shown(number)}; give a number from 0 to 1")


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
        infos: with the entry "cost"; infos of a `SB3VecEnv` are read at once.

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


COST, VIOLATION = "cost_limit", "violation_limit"
"""Names of the limits: of the expected number of unsafe steps of an episode, and of the probability
of any."""

DEFAULT_VIOLATION_LIMIT = 0.01
"""What a constrained training gets that is given no limit."""

UNITS = {COST: 1.0, VIOLATION: 0.1}
"""Units of the excess that a multiplier sees, if the limit is smaller; see `EpisodeConstraint`."""

_DEVIATIONS = 1.96
"""Standard deviations on each side of a mean in a 95 % interval."""


def judged(
    constraint: EpisodeConstraint, kind: str, evaluation: Mapping[str, Any]
) -> dict[str, Any]:
    """Return what is known about a limit, JSON-able.

    The constraint is on the policy as it explores, so that its last episodes in training are
    judged; those of the evaluation, without exploration, too where the limit is on violations.

    Args:
        constraint: of the algorithm.
        kind: `COST` or `VIOLATION`.
        evaluation: row of the evaluation of the policy.

    Returns:
        `kind`, `limit`, the `multiplier` and whether it is `saturated`; number of `episodes` in
        training, their `mean` cost, and its 95 % interval from `low` to `high`, all None before
        every env ended an episode; `met`: False if this interval, or that of the evaluation, lies
        above the limit, otherwise True, or None as long as nothing was measured in training; and
        `evaluation_met`: the same for the evaluation alone, None for a limit of the cost, which it
        does not measure.
    """
    found = {
        "kind": kind,
        "limit": constraint.limit,
        "multiplier": constraint.value,
        "saturated": constraint.multiplier.saturated,
    }
    if kind == VIOLATION:
        found["evaluation_met"] = 1.0 - evaluation["ci_high"] <= constraint.limit
    else:
        found["evaluation_met"] = None
    if not constraint.recent:
        unknown = dict.fromkeys(("mean", "low", "high"))
        met = False if found["evaluation_met"] is False else None
        return found | {"episodes": 0, "met": met, **unknown}
    episodes, cost, squares, violated = (
        sum(numbers) for numbers in zip(*constraint.recent, strict=True)
    )
    mean = cost / episodes
    if kind == VIOLATION:
        low, high = rate_interval(int(violated), int(episodes))
    else:
        error = math.sqrt(max(squares / episodes - mean**2, 0.0) / max(episodes - 1.0, 1.0))
        low, high = max(mean - _DEVIATIONS * error, 0.0), mean + _DEVIATIONS * error
    return found | {
        "episodes": int(episodes),
        "mean": mean,
        "low": low,
        "high": high,
        "met": low <= constraint.limit and found["evaluation_met"] is not False,
    }


def require_judgement(given: Any) -> None:
    """Raise ValueError unless it is what `judged` returns, as far as it is read again.

    Args:
        given: content of a file.
    """
    numbers = [given[name] for name in ("limit", "multiplier", "episodes")]
    numbers += [given[name] for name in ("mean", "low", "high") if given["episodes"]]
    kept = [given[name] for name in ("met", "evaluation_met")]
    if not (
        given["kind"] in UNITS
        and type(given["saturated"]) is bool
        and all(met is None or type(met) is bool for met in kept)
        and all(type(n) in (int, float) and math.isfinite(n) for n in numbers)
    ):
        raise ValueError(f"the limit is judged as {shown(given)}")


def rank(evaluation: Mapping[str, Any]) -> tuple[bool, float]:
    """Return what the best policy has most of: first that it keeps its limit, then return.

    The policies that are kept do not explore, so that their evaluation decides, if it can.

    Args:
        evaluation: row with `return_mean`, and with what is `judged` about a limit, if there is
            one.
    """
    judgement = evaluation.get("constraint") or {}
    met = judgement.get("evaluation_met")
    met = judgement.get("met") if met is None else met
    return met is not False, evaluation["return_mean"]
