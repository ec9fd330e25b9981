"""Completion of words in a shell; no heavy module is imported, so that it answers at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from safe_envs.systems import ENV_IDS


def env_ids(incomplete: str) -> list[str]:
    """Return the registered ids that begin so, with or without their namespace."""
    return [
        name
        for env_id in ENV_IDS
        for name in (env_id, env_id.partition("/")[2])
        if name.startswith(incomplete)
    ]


def words(allowed: Sequence[str]) -> Callable[[str], list[str]]:
    """Return the completion by a list of words."""

    def complete(incomplete: str) -> list[str]:
        return [word for word in allowed if word.startswith(incomplete)]

    return complete


def filters(incomplete: str) -> list[str]:
    """Names of filters, those of installed packages too."""
    from safe_envs.filters.conditions.names import BY_THEMSELVES, condition_names

    return words(("none", *condition_names(), *BY_THEMSELVES))(incomplete)


def policies(incomplete: str) -> list[str]:
    """Names of policies."""
    from safe_envs.agents.policies.names import POLICIES

    return words(POLICIES)(incomplete)


def algorithms(incomplete: str) -> list[str]:
    """Names of algorithms."""
    from safe_envs.agents.training.hyperparameters import ALGORITHMS

    return words(ALGORITHMS)(incomplete)
