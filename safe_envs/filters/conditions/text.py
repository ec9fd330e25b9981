"""Conditions as text: `hocbf:alpha=2,8`, or `hocbf:alpha=2,8+cbf:alpha=1` for two barriers.

A condition of a user's file is `FILE.py:NAME`, of a module `MODULE:NAME`; parameters follow, as in
`my_filter.py:Eager:gain=2`.
"""

from __future__ import annotations

import inspect
import math
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from typing import Any, ClassVar

from safe_envs.dynamics.lie import generator, lie_derivative_f, relative_degree
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import (
    HELD_CERTIFICATES,
    ConfigurationError,
    SafeEnvsError,
    nearest,
    shortened,
    shown,
)
from safe_envs.filters.conditions.base import Condition
from safe_envs.filters.conditions.certified import Certified
from safe_envs.filters.conditions.names import (
    COMMON,
)
from safe_envs.filters.conditions.registry import condition_class, name_of
from safe_envs.filters.conditions.syntax import ConditionText, _part, head_pattern, parts_of
from safe_envs.filters.learning import load_learned
from safe_envs.filters.learning.models.base import LearnedModel
from safe_envs.problem.problem import Barrier, SafetyProblem
from safe_envs.text import real_or_complex

_MOST_ENTRIES = 12
"""Of a parameter, as for the longest chain of integrators that anybody filters: the poles of a
dozen gains take a second."""

Learned = Mapping[str, LearnedModel]
"""Learned models by method."""

Conditions = Condition | Sequence[Condition] | str
"""One condition for every barrier, one for each, or their text."""


def parse_conditions(
    text: str, problem: SafetyProblem, learned: Learned | None = None
) -> tuple[Condition, ...]:
    """Read a condition for every barrier of a problem.

    Args:
        text: one for all barriers, or one for each with "+" between; see `parse_condition`.
            `ddscbf:file=FILE` reads the learned model from a file of `safe-envs identify`,
            `certified:file=FILE` a certificate of `safe-envs certify`.
        problem: problem whose barriers and gains are taken.
        learned: models for the conditions that name no file.

    Returns:
        As many conditions as barriers.

    Raises:
        ConfigurationError: As `parse_condition`, or there are neither one nor as many texts as
            barriers.
    """
    return _parsed(
        text,
        problem,
        lambda condition, path: _learned_for(text, condition, path, problem, learned or {}),
    )


def conditions_for(problem: SafetyProblem, given: Conditions) -> tuple[Condition, ...]:
    """Return a condition for every barrier of a problem.

    Args:
        problem: problem whose barriers and gains are taken.
        given: one for all barriers, one for each, or their text.

    Raises:
        ConfigurationError: Their number is wrong, or one is none or does not fit the problem.
    """
    count = len(problem.barriers)
    read = parse_conditions(given, problem) if isinstance(given, str) else given
    each = (read,) * count if isinstance(read, Condition) else read
    if not isinstance(each, Sequence) or not all(isinstance(c, Condition) for c in each):
        raise ConfigurationError(
            f"condition = {shown(given)}; give a Condition, one for each barrier, or their text,"
            " like 'scbf'"
        )
    if len(each) != count:
        raise ConfigurationError(
            f"{len(each)} conditions for the {count} barriers of {problem.name}; give one for each"
        )
    for condition in each:
        condition.require_fit(problem)
    return tuple(each)


def parse_for_system(
    text: str, system: ControlAffineSDE, barriers: Sequence[Barrier]
) -> tuple[Condition, ...]:
    """Read a condition for every barrier of a system without a problem.

    Args:
        text: as for `parse_conditions`; rates that it does not name are ones.
        system: the dynamics.
        barriers: what is safe.

    Raises:
        ConfigurationError: As `parse_conditions`; or one needs a file, which is of a problem.
        RelativeDegreeError: No input reaches a barrier whose rates are not named.
    """
    found: list[Condition] = []
    for part, barrier in zip(_parts_for(text, len(barriers), "the filter"), barriers, strict=True):
        condition, given = _settings(part)
        if _reads_file(condition):
            advice = f"make the filter by SafetyFilter.for_problem(problem, {shown(text)})"
            raise ConfigurationError(
                f"{condition.name} is learned or proved of a problem; {advice}"
            )
        degree = 0
        if set(given) <= set(COMMON):
            derivative = generator if condition.stochastic else lie_derivative_f
            degree = relative_degree(system, barrier.expression, derivative)
        found.append(_of_model(part, condition, given, (1.0,) * degree))
    return tuple(found)


def require_readable(text: str, problem: SafetyProblem) -> None:
    """Raise ConfigurationError where `parse_conditions` would, without reading learned models.

    Args:
        text: as for `parse_conditions`.
        problem: problem whose barriers and gains are taken.
    """
    _parsed(text, problem, lambda condition, path: None)


