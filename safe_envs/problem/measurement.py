"""What sensors report of the state: expressions of it, with noise, bias, dropout and delay."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import sympy as sp

from safe_envs.dynamics.declarations import formula
from safe_envs.errors import (
    ConfigurationError,
    SystemDefinitionError,
    require_whole,
    shortened,
    shown,
)
from safe_envs.problem.angle_jumps import angle_jumps, are_multiples, words_of
from safe_envs.problem.option_errors import LONGEST_DELAY

_DEFAULT_NOISE = 0.01
"""Standard deviation of the fallback's channels: this part of a range, or this in its unit."""

_LARGEST = 1e30
"""Of noise, bias and period: observations are in single precision, and hold ten times as much."""

_SHORTEST = 1e-9
"""Of a period: the quotient of a number and it is a number."""


@dataclass(frozen=True)
class Channel:
    """One number that a sensor reports: y = c(x) + bias + noise v, with v standard normal.

    Attributes:
        name: of the channel, as in the observation.
        expression: c, an expression of the states and the plant's parameters.
        noise: standard deviation of the error, in the unit of the expression.
        bias: constant error in that unit, of which no estimator knows.
        dropout: probability that a sample is lost, independently of all others.
        period: the values are known modulo this number, and lie in (-period/2, period/2]; 0 for
            values that are not periodic. By default the size of the expression's own jumps, such as
            2 pi |a| of a atan2(y, x) + b; see `safe_envs.problem.angle_jumps`.

    Raises:
        SystemDefinitionError: The expression is none.
        ConfigurationError: A number is not finite or out of range, or the expression jumps by no
            multiple of the period.
    """

    name: str
    expression: sp.Expr
    noise: float
    bias: float = 0.0
    dropout: float = 0.0
    period: float = None  # pyright: ignore[reportAssignmentType]  (a number from here on)

    def __post_init__(self) -> None:
        object.__setattr__(self, "expression", formula(f"measurement {self.name}", self.expression))
        if self.period is None:
            object.__setattr__(self, "period", self._derived_period())
        allowed = {
            "noise": (0.0, _LARGEST, f"a number from 0, below {_LARGEST:g}"),
            "bias": (-_LARGEST, _LARGEST, f"a number between -{_LARGEST:g} and {_LARGEST:g}"),
            "dropout": (0.0, 1.0, "a probability from 0, below 1"),
            "period": (_SHORTEST, _LARGEST, f"0 for none, or a number from {_SHORTEST:g}"),
        }
        for setting, (low, high, words) in allowed.items():
            value = getattr(self, setting)
            is_number = isinstance(value, int | float) and not isinstance(value, bool)
            none = setting == "period" and is_number and value == 0
            if not (none or (is_number and low <= value < high)):
                raise ConfigurationError(
                    f"{setting} = {shown(value)} of the measurement {self.name}; give {words}"
                )
            object.__setattr__(self, setting, float(value))
        # What is no number here may be one with the parameters of a model.
        jumps = [j for j in angle_jumps(self.expression) or () if math.isfinite(j)]
        if self.period and not are_multiples(jumps, self.period):
            raise ConfigurationError(
                f"period = {self.period:g} of the measurement {self.name}, which jumps"
                f" {words_of(tuple(jumps))} after a turn; leave the period out, or give one of"
                " which that is a multiple"
            )

    def _derived_period(self) -> float:
        jumps = angle_jumps(self.expression)
        period = jumps[0] if jumps else 0.0
        if jumps is None or not are_multiples(jumps, period):
            raise ConfigurationError(
                f"the period of the measurement {self.name} does not follow from"
                f" {shortened(self.expression)}, which jumps {words_of(jumps)} after a turn of its"
                " angles; give period=..., the number modulo which it is known, or 0 for none"
            )
        return period


@dataclass(frozen=True)
class Measurement:
    """What is measured of the state in each control period.

    Attributes:
        channels: at least one, each under a name of its own.
        delay: whole control periods after which a sample arrives.

    Raises:
        ConfigurationError: There is no `Channel`, a name is taken twice, or the delay is out of
            range.
    """

    channels: tuple[Channel, ...]
    delay: int = 0

    def __post_init__(self) -> None:
        if not all(isinstance(channel, Channel) for channel in self.channels):
            raise ConfigurationError(
                f"channels = {shown(self.channels)}; give a Channel for each number that a sensor"
                " reports, like (Channel('y', x, noise=0.1),)"
            )
        names = [channel.name for channel in self.channels]
        if not names or len(set(names)) < len(names):
            raise ConfigurationError(
                f"a measurement has the channels {shortened(', '.join(names) or 'none')}; give at"
                " least one, each with a name of its own, like NAME=EXPR"
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
            used, what = channel.expression.free_symbols, f"the measurement {channel.name}"
            plant.require_known(what, used, (*plant.states, *plant.parameters))
            if not used.intersection(plant.states):
                names = ", ".join(map(str, plant.states))
                raise SystemDefinitionError(f"{what} depends on no state; the states are {names}")


def default_measurement(problem: Any) -> Measurement:
    """Return the realistic sensor of a problem.

    Those are its own `sensors`. Where it states none, each feature of the observation that is one
    of the states alone is measured, and each state of which no such feature tells, with a standard
    deviation of 1 % of its range, or of .01 where the range is not finite.

    Args:
        problem: a `SafetyProblem`.
    """
    if problem.sensors:
        return Measurement(problem.sensors)
    states = set(problem.plant.states)
    found = {
        f.name: (f.expression, f.low, f.high)
        for f in problem.features
        if f.expression.free_symbols and f.expression.free_symbols <= states
    }
    told = set().union(*(expression.free_symbols for expression, *_ in found.values()))
    found |= {
        v.symbol.name: (v.symbol, v.low, v.high) for v in problem.states if v.symbol not in told
    }
    return Measurement(
        tuple(
            Channel(name, expression, _DEFAULT_NOISE * (span if 0.0 < span < _LARGEST else 1.0))
            for name, (expression, low, high) in found.items()
            for span in (high - low,)
        )
    )


def require_full_state(problem: Any, what: str) -> None:
    """Raise ConfigurationError where the observation is a measurement.

    Args:
        problem: a `SafetyProblem`.
        what: acts on the observation of the full state, a plural.
    """
    if problem.measurement is not None:
        raise ConfigurationError(
            f"{what} act on the full state, and {problem.name} is measured; give an estimator"
            " (safe-envs evaluate --estimator ekf, or StateEstimatorWrapper with policies of"
            " problem.unmeasured), or leave the measurement out"
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
