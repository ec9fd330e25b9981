"""A problem as a Gymnasium vector env, without a loop over its envs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from safe_envs.dynamics.codegen import Components, filled, finite, settled, stacked
from safe_envs.envs.episode import Episodes
from safe_envs.envs.info import Info, with_masks
from safe_envs.envs.noise import NoiseStreams
from safe_envs.envs.seeding import EpisodeStreams, Seeds
from safe_envs.envs.simulation import Simulation, steps_until
from safe_envs.envs.spaces import BatchActions, action_box, observation_box
from safe_envs.errors import ConfigurationError, InvalidInputError, NumericalError, require_whole
from safe_envs.problem.problem import SafetyProblem
from safe_envs.rendering.viewer import RENDER_MODES, frames_a_second, open_viewer

VectorStep = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Info]


class SafeVectorEnv(gym.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """`num_envs` copies of a problem, stepped together.

    Env i, reset with seed s, follows the same trajectory as the scalar env reset with seed s + i,
    as in Gymnasium's own SyncVectorEnv, whatever `num_envs` is. Starts and noise are a function of
    an env's seed, the number of its episode since the seed, and the control period. Infos are those
    of `SafeEnv` with the batch in front.

    Attributes:
        executed: the components of the physical inputs of the last step.
        viewer: what is drawn, and its caption; None without a render mode.

    Args:
        problem: what to simulate.
        num_envs: size of the batch.
        autoreset_mode: when ended episodes restart: "NextStep" (Gymnasium's default: the
            following step ignores the action and returns the reset observation, with reward 0),
            "SameStep" (the last observation and info of the episode are in `infos["final_obs"]` and
            `infos["final_info"]`) or "Disabled" (reset by `options={"reset_mask": mask}`).
        max_episode_steps: truncate after so many control periods, if that is before the horizon.
        render_mode: "rgb_array" for pictures by `render()`, or None.

    Raises:
        ConfigurationError: an argument is out of range.
    """

    def __init__(
        self,
        problem: SafetyProblem,
        num_envs: int = 1,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
    ) -> None:
        require_whole("num_envs", num_envs, 1)
        self.viewer = open_viewer(problem, render_mode, num_envs)
        self.render_mode = render_mode
        self._autoreset = _mode(autoreset_mode)
        self.problem, self.num_envs = problem, num_envs
        self.metadata = {
            "render_modes": [*RENDER_MODES[1:]],
            "render_fps": frames_a_second(problem),
            "autoreset_mode": self._autoreset,
        }
        self.single_observation_space = self._bounds = observation_box(problem)
        self.single_action_space = action_box(problem)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._simulation = Simulation(problem, "arrays")
        self._actions = BatchActions(problem, num_envs)
        observed = {f.expression for f in problem.features}
        self._unobserved = [i for i, s in enumerate(problem.plant.states) if s not in observed]
        self._limit = steps_until(problem, max_episode_steps)
        self._streams = EpisodeStreams(num_envs)
        self._noise = NoiseStreams(self._streams, self._simulation.integrator.channels, self._limit)
        self.executed: Sequence[Any] = ()
        self._x: Components = ()
        self.episodes = Episodes(num_envs)

    @property
    def components(self) -> Components:
        """The exact states: for each state an array (num_envs,), not to be written to."""
        if not self._x:
            raise gym.error.ResetNeeded("the envs have no state yet: call reset() first")
        return self._x

    @property
    def state(self) -> np.ndarray:
        """The exact states, shape (num_envs, n), in the units of the problem's states."""
        return np.stack(self.components, axis=-1)

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

    def physical_action(self, actions: Any) -> Components:
        """Scale actions in [-1, 1] to physical inputs; see `BatchActions.physical`."""
        return self._actions.physical(actions)

    def normalized_action(self, physical: Sequence[Any]) -> np.ndarray:
        """Invert `physical_action`: return actions of shape (num_envs, m) in double precision."""
        return self._actions.normalized(physical)

    def reset(
        self, *, seed: Seeds = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, Info]:
        """Start episodes in every env, or in those of `options["reset_mask"]`.

        Args:
            seed: seed of env 0, with env i seeded by seed + i, or a seed (or None) for each env.
            options: may hold "reset_mask", a bool array of shape (num_envs,).

        Returns:
            The observations, float32 (num_envs, k), and the info.
        """
        seeds = self._streams.for_each_env(seed)
        mask = self.episodes.reset_mask((options or {}).get("reset_mask"))
        self._streams.seed([s if m else None for s, m in zip(seeds, mask.tolist(), strict=True)])
        self._restart(np.flatnonzero(mask))
        observation, _, _, _, info = self._observe(tuple(self._actions.center), counted=mask)
        if self.viewer is not None:
            self.viewer.restart(self.state, self._times, np.flatnonzero(mask).tolist())
        return observation, with_masks(info, mask)

    def snapshot(self) -> dict[str, np.ndarray]:
        """Return where each episode stands, in arrays with the batch in front; see `restore`."""
        return {"state": self.state, **self.episodes.snapshot()}

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
        self._x = tuple(np.array(snapshot["state"], dtype=float).T.copy())
        self.episodes.restore(snapshot)
        self._streams.begin_episodes(seeded)
        self._noise.seek(seeded, self.episodes.steps[seeded])
        if self.viewer is not None:
            self.viewer.restart(self.state, self._times, range(self.num_envs))

    def step(self, actions: Any) -> VectorStep:
        """Hold an action in each env for one control period.

        Raises:
            InvalidInputError: see `physical_action`.
            NumericalError: the state of an env is not finite any more.
            ResetNeeded: an episode has ended, and autoreset is disabled.
        """
        return self.step_physical(self.physical_action(actions))

    def step_physical(self, u: Sequence[Any]) -> VectorStep:
        """Step with components of physical inputs inside their bounds, as a filter returns them."""
        x = self.components
        self.executed = u
        episodes = self.episodes
        due = episodes.due()
        if due is not None and self._autoreset == AutoresetMode.DISABLED:
            raise gym.error.ResetNeeded(
                f"the episodes of envs {np.flatnonzero(due)[:5].tolist()} have ended: reset them"
            )
        draws = self._noise.next(None if due is None else ~due)
        # A state that overflows is found by `_observe`, which says so better than a warning.
        with np.errstate(over="ignore", invalid="ignore"):
            self._x = self._simulation.integrator.step(x, u, draws)
            episodes.steps += 1
            if due is not None:
                self._restart(np.flatnonzero(due))
            observation, reward, terminated, truncated, info = self._observe(u)
        if due is not None:
            reward = np.where(due, 0.0, reward)
        ended = terminated | truncated
        last: Info = {}
        if self._autoreset == AutoresetMode.SAME_STEP:
            if np.count_nonzero(ended):
                last = self._last_of_episode(ended, observation, info)
                observation, _, _, _, info = self._observe(
                    tuple(self._actions.center), counted=ended
                )
            episodes.begun = ended
        else:
            episodes.ended = ended
        if self.viewer is not None:
            begun = np.flatnonzero(episodes.begun).tolist()
            self.viewer.advance(self.state, self._times, np.stack(u, axis=-1), begun)
        info = {**with_masks(info, episodes.everywhere.copy()), **last}
        return observation, reward, terminated, truncated, info

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

    def _last_of_episode(self, ended: np.ndarray, observation: np.ndarray, info: Info) -> Info:
        """Keep the last observation and info of the ended envs, and restart them."""
        final = np.full(self.num_envs, None, dtype=object)
        for i in np.flatnonzero(ended).tolist():
            final[i] = observation[i]
        self._restart(np.flatnonzero(ended))
        return with_masks({"final_obs": final, "final_info": with_masks(info, ended)}, ended)

    @property
    def _times(self) -> np.ndarray:
        return self.episodes.steps * self.problem.dt

    def _restart(self, envs: np.ndarray) -> None:
        """Put some envs at the start of an episode."""
        begun = self._streams.begin_episodes(envs)
        self._noise.begin(envs)
        start = self._simulation.starts.draw_batch(self._streams.reader, *begun)
        if envs.size == self.num_envs:
            self._x = tuple(start)
        else:
            self._x = tuple([x.copy() for x in self._x])
            for x, fresh in zip(self._x, start, strict=True):
                x[envs] = fresh
        self.episodes.restart(envs)

    def _observe(self, u: Sequence[Any], counted: np.ndarray | None = None) -> VectorStep:
        """Read the states; `counted` are the envs whose states are new (None: all)."""
        self._x = x = settled(self.components, (self.num_envs,))
        time = self._times if self._simulation.timed else 0.0
        features, barriers, reward, outside, goal = self._simulation.measure(x, u, time)
        rows = np.empty((len(features), self.num_envs), dtype=np.float32)
        for row, feature in zip(rows, features, strict=True):
            row[:] = feature
        observation = rows.T
        barrier = stacked(barriers, self.num_envs)
        h = barriers[0] if len(barriers) == 1 else barrier.min(axis=1)
        info = self.episodes.count(barrier, h, counted)
        terminated = filled(outside > 0.0, (self.num_envs,))
        sound = finite(h) and finite(rows)
        for i in self._unobserved:
            sound = sound and finite(x[i])
        if np.count_nonzero(terminated):
            envs = np.flatnonzero(terminated)
            observation[envs] = np.clip(observation[envs], self._bounds.low, self._bounds.high)
        if not sound:
            self._report_breakdown(h, observation)
        if self.problem.goal is not None:
            terminated = terminated | (goal >= 0.0)
        reward = filled(reward, (self.num_envs,)).copy()
        return observation, reward, terminated, self.episodes.steps >= self._limit, info

    def _report_breakdown(self, h: np.ndarray, observation: np.ndarray) -> None:
        sound = np.isfinite(self._x).all(axis=0) & np.isfinite(observation).all(axis=1)
        broken = ~(sound & np.isfinite(h))
        if broken.any():
            raise NumericalError(
                f"the states of envs {np.flatnonzero(broken)[:5].tolist()} of {self.problem.name!r}"
                " have left the finite numbers; reduce dt or raise substeps"
            )


def _mode(given: str | AutoresetMode) -> AutoresetMode:
    try:
        return AutoresetMode(given)
    except ValueError as error:
        allowed = ", ".join(mode.value for mode in AutoresetMode)
        raise ConfigurationError(f"autoreset_mode = {given!r}; allowed: {allowed}") from error
