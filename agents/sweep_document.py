"""What a sweep's YAML file holds, without what YAML takes in silence: settings given twice, and numbers that are not as they look."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from safe_envs.errors import ConfigurationError

_PLAIN = re.compile(r"[-+]?(0|[1-9][0-9]*)")


class _Loader(yaml.SafeLoader):
    """Of YAML's data, without code."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        """See `yaml.SafeLoader`; refuses a name that stands there twice."""
        seen = set()
        for key, _ in node.value:
            if key.value in seen:
                raise yaml.constructor.ConstructorError(None, None, f"{key.value!r} is given twice", key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)

    def construct_yaml_int(self, node: Any) -> int:
        """See `yaml.SafeLoader`; refuses 010, which YAML takes for 8, 1:30, which it takes for 90, and their kind."""
        if not _PLAIN.fullmatch(node.value):
            raise yaml.constructor.ConstructorError(None, None, f"{node.value} is no plain number", node.start_mark)
        return int(node.value)


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_yaml_int)


def document_in(path: Path) -> Any:
    """What a YAML file holds.

    Raises:
        ConfigurationError: it cannot be read, is no YAML, or holds a name twice or a number in an odd form.
    """
    try:
        with path.open() as file:
            return yaml.load(file, _Loader)
    except OSError as error:
        raise ConfigurationError(f"{path} cannot be read: {error.strerror}; name a YAML file that says what to sweep") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"{path} is no YAML that says what to sweep: {error}") from error
