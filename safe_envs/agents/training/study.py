"""Studies: variants of training and of filters, on several envs, over seeds.

Training k of an env has a seed of its own, whose randomness is independent of that of every other
training and env. It is common to all variants, and so are its evaluation episodes: variants are
compared on the same starts and noise. Each training has other episodes, so that these average out
too.

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

The interquartile mean leaves out the int(n/4) smallest and as many of the largest of n values, as
`rliable` does: of five seeds the middle three count, of fewer than four all.

The interval is the percentile interval of the bootstrap, with seeds drawn with replacement within
each env (the stratum). For one env of up to `_MOST_EXACT` seeds the distribution is enumerated: the
n^n draws are (2 n - 1 over n) multisets of multinomial weight, 126 for five seeds. For more it is
sampled. Such an interval of few seeds is too short; see `docs/guides/leaderboard.md` for how often
it holds.

Source: R. Agarwal, M. Schwarzer, P. S. Castro, A. Courville, M. G. Bellemare, Deep reinforcement
learning at the edge of the statistical precipice, NeurIPS 2021, section 4 and appendix A.
"""

from __future__ import annotations

import inspect
import math
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, asdict, dataclass, field, fields, replace
from functools import cache, cached_property
from importlib.resources import files
from itertools import combinations_with_replacement
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np

