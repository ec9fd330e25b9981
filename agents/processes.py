"""The episodes of an evaluation in several processes: the same answer, sooner."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pickle import PicklingError
from typing import Any

from agents.bridge import Bridge
from agents.episodes import Played, Progress, play
from agents.setting import Setting
from safe_envs.errors import ConfigurationError
from wrappers import Condition

_PARTS = 4
"""In how many parts the work of a process comes, so that there is progress to tell."""


def play_in_processes(
    setting: Setting,
    conditions: Sequence[Condition],
    episodes: int,
    seed: int,
    num_envs: int,
    jobs: int,
    bridge: bool,
    progress: Progress | None,
) -> Iterator[Played]:
    """Simulate episodes 0..episodes-1 by `jobs` processes, which stay for the next call.

    Args:
        setting: of the evaluation, with filters that were read.
        conditions: of the filter; none for the bare env.
        episodes: how many.
        seed: whose children seed the episodes.
        num_envs: how many to simulate side by side in each process, at most.
        jobs: number of processes.
        bridge: whether h is looked at between control instants.
        progress: told how many episodes are done.

    Raises:
        ConfigurationError: something cannot be sent to a process, a policy of one's own mostly.
    """
    from joblib import Parallel, delayed

    size = max(1, math.ceil(episodes / (jobs * _PARTS)))
    parts = [range(first, min(first + size, episodes)) for first in range(0, episodes, size)]
    send = delayed(_played)
    try:
        found: Any = Parallel(n_jobs=jobs, return_as="generator")(send(setting, conditions, part, seed, num_envs, bridge) for part in parts)
        for part, waves in zip(parts, found, strict=True):
            yield from waves
            if progress:
                progress(part.stop)
    except (PicklingError, AttributeError, TypeError) as error:
        raise ConfigurationError(f"jobs = {jobs}: what is evaluated cannot be sent to another process ({error}); use jobs=1") from error


def _played(setting: Setting, conditions: Sequence[Condition], part: range, seed: int, num_envs: int, bridge: bool) -> list[Any]:
    env = setting.env(conditions, min(num_envs, len(part)))
    return list(play(env, setting.actor, part, seed, bridge=Bridge(setting.problem) if bridge else None))
