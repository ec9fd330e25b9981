"""The parts of a study: a training, and the evaluations of its agent."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import MISSING, asdict, dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, get_type_hints

from safe_envs.agents.evaluation.evaluate import evaluate
from safe_envs.agents.evaluation.spec import UNFILTERED
from safe_envs.agents.jobs.fingerprint import file_checksum, json_checksum
from safe_envs.agents.jobs.store import ResultStore
from safe_envs.agents.policies.names import policy_files
from safe_envs.agents.training.config import Training
from safe_envs.errors import NumericalError, SafeEnvsError
from safe_envs.wrappers.conditions.text_parts import files_of

_LEARNED = "learned"
"""Name of the file in an agent's folder that tells what its training was like, once it is over."""

_DIGITS = 8
"""Of the checksum in the name of an agent's folder."""

_STATISTICS = (
    "episodes",
    "safe",
    "safety_rate",
    "ci_low",
    "ci_high",
    "return_mean",
    "intervention_rate",
    "infeasible_rate",
)


@dataclass(frozen=True)
class StudyRow:
    """The evaluation of one agent of a study.

    Attributes:
        env_id: full id.
        variant: name of the variant.
        k: number of the training, from 0.
        policy: folder of the agent in that of the study, or the name of a policy.
        filter: text of the filter of the evaluation, or "none".
        in_loop: that of the training.
        training_seed: of the training; None without one.
        evaluation_seed: of the evaluation.
        episodes: of the evaluation.
        safe: how many were safe.
        safety_rate: their share.
        ci_low: lower end of its 95 % interval over episodes.
        ci_high: upper end.
        return_mean: mean return of an episode.
        intervention_rate: share of the steps at which the filter changed the action.
        infeasible_rate: share of the steps at which no action met all conditions.
        violations: unsafe steps in the training; None without one.
        seconds: processor time of the learning; None without one.

    Raises:
        TypeError: an attribute is of another type.
    """

    env_id: str
    variant: str
    k: int
    policy: str
    filter: str
    in_loop: str
    training_seed: int | None
    evaluation_seed: int
    episodes: int
    safe: int
    safety_rate: float
    ci_low: float
    ci_high: float
    return_mean: float
    intervention_rate: float | None
    infeasible_rate: float | None
    violations: int | None
    seconds: float | None

    def __post_init__(self) -> None:
        for name, kind in get_type_hints(type(self)).items():
            if not isinstance(getattr(self, name), kind):
                raise TypeError(f"{name} is {getattr(self, name)!r}")


@dataclass(frozen=True)
class Planned:
    """An evaluation of a study, with the training before it.

    Attributes:
        env_id: full id.
        variant: name of the variant.
        k: number of the training.
        training: of the agent; None for a policy that is not trained.
        policy: who acts where nothing is trained.
        filter: text of the filter of the evaluation.
        options: arguments of `gym.make`.
        knowledge: of the filters.
        episodes: of the evaluation.
        seed: of the evaluation.
        versions: of the packages.
        agents: folder of all agents.
    """

    env_id: str
    variant: str
    k: int
    training: Training | None
    policy: str
    filter: str
    options: dict[str, Any]
    knowledge: str
    episodes: int
    seed: int
    versions: dict[str, str]
    agents: Path = Path()

    def in_folder(self, agents: Path) -> Planned:
        """Return the same with the folder of all agents."""
        return replace(self, agents=agents)

    @property
    def in_loop(self) -> str:
        """Text of the filter of the training."""
        return (self.training and self.training.filter) or UNFILTERED

    @cached_property
    def agent(self) -> str:
        """Path of the agent in the folder of all agents, the same for equal trainings."""
        name, training = self.env_id.rpartition("/")[2], self.training
        if training is None:
            return f"{name}/{self.policy}/{self.k}"
        digest = json_checksum({**_told(training), "seed": None})[:_DIGITS]
        return f"{name}/{training.algorithm}-{digest}/seed-{training.seed}"

    @cached_property
    def configuration(self) -> dict[str, Any]:
        """All that the result depends on but for the name of the variant."""
        names = ("filter", "options", "knowledge", "episodes")
        evaluation = {name: getattr(self, name) for name in names}
        evaluation |= _checksums(self.filter, self.policy if self.training is None else None)
        return {
            "env_id": self.env_id,
            "k": self.k,
            "policy": self.policy if self.training is None else None,
            "training": self.training and _told(self.training),
            "evaluation": {**evaluation, "seed": self.seed},
            "versions": self.versions,
        }

    @cached_property
    def key(self) -> str:
        """Name of the file of the result."""
        name = self.env_id.rpartition("/")[2]
        return f"{name}-{self.k}-{json_checksum(self.configuration)[:16]}"