from safe_envs.agents.evaluation.evaluate import evaluate
from safe_envs.agents.evaluation.resolve import ResolvedEvaluation
from safe_envs.agents.evaluation.spec import UNFILTERED, EvaluationSpec
from safe_envs.agents.evaluation.statistics import require_confidence
from safe_envs.agents.jobs.executor import Backend, run
from safe_envs.agents.jobs.job import JobOutcome
from safe_envs.agents.jobs.store import (
    ResultStore,
    file_checksum,
    json_checksum,
    package_versions,
    reading,
)
from safe_envs.agents.policies.names import is_place, policy_files
from safe_envs.agents.training.config import Training
from safe_envs.agents.training.hyperparameters import ALGORITHMS
from safe_envs.errors import (
    ConfigurationError,
    NumericalError,
    SafeEnvsError,
    nearest,
    require_whole,
    shortened,
    shown,
)
from safe_envs.files import locked, read_bytes
from safe_envs.filters.conditions.syntax import files_of, names_promise, parts_of
from safe_envs.registry import full_id, make_problem
from safe_envs.values.reduction import reduced

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
    from safe_envs.agents.training.checkpoints import (
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
    """Return the attributes that are not the defaults, and the checksums of the filter's files."""
    # So a new attribute leaves earlier results valid.
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
            yield from (replace(each, agents=out / _AGENTS) for each in of_seeds)


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
    """Refuse the nodes of a YAML file with too many values, or with a name twice in a mapping."""
    # Before any value is made of them: aliases and merges make a short file a very large study.
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


_MOST_EXACT = 8
"""Seeds of one env up to which all draws are enumerated: 6435 multisets."""

_RESAMPLES = 20_000
_HOLDS = {2: 50, 3: 75, 4: 88, 5: 91}
"""In how many per cent of the cases the 95 % interval of so many normal values holds their mean."""

_CUT = 4
"""The part of the values that is left out at each end is one in so many."""


def caution(seeds: int) -> str:
    """Return what intervals over few seeds are worth, as a sentence; "" for many.

    Args:
        seeds: their number.
    """
    if seeds == 1:
        return "One seed tells nothing of others: its interval has no length."
    if seeds not in _HOLDS:
        return ""
    return (
        f"Where trainings scatter normally, the interval over {seeds} seeds holds the true value in"
        f" {_HOLDS[seeds]} % of the cases, not in 95 %; where all seeds agree it has no length."
    )


@dataclass(frozen=True)
class SeedEstimate:
    """An interquartile mean with its interval over seeds.

    Attributes:
        value: the interquartile mean.
        low: lower end of the interval.
        high: upper end.
        seeds: number of values.
    """

    value: float
    low: float
    high: float
    seeds: int


def interquartile_mean(values: np.ndarray) -> np.ndarray:
    """Return the mean of the values between the quartiles; see the module.

    Args:
        values: shape (..., n), in any order.

    Returns:
        Shape (...).
    """
    count = values.shape[-1]
    cut = count // _CUT
    return np.sort(values, axis=-1)[..., cut : count - cut].mean(axis=-1)


def over_seeds(
    strata: Sequence[Sequence[float]], confidence: float = 0.95, seed: int = 0
) -> SeedEstimate:
    """Return the interquartile mean of all values, with its stratified bootstrap interval.

    Args:
        strata: values of the seeds of each env, at least one.
        confidence: of the two-sided interval.
        seed: of the draws, where they are not enumerated.

    Raises:
        ConfigurationError: there is no value, one is not finite, or the confidence is out of range.
    """
    require_confidence(confidence)
    found = [np.asarray(each, dtype=np.float64) for each in strata]
    if not found or not all(each.size and np.isfinite(each).all() for each in found):
        raise ConfigurationError(
            f"the values of the seeds are {[each.tolist() for each in found]}; give at least one"
            " number for each env, none of them infinite"
        )
    exact = len(found) == 1 and found[0].size <= _MOST_EXACT
    means, weights = _enumerated(found[0]) if exact else _sampled(found, seed)
    tail = (1.0 - confidence) / 2.0
    joined = np.concatenate(found)
    return SeedEstimate(
        value=float(interquartile_mean(joined)),
        low=_quantile(means, weights, tail),
        high=-_quantile(-means, weights, tail),
        seeds=joined.size,
    )


def _enumerated(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the statistic of every multiset of draws, and in how many ways each is drawn."""
    chosen, ways = _multisets(values.size)
    return interquartile_mean(values[chosen]), ways


@cache
def _multisets(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the multisets of `count` of as many places, shape (M, count), and their draws."""
    chosen = np.array(list(combinations_with_replacement(range(count), count)))
    times = (chosen[:, None, :] == np.arange(count)[:, None]).sum(axis=-1)
    factorials = np.array([math.factorial(k) for k in range(count + 1)])
    return chosen, factorials[count] // factorials[times].prod(axis=-1)


def _sampled(strata: Sequence[np.ndarray], seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    drawn = [each[rng.integers(each.size, size=(_RESAMPLES, each.size))] for each in strata]
    return interquartile_mean(np.concatenate(drawn, axis=-1)), np.ones(_RESAMPLES, dtype=np.int64)


def _quantile(values: np.ndarray, weights: np.ndarray, share: float) -> float:
    """Return the smallest value up to which at least a share of the weights lies."""
    order = np.argsort(values)
    below = np.cumsum(weights[order])
    # A share that is met but for rounding is met.
    place = int(np.searchsorted(below, share * below[-1] * (1.0 - 1e-12)))
    return float(values[order][place])


Estimates = Mapping[str, SeedEstimate | None]


@dataclass(frozen=True)
class AgentSummary:
    """What the agents of a study, trained alike on an env, are like with a filter and without it.

    The estimates are, by name:

    | name | meaning |
    |---|---|
    | `safety` | share of safe episodes, with the filter |
    | `returns` | mean return of an episode, with the filter |
    | `interventions` | share of the steps at which the filter changed the action |
    | `safety_alone` | share of safe episodes, without any filter |
    | `returns_alone` | mean return of an episode, without any filter |
    | `violations` | unsafe steps in the training |
    | `seconds` | processor time of the training |

    Attributes:
        env_id: full id.
        name: of the agents in the study.
        filter: text of the filter of the evaluations; "none" where there is none.
        estimates: interquartile means with intervals over seeds; None for what there is not.
    """

    env_id: str
    name: str
    filter: str
    estimates: Estimates


_FILTERED, _ALONE, _TRAINING = "filtered", "alone", "training"

_QUANTITIES: dict[str, tuple[str, Callable[[StudyRow], float | None]]] = {
    "safety": (_FILTERED, lambda row: row.safety_rate),
    "returns": (_FILTERED, lambda row: row.return_mean),
    "interventions": (_FILTERED, lambda row: row.intervention_rate),
    "safety_alone": (_ALONE, lambda row: row.safety_rate),
    "returns_alone": (_ALONE, lambda row: row.return_mean),
    "violations": (_TRAINING, lambda row: row.violations),
    "seconds": (_TRAINING, lambda row: row.seconds),
}
"""Whether they are of the evaluation with the filter, of that without one, or of the training,
which all evaluations of an agent tell; and where they are in a row."""


def summaries(found: StudyResult, agents: Sequence[Agent], env_id: str) -> list[AgentSummary]:
    """Return the statistics on an env, for each agent and each filter but "none".

    Args:
        found: of the study.
        agents: of its file.
        env_id: full id.
    """
    return _summarised(found, agents, env_id, None)


def differences(
    found: StudyResult, agents: Sequence[Agent], env_id: str, baseline: str
) -> list[AgentSummary]:
    """Return the statistics of what agents have more than others.

    Each agent is compared with that of the baseline that has the same seed, on the same starts and
    noise, and the first filter of the baseline.

    Args:
        found: of the study.
        agents: of its file.
        env_id: full id.
        baseline: name of the agents to compare with; see `StudyFile.require_agent`.
    """
    other = next(agent for agent in agents if agent.name == baseline)
    return _summarised(found, agents, env_id, other)


def _summarised(
    found: StudyResult, agents: Sequence[Agent], env_id: str, baseline: Agent | None
) -> list[AgentSummary]:
    result = []
    for agent in agents:
        for text in _filters(agent) if agent is not baseline else []:
            values = _values(found, agent, env_id, text)
            if baseline is not None:
                other = _values(found, baseline, env_id, _filters(baseline)[0])
                values = {name: _less(values[name], other[name]) for name in values}
            if any(values.values()):
                estimates = {
                    name: over_seeds([list(each.values())]) if each else None
                    for name, each in values.items()
                }
                rows = found.of(env_id, agent.variants[text].name)
                # An env that has no such filter may still have the agents without it.
                name = rows[0].filter if rows else text
                result.append(AgentSummary(env_id, agent.name, name, estimates))
    return result


def _filters(agent: Agent) -> list[str]:
    return [text for text in agent.variants if text != UNFILTERED] or [UNFILTERED]


def _values(
    found: StudyResult, agent: Agent, env_id: str, text: str
) -> dict[str, dict[int, float]]:
    """Return the values of each quantity by the number of the training."""
    by_text = {key: found.of(env_id, each.name) for key, each in agent.variants.items()}
    rows = {
        _FILTERED: by_text[text],
        _ALONE: by_text.get(UNFILTERED, []),
        _TRAINING: [row for of_text in by_text.values() for row in of_text],
    }
    return {
        name: {row.k: float(v) for row in rows[of] if (v := value(row)) is not None}
        for name, (of, value) in _QUANTITIES.items()
    }


def _less(values: dict[int, float], others: dict[int, float]) -> dict[int, float]:
    return {k: values[k] - others[k] for k in values.keys() & others.keys()}
