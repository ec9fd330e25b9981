"""The batched face of a problem: a Gymnasium vector env without a loop over its envs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from safe_envs.dynamics.codegen import Components, constants, filled, finite, settled, stacked
from safe_envs.envs.env import SystemEnv, action_box, observation_box
from safe_envs.envs.episode import Episodes
from safe_envs.envs.info import Info, with_masks
from safe_envs.envs.seeding import Generators
from safe_envs.envs.simulation import NoiseStreams, Simulation, center_and_half_width, steps_until
from safe_envs.errors import ConfigurationError, InvalidInputError, NumericalError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.rendering.viewer import RENDER_MODES, frames_a_second, open_viewer
from safe_envs.validators import real_array

_LOWEST, _HIGHEST = constants((-1.0, 1.0))

VectorStep = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Info]


class SafeVectorEnv(gym.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """`num_envs` copies of a problem, stepped together.

    Env i, reset with seed s, follows the same trajectory as the scalar env reset with seed s + i,
    as in Gymnasium's own SyncVectorEnv, whatever `num_envs` is. Infos are those of `SafeEnv` with
    the batch in front.

    Attributes:
        executed: the components of the physical inputs of the last step.
        viewer: what is drawn, and its caption; None without a render mode.

    Args:
        problem: what to simulate.
        num_envs: size of the batch.
        autoreset_mode: when ended episodes start anew: "NextStep" (Gymnasium's default: the
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
        if not isinstance(num_envs, int) or num_envs < 1:
            raise ConfigurationError(f"num_envs = {num_envs!r}; give a whole number from 1")
        self.viewer = open_viewer(problem, render_mode, num_envs)
        self.render_mode = render_mode
        try:
            self._autoreset = AutoresetMode(autoreset_mode)
        except ValueError as error:
            allowed = ", ".join(mode.value for mode in AutoresetMode)
            raise ConfigurationError(
                f"autoreset_mode = {autoreset_mode!r}; allowed: {allowed}"
            ) from error
        self.problem = problem
        self.num_envs = num_envs
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
        self._noise = NoiseStreams(num_envs, self._simulation.integrator.channels)
        self._center, self._half = (constants(c) for c in center_and_half_width(problem))
        observed = {f.expression for f in problem.features}
        self._unobserved = [
            i for i, state in enumerate(problem.plant.states) if state not in observed
        ]
        self._limit = steps_until(problem, max_episode_steps)
        self._generators = Generators(num_envs)
        self.executed: Sequence[Any] = ()
        self._x: Components = ()
        self.episodes = Episodes(num_envs)

    @property
    def components(self) -> Components:
        """The exact states, an array of shape (num_envs,), not to be written to, for each of the
        problem's states."""
        if not self._x:
            raise gym.error.ResetNeeded("the envs have no state yet: call reset() first")
        return self._x

    @property
    def state(self) -> np.ndarray:
        """The exact states, shape (num_envs, n), in the units of the problem's states."""
        return np.stack(self.components, axis=-1)

    @property
    def np_random(  # pyright: ignore[reportIncompatibleMethodOverride]
        self,
    ) -> tuple[np.random.Generator, ...]:
        """The generator of each env."""
        self._seed([None] * self.num_envs)
        return tuple(self._generators.rngs)

    @property
    def np_random_seed(  # pyright: ignore[reportIncompatibleMethodOverride]
        self,
    ) -> tuple[int, ...]:
        """The seed of each env."""
        self._seed([None] * self.num_envs)
        return tuple(self._generators.seeds)

    def physical_action(self, actions: Any) -> Components:
        """Map actions in [-1, 1], shape (num_envs, m), to the components of the physical inputs,
        clipped to the box.

        Raises:
            InvalidInputError: the actions have another shape, or are not finite real numbers.
        """
        given = np.asarray(real_array("array of actions", actions), dtype=np.float64)
        if given.shape != self.action_space.shape:
            raise InvalidInputError(
                f"actions have shape {given.shape}; the envs take {self.action_space.shape}"
            )
        with np.errstate(over="ignore"):
            suspicious = not finite(given)
        if suspicious and not np.isfinite(given).all():
            bad = np.flatnonzero(~np.isfinite(given).all(axis=1))
            raise InvalidInputError(
                f"the actions of envs {bad[:5].tolist()} are not finite; give numbers in [-1, 1]"
            )
        clipped = np.minimum(np.maximum(given, _LOWEST), _HIGHEST)
        return tuple(
            [
                c + w * clipped[:, j] if c else w * clipped[:, j]
                for j, (c, w) in enumerate(zip(self._center, self._half, strict=True))
            ]
        )

    def normalized_action(self, physical: Sequence[Any]) -> np.ndarray:
        """Inverse of `physical_action`, in double precision."""
        actions = np.empty((self.num_envs, len(physical)))
        for j, (u, c, w) in enumerate(zip(physical, self._center, self._half, strict=True)):
            np.divide(u - c, w, out=actions[:, j])
        return actions

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, Info]:
        """Start episodes in every env, or in those of `options["reset_mask"]`.

        Args:
            seed: seed of env 0, with env i seeded by seed + i, or a seed (or None) for each env.
            options: may hold "reset_mask", a bool array of shape (num_envs,).
        """
        seeds = self._generators.spread(seed)
        mask = self._reset_mask(options)
        self._seed([s if m else None for s, m in zip(seeds, mask.tolist(), strict=True)])
        self._restart(np.flatnonzero(mask))
        observation, _, _, _, info = self._observe(tuple(self._center), counted=mask)
        if self.viewer is not None:
            self.viewer.restart(
                self.state, self.episodes.steps * self.problem.dt, np.flatnonzero(mask).tolist()
            )
        return observation, with_masks(info, mask)

    def snapshot(self) -> dict[str, np.ndarray]:
        """Where each episode stands: arrays with the batch in front, from which `restore` goes on."""
        return {"state": self.state, **self.episodes.snapshot()}

    def restore(
        self, snapshot: Mapping[str, np.ndarray], seed: int | Sequence[int | None] | None = None
    ) -> None:
        """Put each episode where a snapshot has it.

        Args:
            snapshot: of an env of the same problem and size.
            seed: of the noise and of the starts from then on; see `reset`. The generators are no
                part of a snapshot.

        Raises:
            InvalidInputError: the snapshot is of an env of another size or problem.
        """
        shape = np.shape(snapshot["state"])
        if shape != (self.num_envs, self.problem.plant.n):
            raise InvalidInputError(
                f"the snapshot has states of shape {shape}; these envs have"
                f" {(self.num_envs, self.problem.plant.n)}"
            )
        self._seed(self._generators.spread(seed))
        self._x = tuple(np.array(snapshot["state"], dtype=float).T.copy())
        self.episodes.restore(snapshot)
        if self.viewer is not None:
            self.viewer.restart(
                self.state, self.episodes.steps * self.problem.dt, range(self.num_envs)
            )

    def step(self, actions: Any) -> VectorStep:
        """Hold an action in each env for one control period.

        Raises:
            InvalidInputError: see `physical_action`.
            NumericalError: the state of an env is not finite any more.
            ResetNeeded: an episode has ended, and autoreset is disabled.
        """
        return self.step_physical(self.physical_action(actions))

    def step_physical(self, u: Sequence[Any]) -> VectorStep:
        """`step` for the components of physical inputs inside the box, as a filter has them."""
        x = self.components
        self.executed = u
        episodes = self.episodes
        due = episodes.due()
        if due is not None and self._autoreset == AutoresetMode.DISABLED:
            raise gym.error.ResetNeeded(
                f"the episodes of envs {np.flatnonzero(due)[:5].tolist()} have ended: reset them"
            )
        draws = self._noise.next(self._generators.rngs, None if due is None else ~due)
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
                observation, _, _, _, info = self._observe(tuple(self._center), counted=ended)
            episodes.begun = ended
        else:
            episodes.ended = ended
        if self.viewer is not None:
            self.viewer.advance(
                self.state,
                episodes.steps * self.problem.dt,
                np.stack(u, axis=-1),
                np.flatnonzero(episodes.begun).tolist(),
            )
        return (
            observation,
            reward,
            terminated,
            truncated,
            {**with_masks(info, episodes.everywhere.copy()), **last},
        )

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
        if not self._x:
            raise gym.error.ResetNeeded("the envs have no state yet: call reset() first")
        return self.viewer.frames()

    def _last_of_episode(self, ended: np.ndarray, observation: np.ndarray, info: Info) -> Info:
        """Keep what the ended envs showed last, and restart them."""
        final = np.full(self.num_envs, None, dtype=object)
        for i in np.flatnonzero(ended).tolist():
            final[i] = observation[i]
        self._restart(np.flatnonzero(ended))
        return with_masks({"final_obs": final, "final_info": with_masks(info, ended)}, ended)

    def _seed(self, seeds: Sequence[int | None]) -> None:
        self._noise.clear(self._generators.seed(seeds))

    def _reset_mask(self, options: Mapping[str, Any] | None) -> np.ndarray:
        given = (options or {}).get("reset_mask")
        if given is None:
            return self.episodes.everywhere.copy()
        mask = np.asarray(given)
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_ or not mask.any():
            raise ConfigurationError(
                f"reset_mask must be a bool array of shape ({self.num_envs},) with a True in it;"
                f" given {given!r}"
            )
        if not self._x and not mask.all():
            raise gym.error.ResetNeeded(
                "some envs have no state yet: the first reset takes no reset_mask"
            )
        return mask

    def _restart(self, envs: np.ndarray) -> None:
        """Put some envs at the start of an episode."""
        start = self._simulation.starts.draw_batch(
            [self._generators.rngs[i] for i in envs.tolist()]
        )
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
        time = self.episodes.steps * self.problem.dt if self._simulation.timed else 0.0
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
        return (
            observation,
            filled(reward, (self.num_envs,)).copy(),
            terminated,
            self.episodes.steps >= self._limit,
            info,
        )

    def _report_breakdown(self, h: np.ndarray, observation: np.ndarray) -> None:
        broken = ~(
            np.isfinite(self._x).all(axis=0) & np.isfinite(h) & np.isfinite(observation).all(axis=1)
        )
        if broken.any():
            raise NumericalError(
                f"the states of envs {np.flatnonzero(broken)[:5].tolist()} of {self.problem.name!r}"
                " have left the finite numbers; reduce dt or raise substeps"
            )


class SystemVectorEnv(SafeVectorEnv):
    """Base of the registered vector envs.

    Args:
        num_envs: see `SafeVectorEnv`.
        autoreset_mode: see `SafeVectorEnv`.
        max_episode_steps: see `SafeVectorEnv`.
        render_mode: see `SafeVectorEnv`.
        **options: as for `SystemEnv`.
    """

    env_class: ClassVar[type[SystemEnv]]

    def __init__(
        self,
        num_envs: int = 1,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        problem = self.env_class.make_problem(**options)
        super().__init__(problem, num_envs, autoreset_mode, max_episode_steps, render_mode)
