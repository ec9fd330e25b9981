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
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

from safe_envs.agents.evaluation.spec import UNFILTERED
from safe_envs.agents.training.config import Training
from safe_envs.agents.training.hyperparameters import ALGORITHMS
from safe_envs.agents.training.study import Variant
from safe_envs.bounded_reading import read_bytes
from safe_envs.errors import ConfigurationError, nearest, require_whole, shortened, shown

_SHIPPED = "studies"
_MOST_BYTES = 100_000
_MOST_VALUES = 10_000
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
        document = yaml.safe_load(read_bytes(path, _MOST_BYTES))
        _require_few([document], path)
        return document
    except (OSError, yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigurationError(
            f"study {shortened(path)} is no YAML file: {str(error)[:300]}"
        ) from error


def _require_few(values: list[Any], path: Path) -> None:
    """Raise ConfigurationError where aliases make a short file a very large study."""
    count = 0
    while values:
        value, count = values.pop(), count + 1
        if count > _MOST_VALUES:
            raise ConfigurationError(
                f"study {shortened(path)} has more than {_MOST_VALUES} values; give a smaller one"
            )
        if isinstance(value, Mapping):
            values += value.values()
        elif isinstance(value, list):
            values += value


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
    if not isinstance(name, str) or not name.strip():
        raise ConfigurationError(f"{where}: name = {shown(name)}; give a text")
    if algorithm is not None and algorithm not in ALGORITHMS:
        raise ConfigurationError(
            f"{where}: algorithm = {shown(algorithm)}; {nearest(str(algorithm), ALGORITHMS)}"
        )
    policy, training = entry.get("policy", "nominal"), entry.get("training", {})
    if not isinstance(policy, str):
        raise ConfigurationError(f"{where}: policy = {shown(policy)}; give a text")
    if training and algorithm is None:
        raise ConfigurationError(f"{where} has a training and no algorithm; give one, like ppo")
    own = [each.name for each in fields(Training)] + list(inspect.signature(Training.of).parameters)
    allowed = [each for each in own if each not in (*_OF_STUDY, "hyperparameters", "attributes")]
    _require_names(training, allowed, f"{where}: training")
    filters = entry.get("filters", [UNFILTERED])
    if not isinstance(filters, list) or not filters or not all(isinstance(f, str) for f in filters):
        raise ConfigurationError(
            f"{where}: filters = {shown(filters)}; give a list of texts, like [default, none]"
        )
    variants = {
        text: Variant(f"{name} | {text}", algorithm, policy, training, text) for text in filters
    }
    return Agent(name, variants)


def _require_names(given: Any, allowed: Sequence[str], where: str) -> None:
    if not isinstance(given, Mapping):
        raise ConfigurationError(f"{where} is {shown(given)}; give names with values")
    for name in given:
        if name not in allowed:
            raise ConfigurationError(
                f"{where} has an unknown name {shown(name)}; {nearest(str(name), allowed)}"
            )
