"""Conditions as text: `hocbf:alpha=2,8`, or `hocbf:alpha=2,8+cbf:alpha=1` for two barriers.

A condition of a user's file is `FILE.py:NAME`, of a module `MODULE:NAME`; parameters follow, as in
`my_filter.py:Eager:gain=2`.
"""

from __future__ import annotations

import importlib.util
import inspect
import math
import os
import re
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from safe_envs.dynamics.lie import generator, lie_derivative_f, relative_degree
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import (
    ConfigurationError,
    RelativeDegreeError,
    SafeEnvsError,
    nearest,
    shortened,
    shown,
)
from safe_envs.filters.conditions.base import Condition
from safe_envs.filters.conditions.certified import Certified
from safe_envs.filters.conditions.names import (
    BACKUP,
    BY_THEMSELVES,
    COMMON,
    ONLY_DEGREE_1,
    PARAMETERS,
    PROMISE,
    condition_names,
    is_built_in,
    unknown_filter,
    wrong_rates,
)
from safe_envs.filters.conditions.registry import condition_class, name_of
from safe_envs.filters.learning import load_learned
from safe_envs.filters.learning.models.base import LearnedModel
from safe_envs.plugins import CONDITIONS, module_of, resolved
from safe_envs.problem.problem import Barrier, SafetyProblem
from safe_envs.text import real_or_complex

_FILE = r"(?:\.{0,2}/[^:]{0,4096}?|[^+:,/][^+:,]{0,4096}?)\.py:[A-Za-z_]\w*"
"""FILE.py:NAME; only a path from / or ./ may hold a "+" or a comma, for these divide conditions."""

_MODULE = r"[A-Za-z_][\w.]*:[A-Za-z_]\w*(?=\s*(?:[:+,]|$))"
"""MODULE:NAME; a parameter is none, for a "=" follows its name."""


_HEAD_BY_ITSELF = re.compile(rf"\s*({'|'.join(BY_THEMSELVES)})\s*(?:[:+]|$)")

_RATES = re.compile(r"p=[-+.0-9e]+(,[-+.0-9e]+)*")
"""Rates that are numbers; with class-K functions among them more may be wrong than their count."""


class ConditionText(NamedTuple):
    """The text of one condition, taken apart: its name or place, and what sets its parameters."""

    text: str
    name: str
    settings: list[str]


def head_pattern(*more: str) -> str:
    """Return the regular expression of what the text of a condition begins with.

    Args:
        more: names that are accepted besides those of conditions.
    """
    names = sorted((*more, *BY_THEMSELVES, *condition_names()), key=len, reverse=True)
    return rf"(?:(?:{'|'.join(map(re.escape, names))})(?=\s*(?:[:+,]|$))|{_FILE}|{_MODULE})"


def require_known(text: str, *more: str) -> None:
    """Raise ConfigurationError unless the text of a filter begins with the name of one.

    Args:
        text: as for `parse_conditions`.
        more: names that the message lists besides those of conditions.
    """
    name = parts_of(text)[0].name
    if not (_is_known(name) or name in BY_THEMSELVES):
        raise unknown_filter(name, *more)


def require_parameters(text: str) -> None:
    """Raise ConfigurationError for parameters that the conditions of a model do not have.

    Args:
        text: as for `parse_conditions`.
    """
    for part in parts_of(text):
        allowed = PARAMETERS.get(part.name, ())
        for key, _, value in (setting.partition("=") for setting in part.settings if allowed):
            if key not in allowed:
                raise ConfigurationError(
                    f"filter {part.name} has no parameter {shown(key)}; {nearest(key, allowed)}"
                )
            if not value:
                raise ConfigurationError(
                    f"filter {part.name} gives {key} no value; give it as {key}=VALUE"
                )


def require_degrees(text: str, degrees: Mapping[str, int]) -> None:
    """Raise an error for a cbf or hocbf that does not suit the degree of its barrier.

    Args:
        text: as for `parse_conditions`.
        degrees: relative degree of each barrier, by its name.

    Raises:
        RelativeDegreeError: A number of rates is not the relative degree.
    """
    parts = parts_of(text)
    for part, (barrier, degree) in zip(parts * len(degrees), degrees.items(), strict=False):
        rates = next((s for s in part.settings if _RATES.fullmatch(s)), None)
        if part.name == "cbf" and degree != 1:
            raise RelativeDegreeError(f"{wrong_rates(barrier, degree, 1)}. {ONLY_DEGREE_1}")
        if part.name == "hocbf" and rates is not None and rates.count(",") + 1 != degree:
            raise wrong_rates(barrier, degree, rates.count(",") + 1)


