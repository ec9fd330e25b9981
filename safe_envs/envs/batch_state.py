"""The states of a batch of envs between two calls of its compiled function."""

from __future__ import annotations

import numpy as np

from safe_envs.dynamics.codegen import Components
from safe_envs.envs.batch_layout import PERIODS, STEPS
from safe_envs.envs.episode import Episodes
from safe_envs.envs.reset_options import StartingPoints
from safe_envs.envs.seeding import EpisodeStreams
from safe_envs.envs.spaces import BatchActions
from safe_envs.envs.world_source import noise_channels
from safe_envs.problem.problem import SafetyProblem


class BatchState:
    """What a compiled batch remembers; see the arguments of `batch_kernel.step_batch`.

    Attributes:
        problem: what is simulated.
        streams: of the envs.
        episodes: of the envs.
        actions: of the envs.
        shape: of the actions.
        settings: steps until an episode is truncated, control period, and channels of the noise.
        states: n states, smallest barrier and cost of the episode, of each env.
        counts: steps of the episode and period of its noise, of each env.
        inputs: what was executed last, and what else a step tells about inputs; empty before.
        chunks: numbers of the chunks of noise.
        noise: drawn ahead.
        uniforms: scratch array.

    Args:
        problem: see above.
        streams: see above.
        episodes: see above.
        limit: control periods until an episode is truncated.
    """

    def __init__(
        self, problem: SafetyProblem, streams: EpisodeStreams, episodes: Episodes, limit: int
    ) -> None:
        n, channels = streams.num_envs, noise_channels(problem)
        self.problem, self.streams, self.episodes = problem, streams, episodes
        self.actions = BatchActions(problem, n)
        self.shape = (n, len(problem.inputs))
        self.settings = (int(limit), float(problem.dt), channels)
        self.states = np.full((n, problem.plant.n + 2), np.nan)
        self.counts = np.zeros((n, 2), dtype=np.int64)
        self.inputs = np.empty((0, 0))
        self.chunks = np.full(n, -1, dtype=np.int64)
        self.noise = np.empty(n * PERIODS * channels)
        self.uniforms = np.empty(len(problem.starts[problem.start].uniforms))

    @property
    def components(self) -> Components:
        """Components of the states, which cannot be written to."""
        columns = tuple([self.states[:, j] for j in range(self.problem.plant.n)])
        for column in columns:
            column.setflags(write=False)
        return columns

    def before(
        self, envs: np.ndarray | None, points: StartingPoints | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return states and counts as a step finds them.

        Args:
            envs: the envs that begin an episode, bool (num_envs,); None for none.
            points: where they begin; None for draws.
        """
        if points is None:
            return self.states, self.counts
        states, counts = self.states.copy(), self.counts.copy()
        states[envs, : self.problem.plant.n] = points.states[envs]
        counts[envs] = points.steps[envs, None]
        return states, counts

    def commit(self, states: np.ndarray, counts: np.ndarray, restarted: np.ndarray | None) -> None:
        """Take states and counts as those of the envs.

        Args:
            states: which nobody else writes to.
            counts: likewise.
            restarted: the envs whose episodes began, bool (num_envs,); None for none.
        """
        n = self.problem.plant.n
        self.states, self.counts = states, counts
        self.episodes.take(counts[:, STEPS], states[:, n], states[:, n + 1], restarted)
