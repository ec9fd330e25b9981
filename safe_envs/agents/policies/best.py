"""The policy that is as safe as a table of a problem's value shows to be possible."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from safe_envs.agents.policies.base import ObservedState, Policy, checked_observation
from safe_envs.envs.spaces import center_and_half_width
from safe_envs.problem.measurement import require_full_state
from safe_envs.problem.problem import SafetyProblem
from safe_envs.values.look_ahead import LookAhead
from safe_envs.values.reduction import reduced
from safe_envs.values.solve import table_for
from safe_envs.values.tables import ValueSettings, ValueTable


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
        ConfigurationError: The problem is measured, there is no table of it, as of one with too
            many states, or the observation does not determine a state that the table needs.
    """

    def __init__(
        self,
        problem: SafetyProblem,
        settings: ValueSettings | None = None,
        file: Path | None = None,
    ) -> None:
        require_full_state(problem, "policies of tables")
        self.problem, self._file = problem, file
        self.settings = settings or ValueSettings(knowledge="plant")
        asked = self.settings
        found = reduced(problem, asked.knowledge, asked.intervals, asked.specification)
        # The hidden state is the control instant, and with a specification that of its automaton.
        self._automaton = found.automaton
        self._states = 1 if found.automaton is None else found.automaton.size
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
            shape (B,), with B = 1 for one observation. With a specification that number is
            multiplied by the number of states of its automaton, and its state is added.

        Raises:
            InvalidInputError: The observation has another shape than (k,) or (B, k).
        """
        given = checked_observation(observation, len(self.problem.features))
        rows = np.atleast_2d(given)
        begun = 0 if self._automaton is None else self._automaton.initial
        hidden = np.full(len(rows), begun, dtype=np.int64)
        if state is not None:
            hidden[:] = state
            if episode_start is not None:
                hidden[np.broadcast_to(episode_start, hidden.shape)] = begun
        periods, a = np.divmod(hidden, self._states)
        inputs, a = self._inputs(periods, rows, a)
        actions = np.clip((inputs - self._center) / self._half, -1.0, 1.0)
        return actions.reshape(*given.shape[:-1], -1), (periods + 1) * self._states + a

    def _inputs(
        self, periods: np.ndarray, rows: np.ndarray, a: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return inputs in physical units (B, m) and the states of the automaton (B,)."""
        k = np.minimum(periods, self.look_ahead.steps - 1)
        x = list(self._read(rows))
        for i, values in self._known:
            x[i] = values[k]
        if self._automaton is None:
            return self.look_ahead.best_input(k, tuple(x))[0], a
        a = self.look_ahead.next_states(k, tuple(x), a)
        return self.look_ahead.best_input(k, tuple(x), a)[0], a
