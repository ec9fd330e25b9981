"""The conditions, and how they are written as text: `hocbf:p=2,8`, or `hocbf:p=2,8+cbf:alpha=1` for
two barriers."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from safe_envs.errors import ConfigurationError, nearest, shown
from safe_envs.number_text import real_or_complex
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.conditions.base import AffineConstraint, Condition
from safe_envs.wrappers.conditions.cbf import CBF, ECBF, HOCBF
from safe_envs.wrappers.conditions.class_k import ClassK, power
from safe_envs.wrappers.conditions.learned import (
    DDSCBF,
    BayesianSCBF,
    LearnedCondition,
    LearnedHOCBF,
)
from safe_envs.wrappers.conditions.reciprocal import RCBF, SRCBF
from safe_envs.wrappers.conditions.stochastic import SCBF, SZCBF
from safe_envs.wrappers.learning import LearnedModel, load_learned

CONDITIONS: dict[str, type[Condition]] = {
    c.name: c for c in (CBF, ECBF, HOCBF, RCBF, SRCBF, SZCBF, SCBF)
}
"""Those that need nothing but a model."""

LEARNED: dict[str, type[LearnedCondition]] = {
    c.name: c for c in (LearnedHOCBF, DDSCBF, BayesianSCBF)
}
"""Those that rest on something learned."""

__all__ = [
    "CBF",
    "CONDITIONS",
    "DDSCBF",
    "ECBF",
    "HOCBF",
    "LEARNED",
    "RCBF",
    "SCBF",
    "SRCBF",
    "SZCBF",
    "AffineConstraint",
    "BayesianSCBF",
    "ClassK",
    "Condition",
    "LearnedCondition",
    "LearnedHOCBF",
    "parse_condition",
    "parse_conditions",
    "power",
    "require_readable",
    "spec_of",
]

_MOST_ENTRIES = 12
"""Of a parameter, as for the longest chain of integrators that anybody filters: the poles of a
dozen gains take a second."""

# A class-K function or a complex pole may hold a "+" too.
_BETWEEN = re.compile(rf"\+(?=(?:{'|'.join((*CONDITIONS, *LEARNED))})(?:[:+]|$))")


Learned = Mapping[str, LearnedModel]
"""What was learned, by method."""


def parse_conditions(
    text: str, problem: SafetyProblem, learned: Learned | None = None
) -> tuple[Condition, ...]:
    """Read a condition for every barrier of a problem: one text for all of them, or one for each
    with "+" between.

    Args:
        text: see `parse_condition`; `ddscbf:file=FILE` reads what was learned from a file of
            `safe-envs identify`.
        problem: whose barriers and gains are taken.
        learned: what the conditions rest on that name no file.

    Raises:
        ConfigurationError: as `parse_condition`, or there are neither one nor as many texts as
            barriers.
    """
    return _parsed(
        text,
        problem,
        lambda condition, path: _learned_for(text, condition, path, problem, learned or {}),
    )


def require_readable(text: str, problem: SafetyProblem) -> None:
    """Raise ConfigurationError where `parse_conditions` would, but for what was learned, which may
    not be there yet."""
    _parsed(text, problem, lambda condition, path: None)


def _parsed(
    text: str, problem: SafetyProblem, learned_for: Callable[[Any, str | None], Any]
) -> tuple[Condition, ...]:
    texts = _BETWEEN.split(text)
    count = len(problem.barriers)
    if len(texts) not in (1, count):
        allowed = "one" if count == 1 else f"one for all {count} barriers, or one for each"
        raise ConfigurationError(
            f"filter {shown(text)} has {len(texts)} conditions; {problem.name} takes {allowed}"
        )
    found: list[Condition] = []
    for i, part in enumerate(texts * count if len(texts) == 1 else texts):
        if part.split(":")[0] in LEARNED:
            condition, settings = _settings(part)
            found.append(
                condition.from_learned(
                    learned_for(condition, settings.pop("file", None)),
                    problem.gains_of(i),
                    **settings,
                )
            )
        else:
            found.append(parse_condition(part, problem.gains_of(i)))
    return tuple(found)


def _learned_for(
    text: str, condition: Any, path: str | None, problem: SafetyProblem, learned: Learned
) -> LearnedModel:
    model = (
        learned.get(condition.method)
        if path is None
        else load_learned(path, problem, condition.method)
    )
    if model is None:
        raise ConfigurationError(
            f"filter {shown(text)} rests on something learned: learn it by `safe-envs identify`,"
            f" and name the file as {condition.name}:file=FILE"
        )
    return model


def spec_of(conditions: Sequence[Condition]) -> str:
    """The text from which `parse_conditions` makes the same conditions."""
    specs = [condition.spec for condition in conditions]
    return specs[0] if len(set(specs)) == 1 else "+".join(specs)


def parse_condition(text: str, gains: Sequence[float]) -> Condition:
    """Read a condition from its name, or its name and parameters: `scbf`, `hocbf:p=2,8`,
    `cbf:alpha=2*s**3`.

    Args:
        text: name, and parameters as `key=value` with commas between the entries of a tuple.
        gains: rates p_1..p_r that set the parameters where the text names none of them.

    Raises:
        ConfigurationError: the name or a parameter is unknown or comes twice, or a value is not
            allowed.
    """
    condition, given = _settings(text)
    if issubclass(condition, LearnedCondition) or set(given) <= {"sampling_margin"}:
        return replace(condition.for_gains(gains), **given)
    return condition(**given)


def _settings(text: str) -> tuple[Any, dict[str, Any]]:
    """The class of a condition, and what its text sets."""
    name, *settings = text.split(":")
    known = {**CONDITIONS, **LEARNED}
    if name not in known:
        raise ConfigurationError(f"unknown filter {shown(name)}; {nearest(name, known)}")
    condition = known[name]
    allowed = {
        key: p for key, p in inspect.signature(condition).parameters.items() if key != "learned"
    }
    names = [*allowed, "file"] if name in LEARNED else list(allowed)
    given: dict[str, Any] = {}
    for setting in settings:
        key, _, value = setting.partition("=")
        if key not in names or key in given:
            hint = f"{name} has no parameter {shown(key)}; {_hint(key, names, given)}"
            reason = f"{shown(text)} names {shown(key)} twice" if key in given else hint
            raise ConfigurationError(f"filter {reason}")
        given[key] = (
            value
            if key == "file"
            else _value(text, key, value, _takes_one(name, allowed[key].default))
        )
    return condition, given


def _hint(key: str, names: Sequence[str], given: Mapping[str, Any]) -> str:
    if key == "sha256":
        return (
            "it stands for something learned that is in no file: save it, and name that as"
            " file=FILE"
        )
    if "file" in given:
        return (
            f"{nearest(key, names)}; a file whose name holds a colon is given by --learned, or read"
            " by load_learned"
        )
    return nearest(key, names)


def _takes_one(name: str, default: Any) -> bool:
    """Whether a parameter with such a default takes one value, and not a tuple."""
    return isinstance(default, float | str) or (default is None and name in LEARNED)


def _value(text: str, key: str, value: str, single: bool) -> Any:
    texts, most = value.split(","), 1 if single else _MOST_ENTRIES
    if len(texts) > most:
        allowed = "one value" if single else f"at most {most} values"
        raise ConfigurationError(
            f"filter {shown(text)}: {key} takes {allowed}; {len(texts)} were given"
        )
    entries = tuple(_entry(entry) for entry in texts)
    return entries[0] if single else entries


def _entry(text: str) -> Any:
    """A number, where it is one; the condition says what else it takes."""
    try:
        return real_or_complex(text)
    except ValueError:
        return text
