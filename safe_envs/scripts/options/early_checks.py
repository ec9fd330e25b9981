"""Checks of the words of a command line, before anything heavy is imported.

Whatever is wrong with names shows within a fraction of a second so. The same functions check names
where an evaluation is asked for in Python; what needs a problem is checked there alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from safe_envs.errors import ConfigurationError, nearest, shortened, shown
from safe_envs.scripts.options import completion

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
    from safe_envs.wrappers.conditions.text_parts import require_known

    if text and _UNFILTERED not in text.split("+"):
        require_known(text, _UNFILTERED)
    return text


def known_policy(name: str) -> str:
    """Return the value of --policy if there is such a policy, or such a file.

    Raises:
        ConfigurationError: There is none.
    """
    from safe_envs.agents.policies.names import require_policy

    require_policy(name)
    return name


def known_policies(names: list[str] | None) -> list[str] | None:
    """Return the values of --policy; see `known_policy`."""
    for name in names or ():
        known_policy(name)
    return names


def known_algorithm(name: str) -> str:
    """Return the value of --algo if there is such an algorithm.

    Raises:
        ConfigurationError: There is none.
    """
    from safe_envs.agents.training.hyperparameters import ALGORITHMS

    if name not in ALGORITHMS:
        raise ConfigurationError(f"--algo {shortened(name)}: {nearest(name, ALGORITHMS)}")
    return name


def known_artefacts(names: list[str] | None) -> list[str] | None:
    """Return the names of tables and figures of the thesis if there are all of them.

    Raises:
        ConfigurationError: There is no such one.
    """
    allowed = ("all", *completion.ARTEFACTS)
    for name in names or ():
        if name not in allowed:
            raise ConfigurationError(f"unknown artefact {shown(name)}; {nearest(name, allowed)}")
    return names


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


def between_0_and_1(option: str) -> Callable[[Any], Any]:
    """Return the check of an option that is a number above 0 and below 1.

    Args:
        option: its name without dashes, for the message.
    """

    def check(given: float | None) -> float | None:
        if given is not None and not 0 < given < 1:
            raise ConfigurationError(
                f"{option} = {given}; give a number above 0 and below 1, such as 0.95"
            )
        return given

    return check
