"""Studies: variants of training and of filters, on several envs, over seeds.

Training k of an env has a seed of its own, whose randomness is independent of that of every other
training and env. It is common to all variants, and so are its evaluation episodes: variants are
compared on the same starts and noise. Each training has other episodes, so that these average out
too.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from safe_envs.agents.evaluation.resolved import ResolvedEvaluation
from safe_envs.agents.evaluation.spec import UNFILTERED, EvaluationSpec
from safe_envs.agents.jobs.executor import Backend, run
from safe_envs.agents.jobs.fingerprint import package_versions
from safe_envs.agents.jobs.job import JobOutcome
from safe_envs.agents.jobs.store import ResultStore, reading
from safe_envs.agents.training.config import Training
from safe_envs.agents.training.study_job import Planned, StudyJob, StudyRow
from safe_envs.errors import ConfigurationError, SafeEnvsError, require_whole
from safe_envs.file_locks import locked
from safe_envs.registry import full_id, make_problem
from safe_envs.wrappers.conditions.text_parts import names_promise
from safe_envs.wrappers.value.reduction import reduced

DEFAULT = "default"
"""The filter of the env, wherever a variant names a filter."""

_RESULTS, _AGENTS, _LOCK = "results", "agents", ".lock"
_EVALUATION = 1
"""Key of the seeds of evaluations; those of trainings have 0."""


@dataclass(frozen=True)
class Variant:
    """One way to train and to filter.

    Attributes:
        name: unique in a study.
        algorithm: of the training; None for a policy that is not trained.
        policy: who acts where nothing is trained.
        training: further arguments of `Training.of`; `filter` is the filter in the loop.
        filter: text of the filter of the evaluation.
    """

    name: str
    algorithm: str | None = None
    policy: str = "nominal"
    training: Mapping[str, Any] = field(default_factory=dict)
    filter: str = UNFILTERED


@dataclass(frozen=True)
class Study:
    """All that determines the results of a study.

    Attributes:
        env_ids: full ids.
        variants: to compare.
        seeds: number of trainings of each variant on each env.
        seed: from which all seeds are derived.
        episodes: of the evaluation of each agent.
        knowledge: of all filters, "model" or "plant".
        training: arguments of `Training.of` for all trainings; a variant's own come first.
        options: arguments of `gym.make` for all envs.

    Raises:
        ConfigurationError: a number is out of range, or two variants have one name.
    """

    env_ids: Sequence[str]
    variants: Sequence[Variant]
    seeds: int = 5
    seed: int = 0
    episodes: int = 1000
    knowledge: str = "plant"
    training: Mapping[str, Any] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, least in (("seeds", 1), ("seed", 0), ("episodes", 1)):
            require_whole(name, getattr(self, name), least)
        names = [variant.name for variant in self.variants]
        if len(set(names)) < len(names):
            raise ConfigurationError(f"two variants of {names} have one name; give each its own")
        ids = tuple(dict.fromkeys(full_id(env_id) for env_id in self.env_ids))
        object.__setattr__(self, "env_ids", ids)


@dataclass(frozen=True)
class StudyResult:
    """What a study found.

    Attributes:
        study: what was asked for.
        rows: of all agents, in the order of the envs, of the variants, and of the seeds.
        missing: why there is no row, by env, variant and number of the seed; the number is None
            where the variant does not suit the env.
    """

    study: Study
    rows: Sequence[StudyRow]
    missing: Mapping[tuple[str, str, int | None], str]

    def of(self, env_id: str, variant: str) -> list[StudyRow]:
        """Return the rows of a variant on an env, in the order of their seeds.

        Args:
            env_id: full id.
            variant: its name.
        """
        return [r for r in self.rows if (r.env_id, r.variant) == (env_id, variant)]

    def reasons(self) -> list[dict[str, Any]]:
        """Return what is missing, and why, as JSON-able data."""
        return [
            {"env_id": env_id, "variant": variant, "k": k, "reason": reason}
            for (env_id, variant, k), reason in self.missing.items()
        ]

    def require_all(self) -> None:
        """Raise ConfigurationError if an evaluation failed, or the training before it."""
        failed = [(*key, reason) for key, reason in self.missing.items() if key[2] is not None]
        if failed:
            env_id, variant, k, reason = failed[0]
            count = f"{len(failed)} evaluation{'s' if len(failed) > 1 else ''}"
            raise ConfigurationError(
                f"{count} failed, without which the tables are; {env_id}, {variant}, training {k}:"
                f" {reason}"
            )


def training_seed(seed: int, env_id: str, k: int) -> int:
    """Return the seed of training k of an env.

    Args:
        seed: of the study.
        env_id: full id.
        k: number of the training.
    """
    return _child(seed, env_id, k, 0)


def evaluation_seed(seed: int, env_id: str, k: int) -> int:
    """Return the seed of the evaluation of training k of an env; see `training_seed`."""
    return _child(seed, env_id, k, _EVALUATION)


def run_study(
    study: Study,
    out: Path,
    backend: Backend | None = None,
    progress: Callable[[float], None] = lambda _: None,
    report: Callable[[str], None] = lambda _: None,
) -> StudyResult:
    """Train and evaluate whatever a previous run has not kept.

    A finished agent is kept with everything that it depends on, and is not computed again. One
    whose training was interrupted goes on after its last checkpoint.

    Args:
        study: what to do.
        out: folder of the agents and of the results; it may hold those of other studies.
        backend: where; by default two processes of this machine.
        progress: receives the part of the work that is done, from 0 to 1.
        report: receives what the user should know meanwhile.

    Returns:
        The rows of all agents, and what is missing.

    Raises:
        ConfigurationError: the folder cannot be written, has files that are damaged, or another
            study writes to it.
    """
    missing: dict[tuple[str, str, int | None], str] = {}
    # Before a folder is made: the arguments may be refused.
    planned = list(_plans(study, out, missing))
    store = ResultStore(out / _RESULTS)
    with locked(
        out / _LOCK,
        f"another study is writing to {out} just now; wait until it has ended, or give another"
        " --out",
    ):
        store.remove_unfinished()
        kept = {each.key: row for each in planned if (row := _kept(store, each)) is not None}
        jobs = _jobs([each for each in planned if each.key not in kept])
        work = {key: job.work for key, job in jobs.items()}
        done, total = 0, max(sum(work.values()), 1)

        def keep(outcome: JobOutcome) -> None:
            nonlocal done
            for each in jobs[outcome.key].planned:
                row, error = (outcome.result or {}).get(each.key, (None, outcome.error))
                if row is None:
                    missing[each.env_id, each.variant, each.k] = str(error)
                else:
                    store.keep(each.key, each.configuration, {"row": asdict(row)})
                    kept[each.key] = row
            done += work[outcome.key]
            progress(done / total)

        run(jobs.values(), backend or Backend(), keep, report)
    found = [replace(kept[each.key], variant=each.variant) for each in planned if each.key in kept]
    return StudyResult(study, found, missing)


def _plans(
    study: Study, out: Path, missing: dict[tuple[str, str, int | None], str]
) -> Iterator[Planned]:
    """Yield what is to be evaluated; tell why a variant does not suit an env."""
    for env_id in study.env_ids:
        default = make_problem(env_id, **study.options).filter
        for variant in study.variants:
            seeds = range(study.seeds)
            of_seeds = [_planned(study, env_id, variant, k, default) for k in seeds]
            try:
                for name in {of_seeds[0].filter, of_seeds[0].in_loop}:
                    _require_suitable(study, env_id, name, variant)
            except SafeEnvsError as error:
                missing[env_id, variant.name, None] = str(error)
                continue
            yield from (each.in_folder(out / _AGENTS) for each in of_seeds)


def _planned(study: Study, env_id: str, variant: Variant, k: int, default: str) -> Planned:
    given = {**study.training, **variant.training}
    given["filter"] = _named(given.get("filter", UNFILTERED), default)
    training = None
    if variant.algorithm is not None:
        training = Training.of(
            env_id,
            variant.algorithm,
            knowledge=study.knowledge,
            seed=training_seed(study.seed, env_id, k),
            options=study.options,
            **given,
        )
    return Planned(
        env_id=env_id,
        variant=variant.name,
        k=k,
        training=training,
        policy=variant.policy,
        filter=_named(variant.filter, default),
        options=dict(study.options),
        knowledge=study.knowledge,
        episodes=study.episodes,
        seed=evaluation_seed(study.seed, env_id, k),
        versions=package_versions(),
    )


def _named(text: str | None, default: str) -> str:
    return default if text == DEFAULT else text or UNFILTERED


def _require_suitable(study: Study, env_id: str, name: str, variant: Variant) -> None:
    """Raise a SafeEnvsError if an env has no such filter or policy, before agents are trained."""
    spec = EvaluationSpec(
        env_id,
        variant.policy if variant.algorithm is None else "nominal",
        (name,),
        options=study.options,
        knowledge=study.knowledge,
    )
    found = ResolvedEvaluation(spec)
    if names_promise(name):
        reduced(found.problem, study.knowledge)


def _kept(store: ResultStore, planned: Planned) -> StudyRow | None:
    document = store.read(planned.key, planned.configuration)
    if document is None:
        return None
    with reading(store.path(planned.key)):
        return StudyRow(**document["row"])


def _jobs(planned: Sequence[Planned]) -> dict[str, StudyJob]:
    """Return a job for each agent, the longest first: the last ones then end together."""
    of_agents: dict[str, list[Planned]] = {}
    for each in planned:
        of_agents.setdefault(each.agent, []).append(each)
    jobs = [StudyJob(agent, tuple(each)) for agent, each in of_agents.items()]
    return {job.key: job for job in sorted(jobs, key=lambda job: -job.work)}


def _child(seed: int, env_id: str, *key: int) -> int:
    child = np.random.SeedSequence(seed, spawn_key=(zlib.crc32(env_id.encode()), *key))
    return int(child.generate_state(1)[0])