@dataclass(frozen=True)
class StudyJob:
    """A training and the evaluations of its agent; a `safe_envs.agents.jobs.job.Job`.

    Attributes:
        key: of the agent.
        planned: evaluations, which have the training in common.
    """

    key: str
    planned: Sequence[Planned]

    @property
    def work(self) -> int:
        """Steps of the training, at least 1."""
        training = self.planned[0].training
        return 1 if training is None else training.n_timesteps

    def compute(self) -> dict[str, tuple[StudyRow | None, str | None]]:
        """Return the row of each evaluation, or why there is none, by key.

        Raises:
            SafeEnvsError: the training fails.
        """
        first = self.planned[0]
        policy, learned = first.policy, {"violations": None, "seconds": None}
        if first.training is not None:
            folder = first.agents / self.key
            policy, learned = str(folder), _learned(first.training, folder, first.versions)
        found = {}
        for planned in self.planned:
            try:
                found[planned.key] = (_row(planned, policy, learned), None)
            except SafeEnvsError as error:
                found[planned.key] = (None, str(error))
        return found


def _learned(training: Training, folder: Path, versions: dict[str, str]) -> dict[str, Any]:
    """Train an agent unless a folder has it, and return its violations and its time."""
    # Here, so that processes which only read results do not load torch.
    from safe_envs.agents.training.run_folder import (
        CONFIG,
        read_evaluations,
        require_same_versions,
    )
    from safe_envs.agents.training.trainer import train

    require_same_versions(folder, versions)
    store, configuration = ResultStore(folder), {"training": _told(training)}
    document = store.read(_LEARNED, configuration)
    if document is None:
        seconds = train(training, folder, resume=(folder / CONFIG).exists())
        violations = int(read_evaluations(folder)[-1]["training"]["violations"])
        document = {"learned": {"violations": violations, "seconds": seconds}}
        store.keep(_LEARNED, configuration, document)
    return document["learned"]


def _row(planned: Planned, policy: str, learned: dict[str, Any]) -> StudyRow:
    found = evaluate(
        planned.env_id,
        policy,
        (planned.filter,),
        options=planned.options,
        episodes=planned.episodes,
        seed=planned.seed,
        knowledge=planned.knowledge,
        bounds=False,
        best=False,
    )
    training, row = planned.training, found.rows[0]
    if not math.isfinite(row.return_mean):
        raise NumericalError(f"the mean return of the evaluation is {row.return_mean}")
    return StudyRow(
        env_id=planned.env_id,
        variant=planned.variant,
        k=planned.k,
        policy=planned.policy if training is None else f"{planned.agents.name}/{planned.agent}",
        filter=planned.filter,
        in_loop=planned.in_loop,
        training_seed=training and training.seed,
        evaluation_seed=planned.seed,
        **{name: getattr(row, name) for name in _STATISTICS},
        **learned,
    )


def _told(training: Training) -> dict[str, Any]:
    """Return the attributes that are not the defaults, and the checksums of the filter's files.

    A new attribute leaves earlier results valid.
    """
    defaults = {
        each.name: each.default if each.default_factory is MISSING else each.default_factory()
        for each in fields(training)
    }
    told = {k: v for k, v in asdict(training).items() if v != defaults[k]}
    return told | _checksums(training.filter or UNFILTERED)


def _checksums(text: str, policy: str | None = None) -> dict[str, dict[str, str]]:
    """Return the checksums of the files of a filter and a policy, as "files"; {} without files."""
    files = [*files_of(text), *([] if policy is None else policy_files(policy))]
    return {"files": {str(each): file_checksum(each) for each in files}} if files else {}
