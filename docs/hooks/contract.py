"""The page of the info contract, from the docstring of `safe_envs.envs.info`."""

from __future__ import annotations

import inspect

from safe_envs.envs import info


def info_page() -> str:
    """Return Markdown: a title, and the docstring."""
    return f"# The info contract\n\n{inspect.getdoc(info)}\n"
