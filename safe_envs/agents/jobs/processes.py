"""Processes of this machine that end with the one that started them, and the episodes of an
evaluation in several of them."""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from typing import Any

import cloudpickle

from safe_envs.agents.evaluation.brownian_bridge import BrownianBridge
from safe_envs.agents.evaluation.episode_batch import PlayedBatch
from safe_envs.agents.evaluation.resolved import ResolvedEvaluation
from safe_envs.agents.evaluation.rollout import Progress, play
from safe_envs.errors import ConfigurationError, WorkersLostError
from safe_envs.wrappers import Condition

_PARTS = 4
"""In how many parts the work of a process comes, so that there is progress to tell."""

_LOOK = 1.0
"""Seconds between two looks of a worker at whether the process that started it is still there."""


def end_with_parent(parent: int) -> None:
    """Let this process end soon after its parent, which may be killed without a word; for the
    initializer of a pool of processes.

    The operating system gives a process whose parent has ended another parent. (Windows does not:
    there it stays until it is idle.)

    Args:
        parent: id of the process that started this one.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_LOOK)
        os._exit(1)

    threading.Thread(target=watch, daemon=True, name="end_with_parent").start()


def local_processes(idle: int = 300) -> Any:
    """Return joblib's backend of processes of this machine, each of which ends with this one.

    Args:
        idle: seconds after which a process ends that has nothing to do.
    """
    from joblib._parallel_backends import LokyBackend

    return LokyBackend(
        idle_worker_timeout=idle, initializer=end_with_parent, initargs=(os.getpid(),)
    )


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
        WorkersLostError: a process was ended from outside.
    """
    from joblib import Parallel, delayed

    size = max(1, math.ceil(episodes / (jobs * _PARTS)))
    parts = [range(first, min(first + size, episodes)) for first in range(0, episodes, size)]
    sent = _sent(setting, conditions, jobs)
    parallel = Parallel(jobs, backend=local_processes(), return_as="generator")
    found: Any = parallel(delayed(_played)(sent, part, seed, num_envs, bridge) for part in parts)
    try:
        for part, waves in zip(parts, found, strict=True):
            yield from waves
            if progress:
                progress(part.stop)
    except BrokenProcessPool as error:
        raise WorkersLostError(
            f"jobs = {jobs}: a process that simulated episodes was ended from outside, as for want"
            " of memory; use fewer jobs or a smaller num_envs"
        ) from error


def _sent(setting: ResolvedEvaluation, conditions: Sequence[Condition], jobs: int) -> bytes:
    try:
        return cloudpickle.dumps((setting, conditions))
    except (
        Exception
    ) as error:  # Whatever an object of the user's raises where it is not made for this.
        raise ConfigurationError(
            f"jobs = {jobs}: what is evaluated cannot be sent to another process ({error}); use"
            " jobs=1"
        ) from error


def _played(sent: bytes, part: range, seed: int, num_envs: int, bridge: bool) -> list[PlayedBatch]:
    setting, conditions = cloudpickle.loads(sent)
    env = setting.env(conditions, min(num_envs, len(part)))
    try:
        return list(
            play(
                env,
                setting.policy,
                part,
                seed,
                bridge=BrownianBridge(setting.problem) if bridge else None,
            )
        )
    finally:
        env.close()