def parse_condition(text: str, gains: Sequence[float]) -> Condition:
    """Read a condition from its name, or its name and parameters.

    Args:
        text: name, and parameters as `key=value` with commas between the entries of a tuple:
            `scbf`, `hocbf:alpha=2,8`, `cbf:alpha=2*s**3`, `my_filter.py:Eager:gain=2`.
        gains: rates p_1..p_r in 1/s that set the parameters where the text names none of them.

    Raises:
        ConfigurationError: The name or a parameter is unknown or comes twice, or a value is not
            allowed.
    """
    part = _part(text, re.compile(head_pattern()))
    return _of_model(part, *_settings(part), gains)


def spec_of(conditions: Condition | Sequence[Condition]) -> str:
    """Return the text from which `parse_conditions` makes the same conditions.

    That of a class from a user's file holds the whole path of the file.
    """
    each = [conditions] if isinstance(conditions, Condition) else conditions
    texts = [_spec(condition) for condition in each]
    return texts[0] if len(set(texts)) == 1 else "+".join(texts)


def _parsed(
    text: str, problem: SafetyProblem, learned_for: Callable[[Any, str | None], Any]
) -> tuple[Condition, ...]:
    found: list[Condition] = []
    for i, part in enumerate(_parts_for(text, len(problem.barriers), problem.name)):
        condition, given = _settings(part)
        if issubclass(condition, Certified):
            found.append(_made(part, condition.for_problem, problem, **given))
        elif condition.method is not None:
            learned = learned_for(condition, given.pop("file", None))
            found.append(_made(part, condition.from_learned, learned, problem.gains_of(i), **given))
        else:
            found.append(_of_model(part, condition, given, problem.gains_of(i)))
    return tuple(found)


def _parts_for(text: str, count: int, taker: str) -> list[ConditionText]:
    """Return the texts of `count` conditions; a single one is for all."""
    parts = parts_of(text)
    if len(parts) not in (1, count):
        allowed = "one" if count == 1 else f"one for all {count} barriers, or one for each"
        raise ConfigurationError(
            f"filter {shown(text)} has {len(parts)} conditions; {taker} takes {allowed}"
        )
    return parts * count if len(parts) == 1 else parts


def _of_model(
    part: ConditionText, condition: Any, given: dict[str, Any], gains: Sequence[float]
) -> Condition:
    if _reads_file(condition) or set(given) <= set(COMMON):
        return replace(_made(part, condition.for_gains, gains), **given)
    return _made(part, condition, **given)


def _made(
    part: ConditionText, make: Callable[..., Condition], *args: Any, **given: Any
) -> Condition:
    """Call what makes a condition; any error of its class becomes a ConfigurationError."""
    try:
        return make(*args, **given)
    except SafeEnvsError:
        raise
    except Exception as error:
        raise ConfigurationError(
            f"filter {shown(part.text)} cannot be made"
            f" ({type(error).__name__}: {shortened(error)}); correct {part.name}"
        ) from error


def _learned_for(
    text: str, condition: Any, path: str | None, problem: SafetyProblem, learned: Learned
) -> LearnedModel:
    if path is not None:
        return load_learned(path, problem, condition.method)
    if condition.method not in learned:
        raise ConfigurationError(
            f"filter {shown(text)} needs a learned model: run `safe-envs identify`, and name its"
            f" file as {condition.name}:file=FILE"
        )
    return learned[condition.method]


def _settings(part: ConditionText) -> tuple[Any, dict[str, Any]]:
    """Return the class of a condition, and the arguments that its text sets."""
    condition = condition_class(part.name)
    parameters = dict(inspect.signature(condition).parameters)
    if _reads_file(condition):
        # What the file holds is no text.
        parameters.pop("learned", None)
        parameters.pop("certificate", None)
    texts = ["file"] * _reads_file(condition)
    names = list(dict.fromkeys([*parameters, *texts]))
    given: dict[str, Any] = {}
    for setting in part.settings:
        key, _, value = setting.partition("=")
        if key in given:
            raise ConfigurationError(f"filter {shown(part.text)} names {shown(key)} twice")
        if key not in names:
            old = key == "control" and issubclass(condition, Certified)
            hint = HELD_CERTIFICATES if old else _hint(key, names, given)
            raise ConfigurationError(f"filter {part.name} has no parameter {shown(key)}; {hint}")
        given[key] = value if key in texts else _value(part.text, parameters[key], value)
    return condition, given


def _reads_file(condition: type[Condition]) -> bool:
    """Return whether a condition needs what a file holds: a learned model, or a certificate."""
    return condition.method is not None or issubclass(condition, Certified)


