"""The episodes of an evaluation in several processes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from safe_envs.agents.evaluation.brownian_bridge import BrownianBridge
from safe_envs.agents.evaluation.episode_batch import PlayedBatch
from safe_envs.agents.evaluation.resolved import ResolvedEvaluation
from safe_envs.agents.evaluation.rollout import Progress, play
from safe_envs.agents.jobs.processes import compute_in_order
from safe_envs.wrappers import Condition

_PARTS = 4
"""Parts into which the work of each process is divided, so that there is progress to report."""


def play_in_processes(
    setting: ResolvedEvaluation,
    conditions: Sequence[Condition],
    episodes: int,
    seed: int,
    num_envs: int,
    jobs: int,
    bridge: bool,
    progress: Progress | None,
) -> Iterator[PlayedBatch]:
    """Simulate episodes 0..episodes-1 by `jobs` processes, which remain for the next call.

    Args:
        setting: of the evaluation, with filters that were read.
        conditions: of the filter; none for the unfiltered env.
        episodes: how many.
        seed: whose children seed the episodes.
        num_envs: how many to simulate side by side in each process, at most.
        jobs: number of processes.
        bridge: whether to monitor h between control instants.
        progress: receives the number of episodes that are done.

    Raises:
        ConfigurationError: something cannot be sent to a process, mostly a custom policy.
        WorkersLostError: a process was ended from outside.
    """
    size = max(1, math.ceil(episodes / (jobs * _PARTS)))
    parts = [range(first, min(first + size, episodes)) for first in range(0, episodes, size)]
    shared = (setting, conditions, seed, num_envs, bridge)
    for part, waves in zip(parts, compute_in_order(_played, shared, parts, jobs), strict=True):
        yield from waves
        if progress:
            progress(part.stop)


def _played(
    shared: tuple[ResolvedEvaluation, Sequence[Condition], int, int, bool], part: range
) -> list[PlayedBatch]:
    setting, conditions, seed, num_envs, bridge = shared
    env = setting.env(conditions, min(num_envs, len(part)))
    monitor = BrownianBridge(setting.problem) if bridge else None
    try:
        return list(play(env, setting.policy, part, seed, bridge=monitor))
    finally:
        env.close()
