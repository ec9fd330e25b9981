"""Checks of the words of a command line, before anything heavy is imported.

Whatever is wrong with names shows within a fraction of a second so. The same functions check names
where an evaluation is asked for in Python; what needs a problem is checked there alone.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from safe_envs.errors import ConfigurationError, nearest, shortened, shown, unknown

_UNFILTERED = "none"


def known_filters(texts: list[str] | None) -> list[str] | None:
    """Return the values of --filter, all of which begin with the name or place of a filter."""
    for text in texts or ():
        known_filter(text)
    return texts


def known_filter(text: str | None) -> str | None:
    """Return the value of --filter if it begins with the name or place of a filter.

    Raises:
        ConfigurationError: It begins otherwise.
    """
    from safe_envs.filters.conditions.names import AT_STATE, unfiltered_in_sum
    from safe_envs.filters.conditions.syntax import require_known, require_parameters

    # An empty text, as of a shell's variable that is not set, is no filter.
    filtered = None if text is None else text.removesuffix(AT_STATE)
    if filtered is not None and filtered != _UNFILTERED:
        if _UNFILTERED in filtered.split("+"):
            raise unfiltered_in_sum(filtered)
        require_known(filtered, _UNFILTERED)
        require_parameters(filtered)
    return text


def known_estimator(text: str | None) -> str | None:
    """Return the value of --estimator if there is such an estimator.

    Raises:
        ConfigurationError: There is none, or it has no such setting.
    """
    from safe_envs.filters.estimation.names import settings_of

    if text is not None:
        settings_of(text)
    return text


def known_policy(name: str) -> str:
    """Return the value of --policy if there is such a policy, or such a file.

    Raises:
        ConfigurationError: There is none.
    """
    from safe_envs.agents.policies.names import require_policy

    require_policy(name)
    return name


def known_envs(env_ids: list[str] | None) -> list[str] | None:
    """Return the ids of envs if there are all of them.

    Raises:
        ConfigurationError: There is no such one.
    """
    from safe_envs.registry import full_id

    for env_id in env_ids or ():
        full_id(env_id)
    return env_ids


def known_algorithm(name: str) -> str:
    """Return the value of --algo if there is such an algorithm.

    Raises:
        ConfigurationError: There is none.
    """
    from safe_envs.agents.training.hyperparameters import ALGORITHMS

    if name not in ALGORITHMS:
        raise ConfigurationError(f"--algo {shortened(name)}: {nearest(name, ALGORITHMS)}")
    return name


def file_that_is_there(advice: str) -> Callable[[Any], Any]:
    """Return the check of an argument that names a file to read.

    Args:
        advice: what to do where there is none, for the message.
    """

    def check(path: Path | None) -> Path | None:
        if path is not None and not os.path.lexists(path):
            reason = os.strerror(errno.ENOENT)
            raise ConfigurationError(f"{shortened(path)} cannot be read: {reason}; {advice}")
        return path

    return check


def folder_to_write(path: Path) -> Path:
    """Return the value of --out if it is a folder, or nothing yet.

    Raises:
        ConfigurationError: It is a file.
    """
    if os.path.lexists(path) and not os.path.isdir(path):
        raise ConfigurationError(f"--out {shortened(path)} is a file; give a new folder")
    return path


def known_method(name: str) -> str:
    """Return the value of --method if there is such a method.

    Raises:
        ConfigurationError: There is none.
    """
    from safe_envs.scripts.options.settings import SETTINGS

    if name not in SETTINGS:
        raise unknown("method", name, SETTINGS)
    return name


def one_of(option: str, allowed: Sequence[str]) -> Callable[[Any], Any]:
    """Return the check of an option whose value is one of a few words.

    Args:
        option: its name without dashes, for the message.
        allowed: the words.
    """

    def check(given: str | None) -> str | None:
        if given is not None and given not in allowed:
            raise ConfigurationError(f"{option} = {shown(given)}; {nearest(given, allowed)}")
        return given

    return check


def between_0_and_1(option: str, example: float) -> Callable[[Any], Any]:
    """Return the check of an option that is a number above 0 and below 1.

    Args:
        option: its name without dashes, for the message.
        example: a usual value, likewise.
    """

    def check(given: float | None) -> float | None:
        if given is not None and not 0 < given < 1:
            raise ConfigurationError(
                f"{option} = {given}; give a number above 0 and below 1, such as {example}"
            )
        return given

    return check
