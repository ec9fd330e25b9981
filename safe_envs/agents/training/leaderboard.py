"""The leaderboard: agents with and without filters, and with a limit on violations in training."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from safe_envs.agents.evaluation.attainable import AttainableSafety
from safe_envs.agents.evaluation.yardstick import best_at_hand, best_for
from safe_envs.agents.training.hyperparameters import ALGORITHMS
from safe_envs.agents.training.study import DEFAULT, Study, Variant
from safe_envs.errors import ConfigurationError
from safe_envs.registry import make_problem

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
        Variant(f"{algo} + promise", algo, filter=_PROMISE),
        Variant(f"{algo} behind backup", algo, training={"filter": _BACKUP}, filter=_BACKUP),
    ]
    return Study(env_ids, variants, seeds, seed, episodes, training=_QUICK if quick else _ALL)


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
