"""A problem as a Gymnasium vector env, without a loop over its envs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from safe_envs.dynamics.codegen import Components
from safe_envs.engine.choice import compiled_or_none, require_engine
from safe_envs.envs.array_batch import ArrayBatch
from safe_envs.envs.compiled_batch import BatchFilter, BatchStepper, CompiledBatch
from safe_envs.envs.episode import Episodes, last_of_episode
from safe_envs.envs.info import Info, VectorStep, with_masks
from safe_envs.envs.sensor import Sample, read_only
from safe_envs.envs.simulation import steps_until
from safe_envs.envs.spaces import BatchActions, action_box, observation_box
from safe_envs.envs.spec import OwnSpec
from safe_envs.envs.starts import (
    EpisodeStreams,
    RequestedStart,
    ResetOptions,
    Seeds,
    StartingPoints,
)
from safe_envs.errors import (
    ConfigurationError,
    IndependentCopies,
    InvalidInputError,
    flag,
    require_whole,
)
from safe_envs.problem.problem import SafetyProblem
from safe_envs.rendering.viewer import RENDER_MODES, frames_a_second, open_viewer


def _mode(given: str | AutoresetMode) -> AutoresetMode:
    try:
        return AutoresetMode(given)
    except ValueError as error:
        allowed = ", ".join(mode.value for mode in AutoresetMode)
        raise ConfigurationError(f"autoreset_mode = {given!r}; allowed: {allowed}") from error


_Stepper = ArrayBatch | CompiledBatch | BatchStepper


class SafeVectorEnv(  # pyright: ignore[reportIncompatibleVariableOverride]
    OwnSpec, IndependentCopies, gym.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]
):
    """`num_envs` copies of a problem, stepped together.

    Env i, reset with seed s, follows the same trajectory as the scalar env reset with seed s + i,
    as in Gymnasium's own SyncVectorEnv, whatever `num_envs` is. Starts and noise are a function of
    an env's seed, the number of its episode since the seed, and the control period. Infos are those
    of `SafeEnv` with the batch in front.

    Attributes:
        problem: that is simulated.
        autoreset_mode: when ended episodes restart, as of Gymnasium's Sync- and AsyncVectorEnv.
        viewer: what is drawn, and its caption; None without a render mode.
        engine: that was asked for.

    Args:
        problem: what to simulate.
        num_envs: size of the batch.
        autoreset_mode: when ended episodes restart: "NextStep" (Gymnasium's default: the
            following step ignores the action and returns the reset observation, with reward 0),
            "SameStep" (the last observation and info of the episode are in `infos["final_obs"]` and
            `infos["final_info"]`) or "Disabled" (reset by `options={"reset_mask": mask}`).
        max_episode_steps: truncate after so many control periods, if that is before the horizon.
        render_mode: "rgb_array" for pictures by `render()`, or None.
        engine: "numpy"; "compiled" for one function that Numba compiles, several times faster for
            small batches and up to twice for thousands of envs, with results that differ by
            rounding; or "auto" for that where it can be had.
        terminate_on_violation: see `SafeEnv`.

    Raises:
        ConfigurationError: an argument is out of range, or Numba is missing.
    """

    def __init__(
        self,
        problem: SafetyProblem,
        num_envs: int = 1,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        engine: str = "numpy",
        terminate_on_violation: bool = False,
    ) -> None:
        require_whole("num_envs", num_envs, 1)
        self.viewer = open_viewer(problem, render_mode, num_envs)
        self.render_mode = render_mode
        self.autoreset_mode = _mode(autoreset_mode)
        self._limit = steps_until(problem, max_episode_steps)
        self.problem, self.num_envs = problem, num_envs
        self.metadata = {
            "render_modes": [*RENDER_MODES[1:]],
            "render_fps": frames_a_second(problem),
            "autoreset_mode": self.autoreset_mode,
        }
        self.single_observation_space = observation_box(problem)
        self.single_action_space = action_box(problem)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._actions = BatchActions(problem, num_envs)
        self._streams = EpisodeStreams(num_envs)
        self._ends_on_violation = flag("terminate_on_violation", terminate_on_violation)
        self.episodes = Episodes(num_envs)
        self._reset_options = ResetOptions(problem, self._limit, num_envs)
        require_engine(engine)
        self.engine = engine
        parts = (problem, self._streams, self.episodes, self._limit)
        compiled = compiled_or_none(engine, math.inf, lambda: CompiledBatch(*parts))
        self._batch = ArrayBatch(*parts) if compiled is None else compiled

    @property
    def np_random(self) -> tuple[np.random.Generator, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """A generator of each env, seeded as Gymnasium does; the env does not draw from it."""
        self._streams.seed([None] * self.num_envs)
        return self._streams.generators()

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The seed of each env."""
        self._streams.seed([None] * self.num_envs)
        return tuple(self._streams.seeds)

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Draw every env, with the trail of its episode and what a filter decided.

        Returns:
            For each env uint8 of shape (height, width, 3); None, with a warning, without a render
            mode.

        Raises:
            gymnasium.error.DependencyNotInstalled: pygame is missing.
            ResetNeeded: there is no state yet.
        """
        if self.viewer is None:
            gym.logger.warn(
                "render() draws nothing without a render mode; make the envs with"
                ' render_mode="rgb_array"'
            )
            return None
        return self.viewer.frames() if self.components else None

    def physical_action(self, actions: Any) -> Components:
        """Scale actions in [-1, 1] to physical inputs; see `BatchActions.physical`."""
        return self._actions.physical(actions)

    def normalized_action(self, physical: Sequence[Any]) -> np.ndarray:
        """Invert `physical_action`: return actions of shape (num_envs, m) in double precision."""
        return self._actions.normalized(physical)

    @property
    def components(self) -> Components:
        """The exact states: for each state an array (num_envs,), not to be written to."""
        if not self.episodes.started:
            raise _without_state()
        return self._batch.components

    @property
    def sent(self) -> Sequence[Any]:
        """The components of the physical inputs that the last step was given, read-only."""
        return read_only(self._batch.sent)

    @property
    def executed(self) -> Sequence[Any]:
        """The components of those that were executed in it, read-only; see `SafeEnv`."""
        return read_only(self._batch.executed)

    @property
    def measured(self) -> Sample | None:
        """What has arrived from the sensors, read-only; see `SafeEnv.measured`."""
        sensor = getattr(self._batch, "sensor", None)
        return None if sensor is None else Sample(*map(read_only, sensor.sample))

    @property
    def state(self) -> np.ndarray:
        """The exact states, shape (num_envs, n), in the units of the problem's states.

        They can be set within episodes, by an array (n,) for all envs too; see `SafeEnv.state`.
        """
        found = np.stack(self.components, axis=-1)
        # Writing to a copy would do nothing, and nobody would notice.
        found.flags.writeable = False
        return found

    @state.setter
    def state(self, given: Any) -> None:
        before = self.state
        states = self._reset_options.states(given)
        moved = (states != before).any(axis=1)
        self._batch.place(states, [])
        self.episodes.place(moved)
        if self.viewer is not None:
            self.viewer.restart(states, self._times, np.flatnonzero(moved).tolist())

    def reset(
        self, *, seed: Seeds = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, Info]:
        """Start episodes in every env, or in those of `options["reset_mask"]`.

        Args:
            seed: seed of env 0, with env i seeded by seed + i, or a seed (or None) for each env.
            options: those of `SafeEnv.reset`, where the state may also have the shape (num_envs, n)
                and the time (num_envs,); and "reset_mask", a bool array (num_envs,).

        Returns:
            The observations, float32 (num_envs, k), and the info.

        Raises:
            ConfigurationError: an option is unknown, or does not go with another.
            InvalidInputError: a state or a time is not allowed.
        """
        return self.reset_filtered(self._batch, seed, options)

    def snapshot(self) -> dict[str, np.ndarray]:
        """Return where each episode stands, in arrays with the batch in front; see `restore`."""
        return {"state": self.state.copy(), **self.episodes.snapshot(), **self._batch.snapshot()}

    def restore(self, snapshot: Mapping[str, np.ndarray], seed: Seeds = None) -> None:
        """Put each episode where a snapshot has it.

        Args:
            snapshot: of an env of the same problem and size.
            seed: whose first episode has the noise from the snapshot's control period on; see
                `reset`. Without a seed the noise goes on where it is: it is not in a snapshot.

        Raises:
            InvalidInputError: the snapshot is of an env of another size or problem.
        """
        shape = np.shape(snapshot["state"])
        if shape != (self.num_envs, self.problem.plant.n):
            raise InvalidInputError(
                f"the snapshot has states of shape {shape}; these envs have"
                f" {(self.num_envs, self.problem.plant.n)}"
            )
        seeded = self._streams.seed(self._streams.for_each_env(seed))
        self.episodes.restore(snapshot)
        self._streams.begin_episodes(seeded)
        self._batch.place(snapshot["state"], seeded)
        self._batch.restore(snapshot)
        if self.viewer is not None:
            self.viewer.restart(self.state, self._times, range(self.num_envs))

    def step(self, actions: Any) -> VectorStep:
        """Hold an action in each env for one control period.

        Raises:
            InvalidInputError: see `physical_action`.
            NumericalError: the state of an env is not finite any more.
            ResetNeeded: an episode has ended, and autoreset is disabled.
        """
        return self._told(self._batch, self._batch.step(actions, self._due()))

    def step_physical(self, u: Sequence[Any]) -> VectorStep:
        """Step with components of physical inputs inside their bounds, as a filter returns them."""
        return self._told(self._batch, self._batch.step_physical(u, self._due()))

    def step_filtered(self, stepper: BatchStepper, actions: Any) -> VectorStep:
        """Step with actions in [-1, 1], which a filter corrects.

        Args:
            stepper: of `filtered`.
            actions: see `step`.

        Returns:
            As `step`; the info has what the filter reports.
        """
        return self._told(stepper, stepper.step(actions, self._due()))

    def reset_filtered(
        self, stepper: _Stepper, seed: Seeds = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, Info]:
        """Start episodes as `reset` does; the info has what the filter reports.

        Args:
            stepper: of `filtered`, or the batch itself.
            seed: see `reset`.
            options: see `reset`.

        Returns:
            The observations and the info.
        """
        seeds = self._streams.for_each_env(seed)
        mask = self.episodes.reset_mask(self._reset_options.checked(options).get("reset_mask"))
        requested = self._reset_options.read(options, mask)
        self._streams.seed([s if m else None for s, m in zip(seeds, mask.tolist(), strict=True)])
        points = None if requested is None else self._points(requested, mask)
        observation, _, _, _, info = stepper.begin(mask, points)
        if self.viewer is not None:
            self.viewer.restart(self.state, self._times, np.flatnonzero(mask).tolist())
        return observation, with_masks(info, mask)

    def filtered(self, batch_filter: BatchFilter) -> BatchStepper | None:
        """Return what steps these envs with a filter in one compiled function.

        Returns:
            None where NumPy has to filter.

        Raises:
            NotCompilableError: The compiled engine was asked for, and cannot do the filter.
        """
        if not isinstance(self._batch, CompiledBatch) or self.viewer is not None:
            return None
        batch = self._batch
        return compiled_or_none(self.engine, math.inf, lambda: batch.filtered(batch_filter))

    def _points(self, requested: RequestedStart, mask: np.ndarray) -> StartingPoints:
        """Return where the envs of a mask begin."""
        states, streams = requested.states, self._streams
        if states is None:
            envs = np.flatnonzero(mask)
            keys, episodes = [streams.keys[i] for i in envs], streams.episodes[envs] + 1
            sampler = self._reset_options.sampler(requested.start)
            states = np.empty((self.num_envs, self.problem.plant.n))
            states[envs] = sampler.draw_batch(streams.reader, keys, episodes.tolist()).T
        return StartingPoints(states, requested.steps)

    def _due(self) -> np.ndarray | None:
        """Return the envs whose coming step begins an episode; None for none."""
        if not self.episodes.started:
            raise _without_state()
        due = self.episodes.due()
        if due is not None and self.autoreset_mode == AutoresetMode.DISABLED:
            raise gym.error.ResetNeeded(
                f"the episodes of envs {np.flatnonzero(due)[:5].tolist()} have ended: reset them"
            )
        return due

    def _told(
        self, stepper: ArrayBatch | CompiledBatch | BatchStepper, found: VectorStep
    ) -> VectorStep:
        """Return what a step tells, with autoreset."""
        observation, reward, terminated, truncated, info = found
        episodes = self.episodes
        if self._ends_on_violation:
            # A step that begins an episode is none of it, wherever it begins.
            terminated = terminated | (info["violation"] & ~episodes.begun)
        ended = terminated | truncated
        last: Info = {}
        if self.autoreset_mode == AutoresetMode.SAME_STEP:
            if np.count_nonzero(ended):
                last = last_of_episode(ended, observation, info)
                episodes.keep_last(self.state, self.measured)
                observation, _, _, _, info = stepper.begin(ended)
            episodes.begun = ended
        else:
            episodes.ended = ended
        if self.viewer is not None:
            begun = np.flatnonzero(episodes.begun).tolist()
            self.viewer.advance(self.state, self._times, np.stack(self.executed, axis=-1), begun)
        info = with_masks(info, episodes.everywhere)
        if last:
            info.update(last)
        return observation, reward, terminated, truncated, info

    @property
    def _times(self) -> np.ndarray:
        return self.episodes.steps * self.problem.dt


def _without_state() -> gym.error.ResetNeeded:
    return gym.error.ResetNeeded("the envs have no state yet: call reset() first")
