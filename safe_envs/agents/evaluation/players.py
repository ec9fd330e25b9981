"""Who simulates the episodes of an evaluation under a filter: NumPy, or a compiled program."""

from __future__ import annotations

import os
from collections.abc import Iterator
from functools import cached_property, partial

from safe_envs.agents.evaluation.brownian_bridge import BrownianBridge
from safe_envs.agents.evaluation.compiled_episodes import CompiledEpisodes
from safe_envs.agents.evaluation.decision_source import decider_of
from safe_envs.agents.evaluation.episode_batch import PlayedBatch
from safe_envs.agents.evaluation.resolved import FilterParts, ResolvedEvaluation
from safe_envs.agents.evaluation.rollout import play, play_in_processes
from safe_envs.agents.evaluation.spec import Progress, RunSettings
from safe_envs.agents.evaluation.targets import Env
from safe_envs.agents.evaluation.trajectories import EpisodeRecorder
from safe_envs.agents.jobs.threads import available_threads
from safe_envs.compiled.engine import compiled_or_none
from safe_envs.errors import NotCompilableError


class NumpyPlayer:
    """Steps many envs at once.

    Args:
        resolved: what to simulate.
        conditions: of the filter, see `FilterParts`.
        settings: how it is run.

    Attributes:
        engine: "numpy".
        jobs: processes.

    Raises:
        SafeEnvsError: The envs cannot be made, or fail at a first step.
    """

    engine = "numpy"

    def __init__(
        self, resolved: ResolvedEvaluation, conditions: FilterParts, settings: RunSettings
    ) -> None:
        spec = self._spec = resolved.spec
        self._resolved, self._conditions = resolved, conditions
        self._size, self.jobs = min(settings.num_envs, spec.episodes), settings.jobs or 1
        continuous = spec.monitoring == "continuous"
        self._bridge = BrownianBridge(resolved.problem) if continuous else None
        self._env: Env = resolved.env(conditions, self._size)

    def play(
        self, progress: Progress | None = None, trajectories: EpisodeRecorder | None = None
    ) -> Iterator[PlayedBatch]:
        """Simulate all episodes.

        Args:
            progress: called with the number of episodes that are done.
            trajectories: is filled, if given.

        Returns:
            The batches in the order of the episodes.
        """
        spec = self._spec
        if self.jobs == 1:
            return self.part(range(spec.episodes), progress, trajectories)
        return play_in_processes(
            partial(self._resolved.env, self._conditions),
            self._resolved.policy,
            spec.episodes,
            spec.seed,
            self._size,
            self.jobs,
            self._bridge is not None,
            progress,
        )

    def part(
        self,
        episodes: range,
        progress: Progress | None = None,
        trajectories: EpisodeRecorder | None = None,
    ) -> Iterator[PlayedBatch]:
        """Simulate some of the episodes in this process; see `play`."""
        return play(
            self._env,
            self._resolved.policy,
            episodes,
            self._spec.seed,
            progress,
            trajectories,
            self._bridge,
        )

    def close(self) -> None:
        """Close the envs."""
        self._env.close()


class CompiledPlayer:
    """Runs a compiled program; the arguments are those of `NumpyPlayer`.

    Attributes:
        engine: "compiled"; "compiled, numpy" once NumPy had to simulate a part of the work again.
        jobs: threads, at most as many as processors.

    Raises:
        NotCompilableError: Only NumPy can do this.
        ConfigurationError: Numba is missing.
        SafeEnvsError: The filter cannot be made.
    """

    def __init__(
        self, resolved: ResolvedEvaluation, conditions: FilterParts, settings: RunSettings
    ) -> None:
        spec = self._spec = resolved.spec
        if resolved.target.filter_spec is not None:
            raise NotCompilableError(
                f"{resolved.target.title} is a third-party env, which only its own code can step"
            )
        if settings.record:
            raise NotCompilableError(
                "trajectories for pictures are kept by the engine 'numpy' alone"
            )
        decider = decider_of(resolved, conditions)
        continuous = spec.monitoring == "continuous"
        self._episodes = CompiledEpisodes(resolved.problem, resolved.policy, decider, continuous)
        self._functions = self._episodes.compiled()
        self.engine = "compiled"
        self.jobs = min(settings.jobs or available_threads(), os.cpu_count() or 1)
        self._reference = partial(NumpyPlayer, resolved, conditions, settings)

    @cached_property
    def _numpy(self) -> NumpyPlayer:
        return self._reference()

    def play(
        self, progress: Progress | None = None, trajectories: EpisodeRecorder | None = None
    ) -> Iterator[PlayedBatch]:
        """Simulate all episodes; see `NumpyPlayer.play`."""
        done = 0
        for batch in self._episodes.play(
            self._functions,
            range(self._spec.episodes),
            self._spec.seed,
            self.jobs,
            self._again,
        ):
            yield batch
            done += len(batch.starts)
            if progress:
                progress(done)

    def _again(self, episodes: range) -> Iterator[PlayedBatch]:
        self.engine = "compiled, numpy"
        return self._numpy.part(episodes)

    def close(self) -> None:
        """Do nothing: there is nothing to close."""


Player = NumpyPlayer | CompiledPlayer


def player_of(
    resolved: ResolvedEvaluation, conditions: FilterParts, settings: RunSettings
) -> Player:
    """Return who simulates the episodes under a filter; see `RunSettings.engine`.

    Args:
        resolved: what to simulate.
        conditions: of the filter, see `FilterParts`.
        settings: how it is run.

    Raises:
        NotCompilableError: The compiled engine was asked for, and cannot do this.
        SafeEnvsError: What is to be simulated cannot be made.
    """
    periods = resolved.spec.episodes * resolved.problem.steps
    compiled = compiled_or_none(
        settings.engine, periods, partial(CompiledPlayer, resolved, conditions, settings)
    )
    return compiled or NumpyPlayer(resolved, conditions, settings)
