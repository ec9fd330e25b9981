"""The policy that is as safe as a table of a problem's value shows to be possible."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from safe_envs.agents.policies.base import Policy, checked_observation
from safe_envs.agents.policies.observed_state import ObservedState
from safe_envs.envs.spaces import center_and_half_width
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.value.look_ahead import LookAhead
from safe_envs.wrappers.value.reduction import reduced
from safe_envs.wrappers.value.settings import ValueSettings
from safe_envs.wrappers.value.table import ValueTable
from safe_envs.wrappers.value.table_cache import table_for


class BestPolicy(Policy):
    """Takes at each control instant k the input with the largest value of the next state.

    It counts the control periods of each episode in the hidden state, which `predict` returns as a
    recurrent policy of Stable-Baselines3 does: pass it on, with `episode_start` at the first
    observation of each episode. After the last instant of the table it goes on with that instant.

    The table is computed, or read from the cache, by `prepare` or else at the first action.

    Args:
        problem: in which it acts.
        settings: of the table; by default that of the plant.
        file: of the table, in place of the cache.

    Attributes:
        problem: as given.
        settings: of the table.

    Raises:
        ConfigurationError: There is no table of the problem, as of one with too many states, or
            the observation does not determine a state that the table needs.
    """

    def __init__(
        self,
        problem: SafetyProblem,
        settings: ValueSettings | None = None,
        file: Path | None = None,
    ) -> None:
        self.problem, self._file = problem, file
        self.settings = settings or ValueSettings(knowledge="plant")
        found = reduced(problem, self.settings.knowledge, self.settings.intervals)
        symbols = set().union(*(c.expression.free_symbols for c in found.coordinates))
        # The time, on which a goal may depend, is known and no state.
        states = set(problem.plant.states)
        known = {s: np.asarray(v)[:: found.substeps] for s, v in found.known.items() if s in states}
        self._known = [(problem.plant.states.index(s), v) for s, v in known.items()]
        self._read = ObservedState(problem, symbols - known.keys())
        self._center, self._half = (np.array(part) for part in center_and_half_width(problem))
        self._read_table: tuple[ValueTable, LookAhead] | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the table, which another process reads from the cache."""
        return {**self.__dict__, "_read_table": None}

    @property
    def table(self) -> ValueTable:
        """The table; computed at the first use."""
        return self._known_table()[0]

    @property
    def look_ahead(self) -> LookAhead:
        """What reads the table; computed at the first use."""
        return self._known_table()[1]

    def prepare(self, progress: Callable[[float], None] | None = None) -> None:
        """Compute the table, or read it; see `Policy.prepare`."""
        self._known_table(progress)

    def _known_table(
        self, progress: Callable[[float], None] | None = None
    ) -> tuple[ValueTable, LookAhead]:
        if self._read_table is None:
            table = table_for(self.problem, self.settings, progress, self._file)
            self._read_table = table, LookAhead(table, self.problem)
        return self._read_table

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, Any]:
        """Choose actions; see `Policy.predict`.

        Args:
            observation: one observation (k,) or a batch (B, k).
            state: what was returned for the observation before; None at the first one.
            episode_start: whether each episode starts here.
            deterministic: makes no difference.

        Returns:
            Actions, shape (m,) or (B, m), and the number of the control instant that comes next,
            shape (B,), with B = 1 for one observation.

        Raises:
            InvalidInputError: The observation has another shape than (k,) or (B, k).
        """
        given = checked_observation(observation, len(self.problem.features))
        rows = np.atleast_2d(given)
        periods = np.zeros(len(rows), dtype=np.int64)
        if state is not None:
            periods += state
            if episode_start is not None:
                periods[np.broadcast_to(episode_start, periods.shape)] = 0
        inputs = self._inputs(periods, rows)
        actions = np.clip((inputs - self._center) / self._half, -1.0, 1.0)
        return actions.reshape(*given.shape[:-1], -1), periods + 1

    def _inputs(self, periods: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Return inputs in physical units (B, m) at control instants (B,)."""
        k = np.minimum(periods, self.look_ahead.steps - 1)
        x = list(self._read(rows))
        for i, values in self._known:
            x[i] = values[k]
        return self.look_ahead.best_input(k, tuple(x))[0]
