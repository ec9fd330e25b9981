"""What sensors report of the state: expressions of it, with noise, bias, dropout and delay."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import sympy as sp

from safe_envs.errors import ConfigurationError, SystemDefinitionError, require_whole, shown
from safe_envs.problem.actuators import LONGEST_DELAY

_DEFAULT_NOISE = 0.01
"""Standard deviation of the fallback's channels, as a part of the range of their features."""


@dataclass(frozen=True)
class Channel:
    """One number that a sensor reports: y = c(x) + bias + noise v, with v standard normal.

    Attributes:
        name: of the channel, as in the observation.
        expression: c, an expression of the states and the plant's parameters.
        noise: standard deviation of the error, in the unit of the expression.
        bias: constant error in that unit, of which no estimator knows.
        dropout: probability that a sample is lost, independently of all others.
        period: the values are known modulo this number, and lie in (-period/2, period/2], such as
            2 pi for a bearing; 0 for values that are not periodic.

    Raises:
        ConfigurationError: A number is not finite or out of range.
    """

    name: str
    expression: sp.Expr
    noise: float
    bias: float = 0.0
    dropout: float = 0.0
    period: float = 0.0

    def __post_init__(self) -> None:
        allowed = {
            "noise": (0.0, math.inf, "a number >= 0"),
            "bias": (-math.inf, math.inf, "a finite number"),
            "dropout": (0.0, 1.0, "a probability below 1"),
            "period": (0.0, math.inf, "a number >= 0, 0 for none"),
        }
        for setting, (low, high, words) in allowed.items():
            value = getattr(self, setting)
            is_number = isinstance(value, int | float) and not isinstance(value, bool)
            if not (is_number and math.isfinite(value) and low <= value < high):
                raise ConfigurationError(
                    f"{setting} = {shown(value)} of the measurement {self.name}; give {words}"
                )
            object.__setattr__(self, setting, float(value))


@dataclass(frozen=True)
class Measurement:
    """What is measured of the state in each control period.

    Attributes:
        channels: at least one, each under a name of its own.
        delay: whole control periods after which a sample arrives.

    Raises:
        ConfigurationError: There is no channel, a name is taken twice, or the delay is out of
            range.
    """

    channels: tuple[Channel, ...]
    delay: int = 0

    def __post_init__(self) -> None:
        names = [channel.name for channel in self.channels]
        if not names or len(set(names)) < len(names):
            raise ConfigurationError(
                f"a measurement has the channels {', '.join(names) or 'none'}; give at least one,"
                " each with a name of its own"
            )
        require_whole("delay of the measurement", self.delay, 0)
        if self.delay > LONGEST_DELAY:
            raise ConfigurationError(
                f"delay of the measurement = {self.delay}; it counts control periods,"
                f" {LONGEST_DELAY} at most"
            )

    def require_known(self, plant: Any) -> None:
        """Raise SystemDefinitionError where a channel measures unknown symbols.

        Args:
            plant: the `ControlAffineSDE` whose states are measured.
        """
        for channel in self.channels:
            plant.require_known(
                f"the measurement {channel.name}",
                channel.expression.free_symbols,
                (*plant.states, *plant.parameters),
            )


def default_measurement(problem: Any) -> Measurement:
    """Return the realistic sensor of a problem.

    Those are its own `sensors`. Where it states none, each feature of the observation is measured
    with a standard deviation of 1 % of its range.

    Args:
        problem: a `SafetyProblem`.

    Raises:
        SystemDefinitionError: A feature depends on the time alone, which no sensor measures.
    """
    if problem.sensors:
        return Measurement(problem.sensors)
    states = set(problem.plant.states)
    features = [f for f in problem.features if f.expression.free_symbols & states]
    if not features:
        raise SystemDefinitionError(f"no feature of {problem.name} depends on a state")
    return Measurement(
        tuple(Channel(f.name, f.expression, _DEFAULT_NOISE * (f.high - f.low)) for f in features)
    )


def require_autonomous(which: str, system: Any) -> None:
    """Raise SystemDefinitionError for a system with signals or explicit time.

    Args:
        which: "plant" or "model", for the error.
        system: a `ControlAffineSDE`.
    """
    moves = f"the signals {', '.join(map(str, system.signals))}" if system.signals else "the time"
    if system.signals or system.uses_time:
        raise SystemDefinitionError(
            f"the {which} depends on {moves}, which nothing measures in an env; make each a state,"
            " with its rate in the drift (1 for the time), or filter in a loop of your own by"
            " SafetyFilter(system, ...)"
        )
