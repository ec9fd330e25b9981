"""The leaderboard: agents with and without filters, and with a limit on violations in training."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from safe_envs.agents.evaluation.attainable import (
    AttainableSafety,
    best_for,
    evaluation_settings,
)
from safe_envs.agents.evaluation.statistics import rate_interval
from safe_envs.agents.jobs.store import ResultStore, package_versions, reading
from safe_envs.agents.training.hyperparameters import ALGORITHMS
from safe_envs.agents.training.study import (
    DEFAULT,
    SeedEstimate,
    Study,
    StudyResult,
    Variant,
    over_seeds,
)
from safe_envs.errors import ConfigurationError
from safe_envs.registry import make_problem
from safe_envs.systems import ENV_IDS

LIMIT = 0.01
"""Chance of a violation that the constrained agent and the promise filter are asked to keep."""

_PROMISE = f"promise:p={1.0 - LIMIT:g}"
_BACKUP = "backup"
_ALL: dict[str, Any] = {"eval_episodes": 20}
"""Evaluations in the training choose nothing here."""

_QUICK: dict[str, Any] = {"n_timesteps": 4096, "eval_freq": 4096, "eval_episodes": 20}


def board(
    env_ids: Sequence[str],
    *,
    algo: str = "ppo",
    seeds: int = 5,
    seed: int = 0,
    episodes: int = 1000,
    quick: bool = False,
) -> Study:
    """Return the study of the leaderboard.

    The filters know the plant: with a wrong model they would have to be learned first, which is
    another comparison.

    Args:
        env_ids: registered ids.
        algo: name of an algorithm that is not constrained itself.
        seeds: number of trainings of each variant.
        seed: from which all seeds are derived.
        episodes: of the evaluation of each agent.
        quick: train for moments only.

    Raises:
        ConfigurationError: an id or the algorithm is unknown, or a number is out of range.
    """
    constrained, variants = f"{algo}-lag", [Variant("nominal"), Variant(algo, algo)]
    if constrained in ALGORITHMS:
        variants.append(Variant(constrained, constrained, training={"violation_limit": LIMIT}))
    variants += [
        Variant(f"{algo} + filter", algo, filter=DEFAULT),
        Variant(f"{algo} behind filter", algo, training={"filter": DEFAULT}, filter=DEFAULT),
        Variant(f"{algo} + promise filter", algo, filter=_PROMISE),
        Variant(f"{algo} behind backup", algo, training={"filter": _BACKUP}, filter=_BACKUP),
    ]
    return Study(env_ids, variants, seeds, seed, episodes, training=_QUICK if quick else _ALL)


@dataclass(frozen=True)
class LeaderboardEntry:
    """What the agents of a variant on an env are like.

    Attributes:
        env_id: full id.
        variant: its name.
        filter: text of the filter of the evaluations, or "none".
        safety: share of safe episodes, over seeds.
        safe: number of safe episodes of all agents together.
        episodes: number of their episodes.
        episodes_low: lower end of the 95 % interval of the rate of these agents over episodes.
        episodes_high: upper end.
        returns: mean return of an episode, over seeds.
        violations: unsafe steps in the training, over seeds; None without a training.
        minutes: processor time of a training, their mean; None without one.
    """

    env_id: str
    variant: str
    filter: str
    safety: SeedEstimate
    safe: int
    episodes: int
    episodes_low: float
    episodes_high: float
    returns: SeedEstimate
    violations: SeedEstimate | None
    minutes: float | None


def require_no_older(out: Path) -> None:
    """Check that a folder has no results of the leaderboard of one seed.

    Args:
        out: folder of a leaderboard.

    Raises:
        ConfigurationError: it has.
    """
    for env_id in ENV_IDS:
        path = out / "results" / f"{env_id.rpartition('/')[2]}.json"
        if path.exists():
            raise ConfigurationError(
                f"{out} holds a leaderboard of an earlier version, of one seed ({path.name}), which"
                " this one neither reads nor overwrites; give another --out"
            )


def entry_of(found: StudyResult, env_id: str, variant: str) -> LeaderboardEntry | None:
    """Return the statistics of a variant on an env; None where it has no agent there.

    Args:
        found: of the study.
        env_id: full id.
        variant: its name.
    """
    rows = found.of(env_id, variant)
    if not rows:
        return None
    safe, episodes = sum(row.safe for row in rows), sum(row.episodes for row in rows)
    violations = [float(row.violations) for row in rows if row.violations is not None]
    seconds = [row.seconds for row in rows if row.seconds is not None]
    low, high = rate_interval(safe, episodes)
    return LeaderboardEntry(
        env_id=env_id,
        variant=variant,
        filter=rows[0].filter,
        safety=over_seeds([[row.safety_rate for row in rows]]),
        safe=safe,
        episodes=episodes,
        episodes_low=low,
        episodes_high=high,
        returns=over_seeds([[row.return_mean for row in rows]]),
        violations=over_seeds([violations]) if violations else None,
        minutes=sum(seconds) / len(seconds) / 60.0 if seconds else None,
    )


def safety_over_envs(found: StudyResult) -> dict[str, SeedEstimate]:
    """Return the safety over all envs and seeds, of the variants that every env has.

    Args:
        found: of the study.
    """
    safety = {}
    for variant in found.study.variants:
        strata = [
            [row.safety_rate for row in found.of(env_id, variant.name)]
            for env_id in found.study.env_ids
        ]
        if all(strata):
            safety[variant.name] = over_seeds(strata)
    return safety


def attainable_of(
    env_ids: Sequence[str], out: Path, compute: bool, progress: Callable[[float], None]
) -> dict[str, AttainableSafety | str]:
    """Return the best attainable safety of envs, counted as the rows of the leaderboard are.

    Args:
        env_ids: full ids.
        out: folder of the leaderboard, which keeps it.
        compute: compute what is missing.
        progress: receives the part of the work that is done, from 0 to 1.

    Returns:
        By id what is known, or why a table cannot be had.

    Raises:
        ConfigurationError: the folder has a file that is damaged.
    """
    store, found = ResultStore(out / "best"), {}
    for k, env_id in enumerate(env_ids):
        problem, key = make_problem(env_id), env_id.rpartition("/")[2]
        settings = evaluation_settings(problem)
        configuration = {
            "env_id": env_id,
            "settings": asdict(settings),
            "versions": package_versions(),
        }
        document = store.read(key, configuration)
        if document is not None:
            with reading(store.path(key)):
                found[env_id] = AttainableSafety(**document["best"])
            continue
        if not compute:
            continue
        try:
            best = best_for(problem, lambda part, k=k: progress((k + part) / len(env_ids)))
        except ConfigurationError as error:
            found[env_id] = str(error)
            continue
        store.keep(key, configuration, {"best": vars(best)})
        found[env_id] = best
    return found
