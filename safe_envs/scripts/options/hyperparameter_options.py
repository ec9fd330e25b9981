"""Hyperparameters of a training as `--set NAME=VALUE`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from safe_envs.errors import ConfigurationError, shortened
from safe_envs.text import real


def read_hyperparameters(texts: Sequence[str]) -> dict[str, Any]:
    """Return the values of NAME=VALUE entries, which are YAML, by name.

    Raises:
        ConfigurationError: an entry has another form, or its value is no YAML.
    """
    import yaml

    from safe_envs.agents.sweeps.spec import value_of

    found = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not name:
            raise ConfigurationError(
                f"--set {shortened(text)}: give NAME=VALUE, such as learning_rate=0.001"
            )
        if not value.isascii():
            raise ConfigurationError(
                f"--set {shortened(text)} has characters beyond ASCII; write numbers with the"
                " digits 0 to 9"
            )
        try:
            found[name] = _number(value_of(value, "--set"))
        except yaml.YAMLError as error:
            problem = shortened(getattr(error, "problem", error))
            raise ConfigurationError(
                f"--set {shortened(text)} is no YAML that a setting may have: {problem}"
            ) from error
    return found


def _number(value: Any) -> Any:
    """Return a value, as a number also where YAML reads it as a text, such as 3e-4."""
    try:
        return real(value) if isinstance(value, str) else value
    except ValueError:
        return value
