"""The cells of a sweep: evaluations of one policy under one filter, and what identifies them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from safe_envs.agents.evaluation.evaluate import run_evaluation
from safe_envs.agents.evaluation.spec import EvaluationSpec, RunSettings
from safe_envs.agents.evaluation.yardstick import best_document
from safe_envs.agents.jobs.fingerprint import (
    file_checksum,
    json_checksum,
    package_versions,
    source_checksum,
)
from safe_envs.agents.sweeps.settings import ENV_OPTIONS, EVALUATION_DEFAULTS
from safe_envs.errors import ConfigurationError
from safe_envs.problem.options import PARAMETER_GROUPS
from safe_envs.registry import which_env


@dataclass(frozen=True)
class Cell:
    """One evaluation of a sweep; a `safe_envs.agents.jobs.job.Job`.

    Attributes:
        settings: value of every setting that is not the env's default, by name; paths are absolute.
        files: SHA-256 of each file that it reads, by path.
        versions: versions by which it is to be computed; see `versions`.
        trust: load a policy's .zip, which runs code that it contains.
        engine: what simulates; see `RunSettings`. It is no part of the configuration: results of
            the engines differ by rounding.
    """

    settings: Mapping[str, Any]
    files: Mapping[str, str] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    trust: bool = False
    engine: str = "auto"

    @property
    def configuration(self) -> dict[str, Any]:
        """Everything that the result depends on."""
        parts = {"settings": self.settings, "files": self.files, "versions": self.versions}
        return {name: dict(part) for name, part in parts.items()}

    @property
    def key(self) -> str:
        """Checksum of the configuration, 32 hexadecimal digits."""
        return json_checksum(list(self.configuration.values()))[:32]

    @property
    def env_id(self) -> str:
        """Id of the env that it simulates, or under which custom systems are registered.

        Raises:
            ConfigurationError: there is no such id, or neither or both of env and system are given.
        """
        return which_env(self.settings.get("env"), self.settings.get("system"))

    @property
    def options(self) -> dict[str, Any]:
        """The arguments of `gym.make`."""
        options = {name: self.settings[name] for name in ENV_OPTIONS if name in self.settings}
        for name, value in self.settings.items():
            group, dot, parameter = name.partition(".")
            if dot and group in PARAMETER_GROUPS:
                options.setdefault(group, {})[parameter] = value
        return options

    @property
    def spec(self) -> EvaluationSpec:
        """What to evaluate.

        Raises:
            ConfigurationError: a value is out of range.
        """
        return EvaluationSpec(
            self.env_id,
            filters=(self.settings["filter"],),
            options=self.options,
            trust=self.trust,
            **{name: self.settings[name] for name in EVALUATION_DEFAULTS},
        )

    def compute(self) -> dict[str, Any]:
        """Return the "row", "config" and "best" of the evaluation, in any process of this project.

        Raises:
            ConfigurationError: this process has other versions or other files than the one that
                wrote the cell.
            SafeEnvsError: the evaluation fails.
        """
        self._require_same_code()
        found = run_evaluation(self.spec, RunSettings(engine=self.engine))
        best = best_document(found.best, found.rows)
        return {"row": found.rows[0].as_dict(), "config": found.config, "best": best}

    def _require_same_code(self) -> None:
        here = versions()
        differing = [
            f"{name} {here.get(name, 'missing')} in place of {value}"
            for name, value in self.versions.items()
            if here.get(name) != value
        ]
        if differing:
            raise ConfigurationError(
                f"the worker has {', '.join(differing)}; install the same versions on all machines"
            )
        for path, digest in self.files.items():
            if file_checksum(Path(path)) != digest:
                raise ConfigurationError(
                    f"the worker finds another content in {path}; put all files of a sweep on a"
                    " disk that workers share"
                )


@dataclass(frozen=True)
class Sweep:
    """Cells, in the order of their file.

    Attributes:
        cells: each once.
        swept: names of the settings that are not the same in all of them.
    """

    cells: tuple[Cell, ...]
    swept: tuple[str, ...]


@cache
def versions() -> dict[str, str]:
    """Return the versions on which cells depend, with a checksum of this project's own code."""
    return {**package_versions(), "source": source_checksum(scripts=False)[:16]}