def name_by_itself(text: str) -> str:
    """Return the name of the filter that acts by itself, of which a text is; "" of conditions."""
    found = _HEAD_BY_ITSELF.match(text)
    return found.group(1) if found else ""


def names_promise(text: str) -> bool:
    """Return whether the text of a filter is that of the promise filter."""
    return name_by_itself(text) == PROMISE


def names_backup(text: str) -> bool:
    """Return whether the text of a filter is that of the backup filter."""
    return name_by_itself(text) == BACKUP


def _is_known(name: str) -> bool:
    return ":" in name or name in condition_names()


def parts_of(text: str) -> list[ConditionText]:
    """Take the text of a filter apart: a "+" divides where the head of a condition follows it."""
    head = re.compile(head_pattern())
    start = len(_head(text, head))
    # A class-K function, a complex pole or the path of a file may hold a "+" too.
    first, *others = re.split(rf"\+(?={head.pattern})", text[start:])
    return [_part(part, head) for part in (text[:start] + first, *others)]


def _part(text: str, head: re.Pattern[str]) -> ConditionText:
    name = _head(text, head)
    rest, *settings = text[len(name) :].split(":")
    return ConditionText(text, name + rest, settings)


def _head(text: str, head: re.Pattern[str]) -> str:
    """Return the name or the place at the beginning of a text."""
    found = head.match(text)
    name = found.group() if found else ""
    source, colon, _ = name.rpartition(":")
    is_there = found and (not colon or source.endswith(".py") or _has_module(source))
    return name if is_there else text.split(":")[0]


def _has_module(name: str) -> bool:
    top = name.split(".")[0]
    return top in sys.modules or importlib.util.find_spec(top) is not None


def learned_parts(text: str) -> list[tuple[str, str | None]]:
    """Return the method and the file, None without one, of each condition that needs a model."""
    return [
        (method, next((s[len("file=") :] for s in part.settings if s.startswith("file=")), None))
        for part in parts_of(text)
        if _is_known(part.name) and (method := condition_class(part.name).method) is not None
    ]


def files_of(text: str) -> tuple[Path, ...]:
    """Return the files that the text of a filter names, of Python, a learned model or a table.

    Nothing is run and no file is opened.
    """
    parts = parts_of(text)
    sources = [part.name.rpartition(":")[0] for part in parts]
    settings = [s.partition("=") for part in parts for s in part.settings]
    names_file = _file_key(text)
    return tuple(
        Path(path)
        for path in (
            *(source for source in sources if source.endswith(".py")),
            *(value for key, _, value in settings if key == names_file),
        )
    )


def modules_of(text: str) -> tuple[str, ...]:
    """Return the modules of the conditions in a text that are MODULE:NAME or of a package.

    Nothing is imported.
    """
    found = (_module_of(part.name) for part in parts_of(text))
    return tuple(module for module in found if module is not None)


def _module_of(name: str) -> str | None:
    source, colon, _ = name.rpartition(":")
    if colon:
        return None if source.endswith(".py") else source
    return None if is_built_in(name) else module_of(CONDITIONS, name)


def with_absolute_paths(text: str) -> str:
    """Return the text of a filter with the whole paths of its files, as it holds in any folder."""
    names_file = _file_key(text)

    def absolute(setting: str) -> str:
        key, _, value = setting.partition("=")
        return f"{key}={os.path.realpath(value)}" if key == names_file else setting

    return "+".join(
        ":".join([resolved(part.name), *map(absolute, part.settings)]) for part in parts_of(text)
    )


def _file_key(text: str) -> str:
    """Return which setting of a filter names a file that it reads."""
    return "table" if names_promise(text) else "file"


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
    texts = ["file"] * _reads_file(condition) + ["control"] * issubclass(condition, Certified)
    names = list(dict.fromkeys([*parameters, *texts]))
    given: dict[str, Any] = {}
    for setting in part.settings:
        key, _, value = setting.partition("=")
        if key in given:
            raise ConfigurationError(f"filter {shown(part.text)} names {shown(key)} twice")
        if key not in names:
            hint = _hint(key, names, given)
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
