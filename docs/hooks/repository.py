"""A hook of mkdocs: links to the repository, where `[project.urls]` of pyproject.toml names one."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

_PLACE = "<!-- link to the repository -->"
_PYPROJECT = Path(__file__).resolve().parents[2] / "pyproject.toml"


def repository_url(pyproject: Path = _PYPROJECT) -> str | None:
    """Return the URL that a pyproject.toml calls its repository; None if it names none."""
    urls = tomllib.loads(pyproject.read_text()).get("project", {}).get("urls", {})
    named = {name.lower(): url for name, url in urls.items()}
    return next((named[key] for key in ("repository", "source", "homepage") if key in named), None)


def on_config(config: Any) -> Any:
    """Let the theme link to the repository."""
    config.repo_url = config.repo_url or repository_url()
    return config


def on_page_markdown(markdown: str, config: Any, **_: Any) -> str:
    """Insert the link where a page asks for one."""
    link = f"[Repository]({config.repo_url}){{ .md-button }}" if config.repo_url else ""
    return markdown.replace(_PLACE, link)
