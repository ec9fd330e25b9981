"""The states of a batch of envs, moved and read by compiled functions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from safe_envs.dynamics.codegen import Components
from safe_envs.envs.batch_layout import PERIOD, STEPS
from safe_envs.envs.batch_state import BatchState
from safe_envs.envs.batch_stepper import BatchFilter, BatchStepper
from safe_envs.envs.episode import Episodes
from safe_envs.envs.info import VectorStep
from safe_envs.envs.reset_options import StartingPoints
from safe_envs.envs.seeding import EpisodeStreams
from safe_envs.problem.problem import SafetyProblem


class CompiledBatch:
    """The states of a batch of envs, with the interface of `ArrayBatch`.

    Args:
        problem: what to simulate.
        streams: of the envs.
        episodes: of the envs; counted here.
        limit: control periods until an episode is truncated.

    Raises:
        ConfigurationError: Numba is missing.
        NotCompilableError: The problem cannot be compiled.
    """

    def __init__(
        self, problem: SafetyProblem, streams: EpisodeStreams, episodes: Episodes, limit: int
    ) -> None:
        self._state = BatchState(problem, streams, episodes, limit)
        self._unfiltered = BatchStepper(self._state, None)

    @property
    def components(self) -> Components:
        """Components of the states; see `ArrayBatch`."""
        return self._state.components

    @property
    def sent(self) -> Components:
        """The same as `executed`: problems with a delay are left to `ArrayBatch`."""
        return self.executed

    @property
    def executed(self) -> Components:
        """Components of the physical inputs of the last step; where it restarted, as given."""
        return tuple(self._state.inputs.T[: self._state.shape[1]])

    def snapshot(self) -> dict[str, np.ndarray]:
        """Return nothing; see `ArrayBatch.snapshot`."""
        return {}

    def restore(self, snapshot: Mapping[str, np.ndarray]) -> None:
        """Do nothing; see `ArrayBatch.restore`."""

    def place(self, states: np.ndarray, seeded: Sequence[int]) -> None:
        """Put the envs into states; see `ArrayBatch.place`.

        Args:
            states: see there.
            seeded: see there.
        """
        state, episodes = self._state, self._state.episodes
        counts = state.counts.copy()
        counts[:, STEPS] = episodes.steps
        counts[seeded, PERIOD] = episodes.steps[seeded]
        state.chunks[seeded] = -1
        rows = np.column_stack([states, episodes.h_min, episodes.episode_cost])
        state.commit(np.ascontiguousarray(rows, dtype=float), counts, None)

    def begin(self, envs: np.ndarray, points: StartingPoints | None = None) -> VectorStep:
        """Begin the next episode of some envs; see `ArrayBatch.begin`."""
        return self._unfiltered.begin(envs, points)

    def step(self, actions: Any, due: np.ndarray | None) -> VectorStep:
        """Hold actions in [-1, 1]; see `ArrayBatch.step`.

        Args:
            actions: see there.
            due: see there.

        Returns:
            What is read off the states.
        """
        return self._unfiltered.step(actions, due)

    def step_physical(self, u: Sequence[Any], due: np.ndarray | None) -> VectorStep:
        """Hold inputs; see `ArrayBatch.step_physical`.

        Args:
            u: see there.
            due: see there.

        Returns:
            What is read off the states.
        """
        given = np.empty(self._state.shape)
        for j, component in enumerate(u):
            given[:, j] = component
        return self._unfiltered.hold(given, True, due)

    def filtered(self, batch_filter: BatchFilter) -> BatchStepper:
        """Return what steps these envs with a filter.

        Raises:
            NotCompilableError: The filter cannot be compiled.
        """
        return BatchStepper(self._state, batch_filter)
