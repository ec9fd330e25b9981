"""The Lagrange multiplier of a constraint on a mean cost, moved by a PID controller."""

from __future__ import annotations

import math
import numbers
from collections.abc import Mapping
from typing import Any

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
