"""Filters that act by themselves, from their text to what decides in the episodes of envs."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.backup import BackupFilter, BackupSettings
from safe_envs.wrappers.conditions.filter_settings import FilterSettings
from safe_envs.wrappers.conditions.names import BACKUP, PROMISE
from safe_envs.wrappers.conditions.text_parts import name_by_itself
from safe_envs.wrappers.value.promise_filter import PromiseFilter
from safe_envs.wrappers.value.promise_tables import promise_filter_for
from safe_envs.wrappers.value.promise_text import PromiseSettings

LoneFilter = PromiseFilter | BackupFilter
"""A filter that acts by itself."""

_READERS: dict[str, Callable[[str], FilterSettings]] = {
    PROMISE: PromiseSettings.of_text,
    BACKUP: BackupSettings.of_text,
}


def settings_of(text: str) -> FilterSettings | None:
    """Return the settings in the text of a filter that acts by itself; None for conditions.

    Args:
        text: of a filter.

    Raises:
        ConfigurationError: The text begins with the name of such a filter, and has another form.
    """
    name = name_by_itself(text)
    return _READERS[name](text) if name else None


def settings_among(texts: Iterable[str]) -> dict[str, FilterSettings]:
    """Return the settings among texts of filters, by these texts; see `settings_of`.

    Args:
        texts: of filters.
    """
    found = {text: settings_of(text) for text in texts}
    return {text: settings for text, settings in found.items() if settings is not None}


def lone_filter_for(
    problem: SafetyProblem,
    settings: FilterSettings,
    knowledge: str = "model",
    progress: Callable[[float], None] | None = None,
) -> LoneFilter:
    """Return the filter of a problem.

    Args:
        problem: that is to be kept safe.
        settings: of the filter.
        knowledge: what it knows, the "model" or the "plant".
        progress: called with the part of a table that is computed, from 0 to 1.

    Raises:
        ConfigurationError: The settings do not fit the problem.
    """
    if isinstance(settings, PromiseSettings):
        return promise_filter_for(problem, settings, knowledge, progress)
    assert isinstance(settings, BackupSettings)
    found = BackupFilter.for_problem(problem, settings, knowledge)
    if progress is not None:
        progress(1.0)
    return found
