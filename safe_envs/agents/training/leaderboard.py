"""Agents that are trained on an env without and with its filter, compared with its controller."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, get_type_hints

from safe_envs.agents.evaluation.attainable import AttainableSafety
from safe_envs.agents.evaluation.evaluate import evaluate
from safe_envs.agents.evaluation.spec import UNFILTERED
from safe_envs.agents.evaluation.yardstick import best_at_hand, best_for
from safe_envs.agents.jobs.fingerprint import package_versions
from safe_envs.agents.jobs.store import ResultStore, reading
from safe_envs.agents.training.config import Training
from safe_envs.agents.training.trainer import train
from safe_envs.errors import ConfigurationError
from safe_envs.registry import make_problem
from safe_envs.systems import ENV_IDS

_QUICK: dict[str, Any] = {"n_timesteps": 4096, "eval_freq": 4096, "eval_episodes": 50}
_STATISTICS = ("filter", "safety_rate", "ci_low", "ci_high", "return_mean", "intervention_rate")


@dataclass(frozen=True)
class LeaderboardRow:
    """The evaluation of a policy with a filter.

    Attributes:
        env_id: full id.
        policy: its name in the leaderboard.
        filter: text of the filter, or "none".
        safety_rate: share of the episodes without a violation.
        ci_low: lower end of its 95 % interval.
        ci_high: upper end.
        return_mean: mean return of an episode.
        intervention_rate: share of the steps at which the filter changed the action.
        trained_in: processor time of the training in seconds; None without one.

    Raises:
        TypeError: an attribute is of another type.
    """

    env_id: str
    policy: str
    filter: str
    safety_rate: float
    ci_low: float
    ci_high: float
    return_mean: float
    intervention_rate: float
    trained_in: float | None

    def __post_init__(self) -> None:
        for name, kind in get_type_hints(type(self)).items():
            if not isinstance(getattr(self, name), kind):
                raise TypeError(f"{name} is {getattr(self, name)!r}")


@dataclass(frozen=True)
class LeaderboardOptions:
    """What all rows of a leaderboard have in common.

    Attributes:
        algo: name of the algorithm.
        seed: of all randomness.
        quick: train for moments only.
        episodes: of each evaluation.
        knowledge: of the filters. With a wrong model they would have to be learned first, which is
            another comparison.
    """

    algo: str
    seed: int
    quick: bool
    episodes: int
    knowledge: str = "plant"


def leaderboard_rows(
    env_ids: Sequence[str],
    options: LeaderboardOptions,
    out: Path,
    progress: Callable[[float], None],
) -> list[LeaderboardRow]:
    """Return five rows for each env, computed unless a previous run has kept them.

    Args:
        env_ids: full ids.
        options: of the leaderboard.
        out: folder of the agents and of the results.
        progress: receives the part of the work that is done, from 0 to 1.

    Raises:
        ConfigurationError: the folder has results of other options, or files that are damaged.
    """
    store = ResultStore(out / "results")
    store.require_same_options([_key(env_id) for env_id in ENV_IDS], asdict(options))
    found, count = [], len(env_ids)
    for k, env_id in enumerate(env_ids):
        rows = _kept(store, env_id, options)
        if rows is None:
            of_env = _rows_of_env(
                env_id, options, out, lambda part, k=k: progress((k + part) / count)
            )
            rows = list(of_env)
            store.keep(
                _key(env_id),
                _configuration(env_id, options),
                {"rows": [asdict(row) for row in rows]},
            )
        found += rows
        progress((k + 1) / count)
    return found


def attainable_of(
    env_ids: Sequence[str], compute: bool, progress: Callable[[float], None]
) -> dict[str, AttainableSafety | str]:
    """Return the best attainable safety of envs, counted as the rows of the leaderboard are.

    Args:
        env_ids: full ids.
        compute: compute what is missing; without it only tables in the cache are read.
        progress: receives the part of the work that is done, from 0 to 1.

    Returns:
        By id what is known, or why a table cannot be had.
    """
    found: dict[str, AttainableSafety | str] = {}
    for k, env_id in enumerate(env_ids):
        problem = make_problem(env_id)
        try:
            best = (
                best_for(problem, lambda part, k=k: progress((k + part) / len(env_ids)))
                if compute
                else best_at_hand(problem)
            )
        except ConfigurationError as error:
            best = str(error)
        if best is not None:
            found[env_id] = best
    return found


def _key(env_id: str) -> str:
    return env_id.rpartition("/")[2]


def _configuration(env_id: str, options: LeaderboardOptions) -> dict[str, Any]:
    return {"env_id": env_id, "options": asdict(options), "versions": package_versions()}


def _kept(
    store: ResultStore, env_id: str, options: LeaderboardOptions
) -> list[LeaderboardRow] | None:
    document = store.read(_key(env_id), _configuration(env_id, options))
    if document is None:
        return None
    with reading(store.path(_key(env_id))):
        return [LeaderboardRow(**row) for row in document["rows"]]


def _rows_of_env(
    env_id: str, options: LeaderboardOptions, out: Path, progress: Callable[[float], None]
) -> Iterator[LeaderboardRow]:
    """Yield the rows of the nominal controller, and of agents without and with the filter."""
    default, algo = make_problem(env_id).filter, options.algo
    yield from _evaluated(env_id, "nominal", "nominal", [UNFILTERED, default], options)
    for i, (name, kind, in_loop, filters) in enumerate(
        (
            (algo, "unfiltered", None, [UNFILTERED, default]),
            (f"{algo}, filter in the loop", "filtered", default, [default]),
        )
    ):
        folder = out / f"{_key(env_id)}-{algo}-{kind}"
        training = Training.of(
            env_id,
            algo,
            filter=in_loop,
            knowledge=options.knowledge,
            seed=options.seed,
            **(_QUICK if options.quick else {}),
        )
        seconds = train(
            training,
            folder,
            resume=(folder / "config.json").exists(),
            progress=lambda part, i=i: progress((i + part) / 2),
        )
        yield from _evaluated(env_id, name, str(folder), filters, options, seconds)


def _evaluated(
    env_id: str,
    name: str,
    policy: str,
    filters: Sequence[str],
    options: LeaderboardOptions,
    seconds: float | None = None,
) -> Iterator[LeaderboardRow]:
    found = evaluate(
        env_id,
        policy,
        filters,
        episodes=options.episodes,
        seed=options.seed,
        knowledge=options.knowledge,
        bounds=False,
        best=False,
    )
    for row in found.rows:
        statistics = {key: getattr(row, key) for key in _STATISTICS}
        yield LeaderboardRow(env_id, name, **statistics, trained_in=seconds)
