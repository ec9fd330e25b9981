"""Episodes on a vector env, batch by batch."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from safe_envs.agents.evaluation.brownian_bridge import BrownianBridge, Exponentials, smallest
from safe_envs.agents.evaluation.episode_batch import EpisodeBatch, PlayedBatch
from safe_envs.agents.evaluation.spec import Progress
from safe_envs.agents.evaluation.targets import Env
from safe_envs.agents.evaluation.trajectories import EpisodeRecorder
from safe_envs.agents.jobs import blas_threads
from safe_envs.agents.jobs.processes import compute_in_order
from safe_envs.agents.policies.base import Policy
from safe_envs.agents.policies.custom import policy_name
from safe_envs.agents.policies.observations import shapes_of
from safe_envs.dynamics.codegen import Components
from safe_envs.dynamics.philox import episode_seeds
from safe_envs.envs.info import Info
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.errors import InvalidInputError, SafeEnvsError, shortened
from safe_envs.wrappers import SafetyMonitorVector
from safe_envs.wrappers.env_wrappers.safety_filter_vector import readable

_PARTS = 4
"""Parts at least into which the work of each process is divided, so that there is progress."""

_LARGEST_PART = 65_536
"""Episodes of a part at most, as the results of all of them are sent at once."""


def episode_seed(seed: int, episode: int) -> int:
    """Return the seed of the env in an episode; see `episode_seeds`.

    Args:
        seed: of the evaluation.
        episode: its number.
    """
    return episode_seeds(seed, range(episode, episode + 1))[0]


def play(
    env: Env,
    policy: Any,
    episodes: range,
    seed: int,
    progress: Progress | None = None,
    trajectories: EpisodeRecorder | None = None,
    bridge: BrownianBridge | None = None,
) -> Iterator[PlayedBatch]:
    """Simulate consecutive episodes in batches of the size of the vector env.

    Args:
        env: with next-step autoreset: what it simulates after an episode's end is ignored.
        policy: anything with Stable-Baselines3's `predict`.
        episodes: their numbers.
        seed: of the evaluation, from which every episode gets a seed of its own.
        progress: called after every step with the number of episodes that are done; those under
            way count with the part that is done.
        trajectories: is filled, if given.
        bridge: gives the minimum h between control instants too; it changes neither control nor
            noise.

    Returns:
        Each batch once its episodes have ended.
    """
    world = readable(env)
    for first in range(episodes.start, episodes.stop, env.num_envs):
        count = min(env.num_envs, episodes.stop - first)
        rows = range(first, first + env.num_envs)
        with blas_threads.limited():
            if isinstance(policy, Policy):
                policy.begin(rows, seed)
            seeds = episode_seeds(seed, rows)
            started = env.reset(seed=seeds)
            starts = world.components
            watch = (
                None
                if bridge is None
                else _MinimumWatch(bridge, Exponentials(seeds, bridge.draws), starts, started)
            )
            batch = _play(env, policy, started, first, count, progress, trajectories, watch)
        yield PlayedBatch(
            batch.results(count),
            np.stack(starts, axis=1)[:count],
            batch.slight(world.problem, count),
            batch.watch.visited(count),
            batch.estimation and batch.estimation.results(count),
        )


def play_in_processes(
    make_env: Callable[[int], Env],
    policy: Any,
    episodes: int,
    seed: int,
    num_envs: int,
    jobs: int,
    continuous: bool,
    progress: Progress | None,
) -> Iterator[PlayedBatch]:
    """Simulate episodes 0..episodes-1 by `jobs` processes, which remain for the next call.

    Args:
        make_env: makes a vector env of a size.
        policy: anything with Stable-Baselines3's `predict`.
        episodes: how many.
        seed: of the evaluation, from which every episode gets a seed of its own.
        num_envs: how many to simulate side by side in each process, at most.
        jobs: number of processes.
        continuous: whether to monitor h between control instants.
        progress: receives the number of episodes that are done.

    Returns:
        The batches in the order of the episodes.

    Raises:
        ConfigurationError: Something cannot be sent to a process, mostly a custom policy.
        WorkersLostError: A process was ended from outside.
    """
    size = min(max(1, math.ceil(episodes / (jobs * _PARTS))), _LARGEST_PART)
    parts = [range(first, min(first + size, episodes)) for first in range(0, episodes, size)]
    shared = (make_env, policy, seed, num_envs, continuous)
    for part, batches in zip(parts, compute_in_order(_played, shared, parts, jobs), strict=True):
        yield from batches
        if progress:
            progress(part.stop)


def _played(
    shared: tuple[Callable[[int], Env], Any, int, int, bool], part: range
) -> list[PlayedBatch]:
    make_env, policy, seed, num_envs, continuous = shared
    env = make_env(min(num_envs, len(part)))
    bridge = BrownianBridge(readable(env).problem) if continuous else None
    try:
        return list(play(env, policy, part, seed, bridge=bridge))
    finally:
        env.close()


class _MinimumWatch:
    """Draws the minimum h during each period of a batch."""

    def __init__(
        self,
        bridge: BrownianBridge,
        draws: Exponentials,
        x: Components,
        started: tuple[np.ndarray, Info],
    ) -> None:
        self._bridge, self._draws, self._x = bridge, draws, x
        self._barriers = started[1]["barrier"]

    def minimum(self, x: Components, barriers: np.ndarray) -> np.ndarray:
        """Return the minimum h of the period that led to the states x, shape (B,)."""
        found = self._bridge.sample_minimum(self._x, self._barriers, barriers, self._draws.next())
        self._x, self._barriers = x, barriers
        return smallest(found)


def _play(
    env: Env,
    policy: Any,
    started: tuple[np.ndarray, Info],
    first: int,
    count: int,
    progress: Progress | None,
    trajectories: EpisodeRecorder | None,
    watch: _MinimumWatch | None,
) -> EpisodeBatch:
    """Simulate a batch that was just reset and begins with the episode `first`."""
    world = readable(env)
    steps = world.problem.steps
    observation, info = started
    h = smallest(info["barrier"])
    batch = EpisodeBatch(len(h), count, h, world.components, len(world.problem.inputs), info)
    if trajectories:
        trajectories.note(0, first, batch.alive, h, world.components)
    state, start = None, np.ones(len(h), dtype=bool)
    for k in range(1, steps + 1):
        actions, state = acted(policy, observation, state, start)
        before, barriers = world.components, info["barrier"]
        observation, reward, terminated, truncated, info = env.step(actions)
        h, executed = smallest(info["barrier"]), _executed(world, actions, info)
        lowest = h if watch is None else watch.minimum(world.components, info["barrier"])
        if trajectories and first == 0 and batch.alive[0]:
            trajectories.note_decision(k - 1, before, barriers, executed, info)
        batch.add(lowest, (before, world.components), executed, reward, info)
        if trajectories:
            trajectories.note(k, first, batch.alive, h, world.components)
        start = terminated | truncated
        batch.alive &= ~start
        if progress:
            progress(first + count * k / steps)
        if not batch.alive.any():
            break
    if progress:
        progress(first + count)
    return batch


def acted(policy: Any, observation: Any, state: Any, start: np.ndarray) -> tuple[Any, Any]:
    """Return the actions and the state of a policy, whose failure is that of what was given.

    Args:
        policy: anything with Stable-Baselines3's `predict`.
        observation: of each env, shape (B, k) mostly.
        state: of the policy, as it returned it last; None at first.
        start: which envs begin an episode, bool (B,).

    Returns:
        The actions, shape (B, m), and the state.

    Raises:
        InvalidInputError: The policy failed.
    """
    try:
        actions, state = policy.predict(observation, state, start, deterministic=True)
    except SafeEnvsError:
        raise
    except (Exception, SystemExit) as error:
        raise InvalidInputError(
            f"the policy {policy_name(policy)} failed on observations {shapes_of(observation)}"
            f" ({type(error).__name__}: {shortened(error)}); predict(observation, state,"
            " episode_start, deterministic) returns the actions and the next state"
        ) from error
    return actions, state


def _executed(
    world: SafeVectorEnv | SafetyMonitorVector, actions: np.ndarray, info: Info
) -> Components:
    """Return the components of the executed input in physical units."""
    if "executed_action" in info:
        return tuple(info["executed_action"].T)
    return tuple(info["safe_action"].T) if "safe_action" in info else world.physical_action(actions)
