"""Filters that act by themselves: they are made of no conditions, and their text names no other."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar

from safe_envs.errors import ConfigurationError, nearest, shown
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.conditions.text_parts import parts_of

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
