"""Measurements as text: `default`, `range=sqrt(x**2 + y**2):noise=.1:bias=.02`, `delay=2`.

Each item names what is measured, with settings after colons:

    default[:noise=S][:bias=B][:dropout=P]      the problem's own sensor, with other settings
    [NAME=]EXPR[:noise=S][:bias=B][:dropout=P][:period=T]
    delay=D                                     control periods, of all that is measured

EXPR is arithmetic of states and parameters; the name of a channel of the default sensor, or of a
feature, stands for its expression. A channel of the default sensor brings its settings along, and
what depends on `atan2` is known modulo 2 pi.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from safe_envs.errors import ConfigurationError, nearest, shown
from safe_envs.number_text import finite_number

_SETTINGS = ("noise", "bias", "dropout", "period")
_MOST_ITEMS = 100
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
    for item in items:
        _parts(option, item)
    return items


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
        found = _read(problem, _listed(given))
    if factor is None:
        return found
    if found is None:
        raise ConfigurationError(
            f"sensor_noise = {factor}: nothing is measured; give measurement='default' too"
        )
    if factor < 0.0:
        raise ConfigurationError(f"sensor_noise = {factor}; give a factor >= 0")
    scaled = [replace(c, noise=factor * c.noise) for c in found.channels]
    return replace(found, channels=tuple(scaled))


def _listed(given: Any) -> list[str]:
    """Return what options may give as a list of items."""
    if isinstance(given, Mapping):
        items = []
        for name, settings in given.items():
            if not isinstance(settings, Mapping):
                settings = {"noise": settings}
            items.append(":".join([str(name), *(f"{k}={v}" for k, v in settings.items())]))
        given = items
    if not (isinstance(given, str | Sequence) and all(isinstance(i, str) for i in given)):
        raise ConfigurationError(
            f"measurement = {shown(given)}; give 'default', a list of texts, standard deviations by"
            " name, or a Measurement"
        )
    return read_items("measurement", given)


def _parts(option: str, item: Any) -> tuple[str, dict[str, float]]:
    """Return the head of an item and its settings."""
    if not isinstance(item, str) or len(item) > 1000:
        raise ConfigurationError(f"{option} {shown(item)}: {_FORM}")
    head, *entries = [part.strip() for part in item.split(":")]
    found: dict[str, float] = {}
    for entry in entries:
        name, _, value = entry.partition("=")
        if name not in _SETTINGS:
            raise ConfigurationError(
                f"{option} {shown(item)}: unknown setting {shown(name)}; {nearest(name, _SETTINGS)}"
            )
        if name in found:
            raise ConfigurationError(f"{option} {shown(item)}: {name} comes twice; give it once")
        found[name] = finite_number(f"{name} of {option} {shown(head)}", value)
    if not head:
        raise ConfigurationError(f"{option} {shown(item)} names nothing that is measured; {_FORM}")
    if head == "default" and "period" in found:
        raise ConfigurationError(
            f"{option} {shown(item)}: the period is of one expression; leave it out"
        )
    if head.startswith("delay="):
        _delay(option, head, found)
    return head, found


def _delay(option: str, head: str, settings: Mapping[str, float]) -> int:
    value = finite_number(f"{option} delay", head.removeprefix("delay="))
    if settings or value != int(value):
        raise ConfigurationError(
            f"{option} {shown(head)}: give a whole number of control periods alone, delay=2"
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
    import sympy as sp

    from safe_envs.dynamics.expression_text import SENSOR_FUNCTIONS, read_expression
    from safe_envs.problem.measurement import Channel

    name, equals, text = head.partition("=")
    text = text if equals else name
    by_name = {channel.name: channel for channel in known}
    if text in by_name:
        return replace(by_name[text], name=name.strip(), **settings)
    plant = problem.plant
    names = {
        **{f.name: f.expression for f in problem.features},
        **{s.name: s for s in (*plant.parameters, *plant.states)},
    }
    where = f"measurement {shown(name)}"
    expression = read_expression(text, names, where, SENSOR_FUNCTIONS)
    if "noise" not in settings:
        raise ConfigurationError(
            f"{where} has no noise; give its standard deviation, {shown(head)}:noise=S; those with"
            f" one of their own are {', '.join(by_name)}"
        )
    period = 2.0 * math.pi if expression.has(sp.atan2) else 0.0
    return Channel(name.strip(), expression, **{"period": period, **settings})
