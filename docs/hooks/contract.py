"""The page of the info contract, from the docstring of `safe_envs.envs.info` and what an env
reports."""

from __future__ import annotations

import inspect

from safe_envs.envs import info


def info_page() -> str:
    """Markdown: the docstring, whose first line is the title's subtitle."""
    return f"# The info contract\n\n{inspect.getdoc(info)}\n"
