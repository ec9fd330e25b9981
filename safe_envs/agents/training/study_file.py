"""Studies as files: which agents to train, and with which filters to evaluate them.

    episodes: 500
    variants:
      - name: PPO, default filter, penalty 0.1
        algorithm: ppo
        training: {filter: default, intervention_penalty: 0.1, n_timesteps: 40960}
        filters: [default, none]

`training` has the arguments of `Training.of`, whose `settings` are hyperparameters in place of the
file's. "default" stands for the filter of the env, "none" for no filter. Without an algorithm
`policy` acts, such as "nominal". Whatever else a study has, the command gives.

A file may be a stranger's: it runs no code, and names no policy or condition of a Python file or
module.
"""

from __future__ import annotations

import inspect
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

from safe_envs.agents.evaluation.spec import UNFILTERED
from safe_envs.agents.policies.names import is_place
from safe_envs.agents.training.config import Training
from safe_envs.agents.training.hyperparameters import ALGORITHMS
from safe_envs.agents.training.study import Variant
from safe_envs.bounded_reading import read_bytes
from safe_envs.errors import (
    ConfigurationError,
    SafeEnvsError,
    nearest,
    require_whole,
    shortened,
    shown,
)
from safe_envs.wrappers.conditions.text_parts import parts_of

_SHIPPED = "studies"
_MOST_BYTES = 100_000
_MOST_VALUES = 10_000
_LONGEST_NAME = 80
_EPISODES = 1000
_NAMES = ("episodes", "variants")
_OF_VARIANT = ("name", "algorithm", "policy", "training", "filters")
_OF_STUDY = ("env_id", "algorithm", "seed", "knowledge", "options")
"""Attributes of trainings that the study gives."""


@dataclass(frozen=True)
class Agent:
    """Agents of a study that are trained alike, and the filters that they are evaluated with.

    Attributes:
        name: unique in the study.
        variants: one for each filter, by its text.
    """

    name: str
    variants: Mapping[str, Variant]


@dataclass(frozen=True)
class StudyFile:
    """What a file says of a study.

    Attributes:
        agents: to compare.
        episodes: of each evaluation.
    """

    agents: Sequence[Agent]
    episodes: int

    @property
    def variants(self) -> list[Variant]:
        """All variants, in the order of the file."""
        return [variant for agent in self.agents for variant in agent.variants.values()]

    def shortened(self, training: Mapping[str, Any]) -> list[Variant]:
        """Return all variants, with other arguments of their trainings.

        Args:
            training: in place of the file's.
        """
        return [
            replace(each, training={**each.training, **training} if each.algorithm else {})
            for each in self.variants
        ]

    def require_agent(self, name: str) -> None:
        """Raise ConfigurationError where there are no agents of a name."""
        names = [agent.name for agent in self.agents]
        if name not in names:
            raise ConfigurationError(
                f"no agents {shown(name)} in the study; {nearest(name, names)}"
            )


def shipped_studies() -> list[str]:
    """Return the names of the studies that come with the package."""
    folder = files("safe_envs.agents.training").joinpath(_SHIPPED)
    return sorted(Path(each.name).stem for each in folder.iterdir() if each.name.endswith(".yml"))


def read_study(given: str) -> StudyFile:
    """Read a study that comes with the package, or a file of one's own.

    Args:
        given: its name, or the path of a YAML file.

    Raises:
        ConfigurationError: there is none, or it says something else than a study.
    """
    known = shipped_studies()
    if given in known:
        path = Path(str(files("safe_envs.agents.training").joinpath(_SHIPPED, f"{given}.yml")))
    elif Path(given).is_file():
        path = Path(given)
    else:
        raise ConfigurationError(
            f"study {shown(given)} is neither a file nor one of this package;"
            f" {nearest(given, known)}"
        )
    return _study(_parsed(path), given)


def _parsed(path: Path) -> Any:
    import yaml

    try:
        loader = yaml.SafeLoader(read_bytes(path, _MOST_BYTES))
        try:
            node = loader.get_single_node()
            _require_few(node, path)
            return None if node is None else loader.construct_document(node)
        finally:
            loader.dispose()
    except SafeEnvsError:
        raise
    except Exception as error:  # values such as 2026-13-45 and !!int x raise errors of any type
        raise ConfigurationError(
            f"study {shortened(path)} is no YAML file: {str(error)[:300]}"
        ) from error


