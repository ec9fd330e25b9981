"""A batch of envs, stepped by one compiled function."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from safe_envs.compiled.data import Data
from safe_envs.compiled.formulas import Source
from safe_envs.compiled.program import Program
from safe_envs.dynamics.codegen import Components
from safe_envs.envs import batch_layout as layout
from safe_envs.envs.batch_kernel import step_batch
from safe_envs.envs.batch_source import batch_source
from safe_envs.envs.batch_state import BatchState
from safe_envs.envs.info import Info, VectorStep, filter_info, safety_info
from safe_envs.envs.reset_options import StartingPoints
from safe_envs.envs.simulation import require_sound, start_sampler
from safe_envs.envs.world_source import world_source
from safe_envs.errors import NumericalError

UNFILTERED = Source(
    "def decide(x, u, data, work):\n    return u, u, False, True, (0.0,), 0, True\n"
)

_GENERATED = ("_step", "_data", "_work")
"""Attributes of a stepper that follow from the problem and the filter."""


class BatchFilter(NamedTuple):
    """A filter that is to be part of the compiled function.

    Attributes:
        source: returns the function `decide` of `safe_envs.compiled.slots`.
        decide: the same filter in NumPy, which says what is wrong where `decide` has no value.
        rest: what it reports at reset: proposed input, executed input, slack and slacks.
    """

    source: Callable[[Data], Source]
    decide: Callable[[Components, Components], Any]
    rest: np.ndarray


class BatchStepper:
    """Steps a batch of envs by one compiled function, with a filter or without one.

    Attributes:
        tallies: interventions and infeasible steps of each episode, int64 (num_envs, 2).

    Args:
        batch: the envs.
        batch_filter: None for none.

    Raises:
        ConfigurationError: Numba is missing.
        NotCompilableError: The filter cannot be compiled.
    """

    def __init__(self, batch: BatchState, batch_filter: BatchFilter | None) -> None:
        self._batch, self._filter = batch, batch_filter
        problem = batch.problem
        n, m = batch.shape
        self._rest = np.empty(0) if batch_filter is None else batch_filter.rest
        self._generate()
        self._nowhere = np.zeros(n, dtype=bool)
        self._nothing = np.zeros(batch.shape)
        self._observation_shape = (n, len(problem.features))
        self._reading_shape = (n, layout.BARRIERS + len(problem.barriers))
        self._rows = n if batch_filter is not None else 0
        self._width = m + len(self._rest)
        self.tallies = np.zeros((self._rows, 2), dtype=np.int64)
        self._told = self._at_rest()

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without what is compiled, which a copy makes itself."""
        return {key: value for key, value in vars(self).items() if key not in _GENERATED}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._generate()

    def _generate(self) -> None:
        """Make the compiled function, its numbers and its scratch array."""
        problem, batch_filter, data = self._batch.problem, self._filter, Data()
        generated = world_source(problem, data) + batch_source(problem, data)
        generated += UNFILTERED if batch_filter is None else batch_filter.source(data)
        title = f"{problem.name} in batches" + " with a filter" * (batch_filter is not None)
        program = Program(title, [step_batch], generated)
        self._step: Callable[..., int] = program.compiled()["step_batch"]
        self._data, self._work = data.array(), np.empty(max(generated.work, 1))

    def begin(self, envs: np.ndarray, points: StartingPoints | None = None) -> VectorStep:
        """Begin the next episode of some envs; the others keep what their filter told.

        Args:
            envs: which, bool (num_envs,).
            points: where; None for draws from the problem's distribution.

        Returns:
            What is read off the states.
        """
        return self._run(self._nothing, True, False, envs, points)

    def step(self, actions: Any, due: np.ndarray | None) -> VectorStep:
        """Hold actions in [-1, 1]; see `ArrayBatch.step`."""
        return self._run(self._batch.actions.checked(actions), False, True, due)

    def hold(self, given: np.ndarray, scaled: bool, due: np.ndarray | None) -> VectorStep:
        """Hold actions for one control period.

        Args:
            given: actions in [-1, 1] or physical inputs, shape (num_envs, m).
            scaled: whether they are physical inputs.
            due: see `ArrayBatch.step_physical`.

        Returns:
            What is read off the states.

        Raises:
            InvalidInputError: An action is not finite.
            NumericalError: A state is not finite any more, or the filter has no finite value.
        """
        return self._run(given, scaled, True, due)

    def _run(
        self,
        given: np.ndarray,
        scaled: bool,
        stepping: bool,
        restarts: np.ndarray | None,
        points: StartingPoints | None = None,
    ) -> VectorStep:
        batch, filtered = self._batch, self._filter is not None
        # For an array that cannot be written to, Numba would compile once more.
        given = given if given.flags.carray else given.copy()
        if restarts is not None:
            restarts = restarts if restarts.flags.carray else restarts.copy()
            batch.streams.begin_episodes(np.flatnonzero(restarts))
        n, problem = len(given), batch.problem
        states, counts = np.empty(batch.states.shape), np.empty((n, 2), dtype=np.int64)
        tallies = np.empty((self._rows, 2), np.int64) if stepping else self.tallies.copy()
        told = self._new_told() if stepping else self._told.copied()
        observations, rewards = np.empty(self._observation_shape, np.float32), np.empty(n)
        readings = np.empty(self._reading_shape)
        before = batch.before(restarts, points)
        status = self._step(
            given,
            scaled,
            stepping,
            filtered,
            points is not None,
            self._nowhere if restarts is None else restarts,
            *batch.settings,
            batch.streams.words,
            batch.streams.episodes,
            batch.chunks,
            batch.noise,
            batch.uniforms,
            self._work,
            self._data,
            self._rest,
            *before,
            self.tallies,
            states,
            counts,
            tallies,
            told.inputs,
            told.choices,
            told.flags,
            observations,
            rewards,
            readings,
        )
        if status not in (layout.DONE, layout.NOT_FINITE):
            self._refuse(status, given, restarts)
        batch.commit(states, counts, restarts)
        # What the caller gets of the filter is the caller's; of the other parts nothing is kept.
        own = told.copied() if filtered else told
        if stepping:
            batch.inputs = own.inputs
        if status:
            require_sound(batch.components, observations, rewards, problem)
        # As with NumPy's filter, a step that raises is in no count of the filter.
        self.tallies, self._told = tallies, own
        flags = told.flags
        info = self._info(readings, told)
        return observations, rewards, flags[layout.TERMINATED], flags[layout.TRUNCATED], info

    def _new_told(self) -> _Told:
        n = len(self._nowhere)
        return _Told(
            np.empty((n, self._width)),
            np.empty((self._rows, 3), dtype=np.int64),
            np.empty((7, n), dtype=bool),
        )

    def _at_rest(self) -> _Told:
        """Return the report of envs whose filter has decided nothing yet."""
        inputs, choices, flags = told = self._new_told()
        inputs[:] = [0.0] * self._batch.shape[1] + self._rest.tolist()
        choices[:] = [0, 0, -1]
        flags[:] = False
        flags[layout.FEASIBLE] = True
        return told

    def _info(self, readings: np.ndarray, told: _Told) -> Info:
        inputs, choices, flags = told
        _, _, _, violation, intervention, active, feasible = flags
        info = safety_info(
            violation,
            readings[:, layout.COST],
            readings[:, layout.BARRIERS :],
            readings[:, layout.H_MIN],
            readings[:, layout.EPISODE_COST],
        )
        if self._filter is not None:
            m = self._batch.shape[1]
            interventions, infeasible, active_barrier = choices.T
            info |= filter_info(
                nominal_action=inputs[:, m : 2 * m],
                safe_action=inputs[:, 2 * m : 3 * m],
                intervention=intervention,
                filter_active=active,
                feasible=feasible,
                slack=inputs[:, 3 * m],
                slacks=inputs[:, 3 * m + 1 :],
                active_barrier=active_barrier,
                episode_interventions=interventions,
                episode_infeasible=infeasible,
            )
        return info

    def _refuse(self, status: int, given: np.ndarray, restarts: np.ndarray | None) -> None:
        """Raise what the envs raise in NumPy; nothing has happened."""
        batch = self._batch
        chosen = [] if restarts is None else np.flatnonzero(restarts)
        if status == layout.NO_START:
            start_sampler(batch.problem).draw_batch(
                batch.streams.reader,
                [batch.streams.keys[i] for i in chosen],
                batch.streams.episodes[chosen].tolist(),
            )
        batch.streams.episodes[chosen] -= 1
        proposed = batch.actions.physical(given)
        if self._filter is not None:
            self._filter.decide(batch.components, proposed)
        raise NumericalError(
            f"the compiled engine finds no finite numbers in {batch.problem.name!r} where NumPy"
            " does; use the engine 'numpy'"
        )


class _Told(NamedTuple):
    """What a step tells about inputs; see `batch_kernel.step_batch`."""

    inputs: np.ndarray
    choices: np.ndarray
    flags: np.ndarray

    def copied(self) -> _Told:
        return _Told(self.inputs.copy(), self.choices.copy(), self.flags.copy())
