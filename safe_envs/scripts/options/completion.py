"""Completion of words in a shell; no heavy module is imported, so that it answers at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from safe_envs import plugins
from safe_envs.systems import ENV_IDS

FILTERS = (
    "none",
    "cbf",
    "ecbf",
    "hocbf",
    "rcbf",
    "srcbf",
    "szcbf",
    "scbf",
    "learned-hocbf",
    "ddscbf",
    "bayesian-scbf",
    "certified",
    "promise",
    "backup",
)
"""Names of filters, as `safe_envs.wrappers.conditions` knows them: that takes too long to ask."""

POLICIES = ("nominal", "clf", "zero", "random", "best")
"""Names of policies, as `safe_envs.agents.policies.registry` knows them."""

ALGORITHMS = ("ppo", "a2c", "sac", "td3", "ppo-lag", "sac-lag")
"""Names of algorithms, as `safe_envs.agents.training.hyperparameters` knows them."""


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
    return words((*FILTERS, *plugins.plugin_names(plugins.CONDITIONS)))(incomplete)


policies, algorithms = words(POLICIES), words(ALGORITHMS)


def artefacts(incomplete: str) -> list[str]:
    """Return the tables and figures of the thesis that begin so."""
    return words(("all", *ARTEFACTS))(incomplete)


_NUMBERS = {
    "figure": "3.1 3.2a 3.2b 3.3 4.1 4.2 4.3 5.1 5.2 5.3a 5.3b 5.3c 5.3d 6.1 6.2 6.3 6.4",
    "table": "4.1 5.1 5.2 6.1 6.2 6.3 6.4",
    "example": "4.2.2",
}
ARTEFACTS = tuple(f"{kind}-{n}" for kind, found in _NUMBERS.items() for n in found.split())
"""As `safe_envs.scripts.reproduce.catalogue` has them."""