def _require_few(document: Any, path: Path) -> None:
    """Check the nodes of a YAML file, before any value is made of them.

    Aliases and merges ("<<") make a short file a very large study.

    Raises:
        ConfigurationError: there are too many values, or a mapping has a name twice, of which only
            the last value would count.
    """
    count, nodes = 1, [document] if document is not None else []
    while nodes:
        node = nodes.pop()
        children = node.value
        if isinstance(children, str):
            continue
        pairs = [each for each in children if isinstance(each, tuple)]
        names = Counter((name.tag, name.value) for name, _ in pairs if isinstance(name.value, str))
        for (_, name), times in names.items():
            if times > 1:
                raise ConfigurationError(
                    f"study {shortened(path)} has the name {shown(name)} twice in a mapping (line"
                    f" {node.start_mark.line + 1}); give it once"
                )
        # A name may hold values too.
        values = [each for pair in pairs for each in pair] or children
        # Before they are added: a list may be a part of itself.
        count += len(values)
        if count > _MOST_VALUES:
            raise ConfigurationError(
                f"study {shortened(path)} has more than {_MOST_VALUES} values; give a smaller one"
            )
        nodes += values


def _study(document: Any, where: str) -> StudyFile:
    _require_names(document, _NAMES, f"study {where}")
    entries, episodes = document.get("variants"), document.get("episodes", _EPISODES)
    if not isinstance(entries, list) or not entries:
        raise ConfigurationError(f"study {where} has no list of variants; give at least one")
    require_whole("episodes", episodes, 1)
    agents = [_agent(entry, f"study {where}, variant {k}") for k, entry in enumerate(entries, 1)]
    names = [agent.name for agent in agents]
    if len(set(names)) < len(names):
        raise ConfigurationError(f"study {where}: two variants of {names} have one name")
    return StudyFile(agents, int(episodes))


def _agent(entry: Any, where: str) -> Agent:
    _require_names(entry, _OF_VARIANT, where)
    name, algorithm = entry.get("name"), entry.get("algorithm")
    if not isinstance(name, str) or not _is_name(name):
        raise ConfigurationError(
            f"{where}: name = {shown(name)}; give a text of at most {_LONGEST_NAME} printable"
            ' characters without "|"'
        )
    if algorithm is not None and algorithm not in ALGORITHMS:
        raise ConfigurationError(
            f"{where}: algorithm = {shown(algorithm)}; {nearest(str(algorithm), ALGORITHMS)}"
        )
    policy, training = entry.get("policy", "nominal"), entry.get("training", {})
    if not isinstance(policy, str):
        raise ConfigurationError(f"{where}: policy = {shown(policy)}; give a text")
    if is_place(policy):
        raise _code(where, policy, "policy")
    if training and algorithm is None:
        raise ConfigurationError(f"{where} has a training and no algorithm; give one, like ppo")
    own = [each.name for each in fields(Training)] + list(inspect.signature(Training.of).parameters)
    allowed = [each for each in own if each not in (*_OF_STUDY, "hyperparameters", "attributes")]
    _require_names(training, allowed, f"{where}: training")
    _require_mapping(training.get("settings") or {}, f"{where}: settings")
    filters = entry.get("filters", [UNFILTERED])
    if not isinstance(filters, list) or not filters or not all(isinstance(f, str) for f in filters):
        raise ConfigurationError(
            f"{where}: filters = {shown(filters)}; give a list of texts, like [default, none]"
        )
    for text in (*filters, training.get("filter") or UNFILTERED):
        if not isinstance(text, str):
            raise ConfigurationError(f"{where}: filter = {shown(text)}; give a text, like default")
        if any(":" in part.name for part in parts_of(text)):
            raise _code(where, text, "filter")
    variants = {
        text: Variant(f"{name} | {text}", algorithm, policy, training, text) for text in filters
    }
    return Agent(name, variants)


def _is_name(text: str) -> bool:
    return text.isprintable() and 0 < len(text.strip()) <= _LONGEST_NAME and "|" not in text


def _code(where: str, text: str, what: str) -> ConfigurationError:
    return ConfigurationError(
        f"{where}: the {what} {shown(text)} would run code, and the file of a study runs none; give"
        " one by its name, or call safe_envs.agents.training.study.run_study from Python"
    )


def _require_mapping(given: Any, where: str) -> None:
    if not isinstance(given, Mapping):
        raise ConfigurationError(f"{where} is {shown(given)}; give names with values")


def _require_names(given: Any, allowed: Sequence[str], where: str) -> None:
    _require_mapping(given, where)
    for name in given:
        if name not in allowed:
            raise ConfigurationError(
                f"{where} has an unknown name {shown(name)}; {nearest(str(name), allowed)}"
            )
