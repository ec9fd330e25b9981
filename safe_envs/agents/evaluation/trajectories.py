"""Trajectories of the first episodes, for pictures."""

from __future__ import annotations

import numpy as np

from safe_envs.dynamics.codegen import Components
from safe_envs.envs.info import Info
from safe_envs.errors import ConfigurationError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.decision_log import DecisionLog, LogColumns

_KEPT_BARRIERS = 256
_KEPT_STATES = 32
_DECIDED = ("intervention", "feasible", "active_barrier")
_MOST_RECORDED = 1_000_000


class EpisodeRecorder:
    """Receives what happens in the episodes of a rollout; this one forgets it."""

    def note(self, k: int, first: int, present: np.ndarray, h: np.ndarray, x: Components) -> None:
        """Keep instant k of a batch that begins with the episode `first`.

        Args:
            k: the instant.
            first: number of the first episode.
            present: which episodes are under way, shape (B,).
            h: smallest barrier values, shape (B,).
            x: components of the states, each of shape (B,).
        """

    def note_decision(
        self, k: int, x: Components, barriers: np.ndarray, executed: Components, info: Info
    ) -> None:
        """Keep the decision at instant k of the first episode, which is the first of its batch.

        Args:
            k: the instant.
            x: components of the states at which was decided, each of shape (B,).
            barriers: their values there, shape (B, number of barriers).
            executed: components of the inputs, each of shape (B,).
            info: of the step, with the keys of a filter if there is one.
        """


class Trajectories(EpisodeRecorder):
    """Trajectories of the first episodes, NaN after their ends.

    Attributes:
        barrier: smallest barrier value, shape (steps + 1, at most 256).
        states: shape (steps + 1, at most 32, n).
        log: decisions of the first episode; without a filter, what was proposed is executed.

    Raises:
        ConfigurationError: an episode has more steps than a picture could show.
    """

    def __init__(self, problem: SafetyProblem, episodes: int) -> None:
        steps = problem.steps
        if steps > _MOST_RECORDED:
            raise ConfigurationError(
                f"an episode of {steps} steps is too long to draw; choose a horizon of at most"
                f" {_MOST_RECORDED} steps"
            )
        self.barrier = np.full((steps + 1, min(episodes, _KEPT_BARRIERS)), np.nan)
        self.states = np.full((steps + 1, min(episodes, _KEPT_STATES), problem.plant.n), np.nan)
        variables = (*problem.states, *problem.inputs)
        columns = LogColumns.of(
            problem.plant.states,
            problem.plant.inputs,
            [barrier.name for barrier in problem.barriers],
            units={each.symbol: each.unit for each in variables},
        )
        self.log = DecisionLog(columns)
        self._dt, self._bounds = problem.dt, np.transpose(problem.box)

    def note(self, k: int, first: int, present: np.ndarray, h: np.ndarray, x: Components) -> None:
        """See `EpisodeRecorder`."""
        self._put(self.barrier[k], first, present, h)
        for j, component in enumerate(x):
            self._put(self.states[k, :, j], first, present, component)

    def note_decision(
        self, k: int, x: Components, barriers: np.ndarray, executed: Components, info: Info
    ) -> None:
        """See `EpisodeRecorder`."""
        action = [float(component[0]) for component in executed]
        filtered = "safe_action" in info
        self.log.append(
            [
                k * self._dt,
                *(float(component[0]) for component in x),
                *(info["nominal_action"][0] if filtered else action),
                *action,
                *self._bounds[0],
                *self._bounds[1],
                *barriers[0],
                *(info["slacks"][0] if filtered else np.zeros(barriers.shape[1])),
                *((info[key][0] for key in _DECIDED) if filtered else (False, True, -1)),
            ]
        )

    @staticmethod
    def _put(row: np.ndarray, first: int, present: np.ndarray, values: np.ndarray) -> None:
        room = row[first : first + len(present)]
        np.copyto(room, values[: len(room)], where=present[: len(room)])
