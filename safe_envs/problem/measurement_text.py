"""Measurements as text: `default`, `range=sqrt(x**2 + y**2):noise=.1:bias=.02`, `delay=2`.

Each item names what is measured, with settings after colons:

    default[:noise=S][:bias=B][:dropout=P]      the problem's own sensor, with other settings
    [NAME=]EXPR[:noise=S][:bias=B][:dropout=P][:period=T]
    delay=D                                     control periods, of all that is measured

EXPR is arithmetic of states and parameters; the name of a feature stands for its expression. EXPR
may be the name of a channel of the default sensor too, which brings its settings along. The period
is by default that of the angles in EXPR; see `Channel.period`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from safe_envs.errors import ConfigurationError, nearest, shown
from safe_envs.number_text import finite_number
from safe_envs.problem.option_errors import LONGEST_DELAY

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
    from safe_envs.problem.measurement import Measurement

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
    from safe_envs.problem.measurement import Channel, Measurement, default_measurement

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
    from safe_envs.problem.measurement import Channel

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