def _hint(key: str, names: Sequence[str], given: Mapping[str, Any]) -> str:
    if key == "sha256":
        return (
            "it stands for a learned model or a certificate without a file: save it, and name that"
            " as file=FILE"
        )
    if "file" in given:
        more = "a file whose name holds a colon is given by --learned, or read by load_learned"
        return nearest(key, names, more)
    return nearest(key, names)


def _value(text: str, parameter: inspect.Parameter, value: str) -> Any:
    """Return the value of a parameter: one entry, or a tuple where that is annotated or default."""
    default = parameter.default
    several = isinstance(default, tuple) or "tuple" in str(parameter.annotation)
    entries, most = value.split(","), _MOST_ENTRIES if several else 1
    if len(entries) > most:
        allowed = f"at most {most} values" if several else "one value"
        raise ConfigurationError(
            f"filter {shown(text)}: {parameter.name} takes {allowed}; {len(entries)} were given"
        )
    if several:
        return tuple(map(_entry, entries))
    if isinstance(default, bool) and value in ("True", "False"):
        return value == "True"
    entry = _entry(value)
    if parameter.annotation in (float, "float", int, "int") and not (
        isinstance(entry, int | float) and math.isfinite(entry)
    ):
        raise ConfigurationError(f"filter {shown(text)}: {parameter.name} takes a finite number")
    whole = type(default) is int and isinstance(entry, float) and entry.is_integer()
    return int(entry) if whole else entry


def _entry(text: str) -> Any:
    """Return a number where the text is one; the condition says what else it takes."""
    try:
        return real_or_complex(text)
    except ValueError:
        return text


def _spec(condition: Condition) -> str:
    given = dict(condition.parameters)
    standard = {f.name: f.default for f in fields(Condition)}
    common = {key: getattr(condition, key) for key in COMMON}
    given |= {key: value for key, value in common.items() if value != standard[key]}
    settings = [
        f"{key}={','.join(map(str, value)) if isinstance(value, tuple) else value}"
        for key, value in given.items()
    ]
    return ":".join([name_of(type(condition)), *settings])


# A value may hold a colon, such as that of an interval: one divides before "key=" alone.
_DIVIDES = re.compile(r":(?=\w+=)")


class FilterSettings(ABC):
    """What a filter that acts by itself is asked for.

    Attributes:
        name: with which its text begins.
        only_of_steps: why it has no bound for continuous control.
        not_compiled: why only NumPy can simulate under it; "" where that is not so.
        of_paths: what it remembers of the path so far; "" where it decides by the state alone.
    """

    name: ClassVar[str]
    only_of_steps: ClassVar[str]
    not_compiled: ClassVar[str] = ""
    of_paths: ClassVar[str] = ""

    @property
    @abstractmethod
    def text(self) -> str:
        """The text from which the same settings are read."""

    @abstractmethod
    def require_fit(self, problem: SafetyProblem, objective: str = "nearest") -> None:
        """Raise ConfigurationError where the settings do not fit a problem.

        Args:
            problem: that is to be kept safe.
            objective: of the filter, "nearest" or "clf".
        """

    def require_nearest(self, objective: str) -> None:
        """Raise ConfigurationError for another objective than to take the nearest input.

        Args:
            objective: as given.
        """
        if objective != "nearest":
            raise ConfigurationError(
                f"objective = {shown(objective)}: the {self.name} filter takes the input nearest to"
                " the proposed one; use 'nearest'"
            )


def settings_in(text: str, name: str, keys: Sequence[str], example: str) -> dict[str, str]:
    """Return the values in the text of a filter that acts by itself, by their keys.

    Args:
        text: NAME:key=value:key=value.
        name: of the filter.
        keys: that there are.
        example: of such a text, for errors.

    Raises:
        ConfigurationError: The text has another form, or names a key twice.
    """
    if len(parts_of(text)) > 1:
        raise ConfigurationError(
            f"filter {shown(text)}: the {name} filter acts alone, on all barriers together;"
            f' give it without "+", like {example}'
        )
    head, *parts = _DIVIDES.split(text.strip())
    given: dict[str, str] = {}
    for part in parts:
        key, _, value = part.partition("=")
        if key not in keys:
            raise _unknown(text, key, keys, example)
        if key in given:
            raise ConfigurationError(f"filter {shown(text)} names {shown(key)} twice")
        given[key] = value
    if head.strip() != name:
        raise _unknown(text, head.strip().removeprefix(name).lstrip(":"), keys, example)
    return given


def _unknown(text: str, key: str, keys: Sequence[str], example: str) -> ConfigurationError:
    if key in keys:
        return ConfigurationError(
            f"filter {shown(text)} gives {key} no value; settings are key=value, as in {example}"
        )
    return ConfigurationError(
        f"filter {shown(text)} has no setting {shown(key)};"
        f" {nearest(key, keys, f'as in {example}')}"
    )
