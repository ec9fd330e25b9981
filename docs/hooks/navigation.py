"""The navigation: that of mkdocs.yml, with a page for each env and each condition."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from safe_envs import ENV_IDS
from safe_envs.wrappers import CONDITIONS, LEARNED


def short_name(env_id: str) -> str:
    """Return the name of an env without its namespace and version."""
    return env_id.removeprefix("safe_envs/").removesuffix("-v0")


def complete(nav: Sequence[dict[str, Any]]) -> None:
    """Add the pages of envs and conditions to their sections of the navigation."""
    for section in nav:
        section.get("Environments", []).extend(
            f"envs/{short_name(env_id)}.md" for env_id in ENV_IDS
        )
        section.get("Filters", []).extend(f"filters/{name}.md" for name in (*CONDITIONS, *LEARNED))
