"""The states of a batch of envs, moved and read by compiled functions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from safe_envs.dynamics.codegen import Components
from safe_envs.engine.formulas import Source
from safe_envs.engine.program import Program
from safe_envs.engine.slots import Data
from safe_envs.envs import batch_kernel as layout
from safe_envs.envs.batch_kernel import PERIOD, PERIODS, STEPS, scaled_action, step_batch, within
from safe_envs.envs.episode import Episodes
from safe_envs.envs.info import Info, VectorStep, filter_info, safety_info
from safe_envs.envs.simulation import require_sound, start_sampler
from safe_envs.envs.spaces import BatchActions, center_and_half_width, observation_box
from safe_envs.envs.starts import EpisodeStreams, StartingPoints
from safe_envs.envs.world_source import noise_channels, world_source
from safe_envs.errors import NumericalError
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


def batch_source(problem: SafetyProblem, data: Data) -> Source:
    """Return the functions of `safe_envs.engine.slots` about tables, actions and observations.

    Args:
        problem: what to simulate.
        data: receives its numbers.
    """
    space = observation_box(problem)
    bounds = list(zip(space.low.tolist(), space.high.tolist(), strict=True))
    scales = list(zip(*center_and_half_width(problem), strict=True))
    return Source(
        f"def state_at(table, i):\n    return ({_entries(problem.plant.n)})\n"
        f"def input_at(table, i):\n    return ({_entries(len(scales))})\n"
        "def scaled_input(action, data):\n"
        f"    return ({_calls('scaled_action', 'action', scales, data)})\n"
        "def observation_within(observation, data):\n"
        f"    return ({_calls('within', 'observation', bounds, data)})\n",
        (scaled_action, within),
    )


def _entries(count: int) -> str:
    return "".join(f"table[i, {j}], " for j in range(count))


def _calls(function: str, array: str, numbers: list[tuple[float, float]], data: Data) -> str:
    """Return calls of a function with an entry of an array and two numbers each."""
    first = data.add([number for pair in numbers for number in pair])
    return "".join(
        f"{function}({array}[{i}], data[{first + 2 * i}], data[{first + 2 * i + 1}]), "
        for i in range(len(numbers))
    )


UNFILTERED = Source(
    "def decide(x, u, data, work):\n    return u, u, False, True, (0.0,), 0, True\n"
)

_GENERATED = ("_step", "_data", "_work")
"""Attributes of a stepper that follow from the problem and the filter."""


class BatchFilter(NamedTuple):
    """A filter that is to be part of the compiled function.

    Attributes:
        source: returns the function `decide` of `safe_envs.engine.slots`.
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
