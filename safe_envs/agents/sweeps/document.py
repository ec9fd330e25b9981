"""Strict YAML: no settings given twice, no numbers in misleading forms, no aliases and tags."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any, ClassVar

import yaml
from yaml.composer import ComposerError
from yaml.constructor import ConstructorError

from safe_envs.bounded_reading import read_bytes
from safe_envs.errors import ConfigurationError, shortened
from safe_envs.number_text import whole_or_real

_MOST_BYTES = 65_000
"""Of a file: what this Python reads of YAML in a second."""

_DEEPEST = 10
_PLAIN = re.compile(r"[-+]?(0|[1-9][0-9]*)|[-+]?[0-9]*\.[0-9]*([eE][-+]?[0-9]+)?", re.ASCII)
_DATE = "tag:yaml.org,2002:timestamp"


class _Loader(yaml.SafeLoader):
    """A loader without aliases and tags: nested aliases stand for more than memory holds."""

    # No setting takes a date, and some texts look like one.
    yaml_implicit_resolvers: ClassVar[Any] = {
        first: [(tag, form) for tag, form in found if tag != _DATE]
        for first, found in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }
    depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Compose a node; refuse aliases, tags, and what is nested deeper than any sweep."""
        event: Any = self.peek_event()
        what = (
            "an alias"
            if isinstance(event, yaml.AliasEvent)
            else "a tag"
            if event.tag is not None
            else ""
        )
        if what or self.depth > _DEEPEST:
            problem = (
                f"{what} is not allowed; write the value itself"
                if what
                else f"it is nested more than {_DEEPEST} deep"
            )
            raise ComposerError(None, None, problem, event.start_mark)
        self.depth += 1
        try:
            return super().compose_node(parent, index)
        finally:
            self.depth -= 1

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        """Construct a mapping; refuse a name that is given twice, and one that is no word."""
        seen = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise ConstructorError(
                    None, None, "a name is a list or a mapping; give a word", key.start_mark
                )
            if key.value in seen:
                raise ConstructorError(None, None, f"{key.value!r} is given twice", key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)

    def construct_number(self, node: Any) -> int | float:
        """Construct a decimal number; refuse 010 (8 in YAML), 1:30 (90) and 1_000."""
        if not _PLAIN.fullmatch(node.value):
            raise ConstructorError(None, None, f"{node.value} is no plain number", node.start_mark)
        return whole_or_real(node.value)


for kind in ("int", "float"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{kind}", _Loader.construct_number)


def document_in(path: Path) -> Any:
    """Return the content of a YAML file.

    Raises:
        ConfigurationError: it cannot be read, is no YAML, or holds a name twice or a number in a
            misleading form.
    """
    try:
        return value_of(read_bytes(path, _MOST_BYTES).decode(), str(path))
    except OSError as error:
        raise ConfigurationError(
            f"{shortened(path)} cannot be read: {error.strerror}; name a YAML file that says what"
            " to sweep"
        ) from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigurationError(
            f"{path} is no YAML that says what to sweep: {shortened(error, 400)}"
        ) from error


def value_of(text: str, name: str) -> Any:
    """Return the value of a text in YAML.

    Args:
        text: in YAML.
        name: where it comes from, for the message.

    Raises:
        YAMLError: it is no YAML, or holds a name twice or a number in a misleading form.
    """
    if len(text) > _MOST_BYTES:
        raise yaml.YAMLError(f"it has {len(text)} characters, more than {_MOST_BYTES}")
    loader = _Loader(io.StringIO(text))
    loader.name = name
    try:
        return loader.get_single_data()
    finally:
        loader.dispose()
