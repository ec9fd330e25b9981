"""What sensors report of the state: expressions of it, with noise, bias, dropout and delay.

Each item names what is measured, with settings after colons:

    default[:noise=S][:bias=B][:dropout=P]      the problem's own sensor, with other settings
    [NAME=]EXPR[:noise=S][:bias=B][:dropout=P][:period=T]
    delay=D                                     control periods, of all that is measured

EXPR is arithmetic of states and parameters; the name of a feature stands for its expression. EXPR
may be the name of a channel of the default sensor too, which brings its settings along. The period
is by default that of the angles in EXPR; see `Channel.period`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import sympy as sp

from safe_envs.dynamics.symbols import formula
from safe_envs.errors import (
    ConfigurationError,
    SystemDefinitionError,
    nearest,
    require_whole,
    shortened,
    shown,
)
from safe_envs.problem.angle_jumps import angle_jumps, are_multiples, words_of
from safe_envs.problem.option_errors import LONGEST_DELAY
from safe_envs.text import finite_number

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


_SETTINGS = ("noise", "bias", "dropout", "period")
_WORDS = (*_SETTINGS, "default", "delay")
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,39}")
_SYMBOL = re.compile(r"(?<![\w.])[A-Za-z_]\w*(?!\w|\s*\()")
_CONSTANTS = ("pi", "E")
_MOST_ITEMS, _MOST_CHARACTERS, _LONGEST_NAME = 100, 1000, 40
_FORM = "write 'default', 'EXPR:noise=S:bias=B:dropout=P', or 'delay=D'"


def read_items(option: str, texts: Any) -> list[str]:
    """Check the form of the items of a measurement, of which nothing else need be known.

    Args:
        option: name of the option, for errors.
        texts: the items.

    Returns:
        The same items.

    Raises:
        ConfigurationError: One is not of the form.
    """
    items = [texts] if isinstance(texts, str) else list(texts)
    if not 0 < len(items) <= _MOST_ITEMS:
        raise ConfigurationError(f"{option} has {len(items)} items; give 1 to {_MOST_ITEMS}")
    heads = [_parts(option, item)[0] for item in items]
    names = [head.partition("=")[0] for head in heads]
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise ConfigurationError(
            f"{option} has {shown(twice[0])} more than once; give each a name of its own, like"
            " NAME=EXPR"
        )
    return items


def require_names(texts: Sequence[str], known: Sequence[str]) -> None:
    """Check the names in the items of a measurement, where a problem is not known otherwise.

    Args:
        texts: the items, of the form that `read_items` checks.
        known: names of states, features, parameters and channels.

    Raises:
        ConfigurationError: A name is unknown.
    """
    for item in texts:
        head, _ = _parts("measurement", item)
        if head == "default" or head.startswith("delay="):
            continue
        for name in _SYMBOL.findall(head.rpartition("=")[2]):
            if name not in (*known, *_CONSTANTS):
                raise ConfigurationError(
                    f"measurement {shown(head)}: unknown name {shown(name)}; {nearest(name, known)}"
                )


def measurement_of(problem: Any, given: Any, factor: float | None = None) -> Any:
    """Return the measurement of a problem that options describe.

    Args:
        problem: a `SafetyProblem`.
        given: see `ProblemOptions.measurement`; None for the one that the problem has.
        factor: of the standard deviations of the noise; None for 1.

    Returns:
        A `Measurement`.

    Raises:
        ConfigurationError: It is none, an item is not of the form, or a name is unknown.
        SystemDefinitionError: An expression is not of the problem's states.
    """
    if given is None:
        found = problem.measurement
    elif isinstance(given, Measurement):
        found = given
    else:
        found = _read(problem, items_of(given))
    if factor is None:
        return found
    if found is None:
        raise ConfigurationError(
            f"sensor_noise = {factor}: nothing is measured; give measurement='default' too"
        )
    scaled = [replace(c, noise=factor * c.noise) for c in found.channels]
    return replace(found, channels=tuple(scaled))


def items_of(given: Any) -> list[str]:
    """Return what options give as a list of items, of the form that `read_items` checks.

    Args:
        given: a text, a list of texts, or settings or standard deviations by name.

    Raises:
        ConfigurationError: It is something else, or an item is not of the form.
    """
    if isinstance(given, Mapping):
        items = []
        for name, value in given.items():
            settings = value if isinstance(value, Mapping) else {"noise": value}
            parts = [f"{k}={v}" for k, v in settings.items()]
            items.append(f"delay={value}" if name == "delay" else ":".join([str(name), *parts]))
        given = items
    if not (isinstance(given, str | Sequence) and all(isinstance(i, str) for i in given)):
        raise ConfigurationError(
            f"measurement = {shown(given)}; give 'default', a list of texts, standard deviations by"
            " name, or a Measurement"
        )
    return read_items("measurement", given)


def _parts(option: str, item: Any) -> tuple[str, dict[str, float]]:
    """Return the head of an item and its settings."""
    if not isinstance(item, str) or len(item) > _MOST_CHARACTERS:
        raise ConfigurationError(
            f"{option} {shown(item)}: {_FORM}, in at most {_MOST_CHARACTERS} characters"
        )
    head, *entries = [part.strip() for part in item.split(":")]
    head = re.sub(r"\s*=\s*", "=", head)
    found: dict[str, float] = {}
    for entry in entries:
        name, _, value = (part.strip() for part in entry.partition("="))
        if name not in _SETTINGS:
            raise ConfigurationError(
                f"{option} {shown(item)}: unknown setting {shown(name)}; {nearest(name, _SETTINGS)}"
            )
        if name in found:
            raise ConfigurationError(f"{option} {shown(item)}: {name} comes twice; give it once")
        found[name] = _setting(f"{name} of {option} {shown(head)}", name, value)
    if not head:
        raise ConfigurationError(f"{option} {shown(item)} names nothing that is measured; {_FORM}")
    if head == "default" and "period" in found:
        raise ConfigurationError(
            f"{option} {shown(item)}: the period is of one expression; leave it out"
        )
    if head.startswith("delay="):
        _delay(option, head, found)
    elif head != "default":
        _require_name(option, head)
    return head, found


def _setting(what: str, name: str, value: str) -> float:
    found = finite_number(what, value)
    if (name != "bias" and found < 0.0) or (name == "dropout" and found >= 1.0):
        allowed = "a probability from 0, below 1" if name == "dropout" else "a number from 0"
        raise ConfigurationError(f"{what} = {found:g}; give {allowed}")
    return found


def _require_name(option: str, head: str) -> None:
    name, equals, text = head.partition("=")
    if name in _WORDS or "=" in text or (equals and not (text and _NAME.fullmatch(name))):
        raise ConfigurationError(
            f"{option} {shown(head)}: give NAME=EXPR, with a name of up to {_LONGEST_NAME} letters,"
            f" digits and underscores that is none of {', '.join(_WORDS)}; settings follow the"
            " expression, EXPR:noise=S"
        )


def _delay(option: str, head: str, settings: Mapping[str, float]) -> int:
    value = finite_number(f"{option} delay", head.removeprefix("delay="))
    if settings or not (value.is_integer() and 0 <= value <= LONGEST_DELAY):
        raise ConfigurationError(
            f"{option} {shown(head)}: give a whole number of control periods from 0 to"
            f" {LONGEST_DELAY} alone, like delay=2"
        )
    return int(value)


def _read(problem: Any, items: Sequence[str]) -> Any:

    standard = default_measurement(problem)
    channels: list[Channel] = []
    delay = 0
    for item in items:
        head, settings = _parts("measurement", item)
        if head == "default":
            channels += [replace(c, **settings) for c in standard.channels]
        elif head.startswith("delay="):
            delay = _delay("measurement", head, settings)
        else:
            channels.append(_channel(problem, standard.channels, head, settings))
    return Measurement(tuple(channels or standard.channels), delay)


def _channel(problem: Any, known: Sequence[Any], head: str, settings: Mapping[str, float]) -> Any:
    from safe_envs.dynamics.expression_text import SENSOR_FUNCTIONS, read_expression

    name, equals, text = head.partition("=")
    text = text if equals else name
    by_name = {channel.name: channel for channel in known}
    if text in by_name:
        return replace(by_name[text], name=name.strip(), **settings)
    plant = problem.plant
    # Of two meanings of a name, the first one counts.
    meanings = (
        *((s.name, s) for s in plant.states),
        *((f.name, f.expression) for f in problem.features),
        *((s.name, s) for s in plant.parameters),
    )
    names: dict[str, Any] = {}
    for known_name, meaning in meanings:
        names.setdefault(known_name, meaning)
    where = f"measurement {shown(name)}"
    expression = read_expression(text, names, where, SENSOR_FUNCTIONS)
    if "noise" not in settings:
        raise ConfigurationError(
            f"{where} has no noise; give its standard deviation, {head}:noise=S; those with one of"
            f" their own are {', '.join(by_name)}"
        )
    unknown = expression.free_symbols.difference(plant.states, plant.parameters)
    if unknown or not expression.free_symbols.intersection(plant.states):
        states = ", ".join(map(str, plant.states))
        raise ConfigurationError(
            f"{where} depends on {', '.join(map(str, unknown)) or 'no state'}; give an expression"
            f" of the states {states}"
        )
    return Channel(name.strip(), expression, **settings)
