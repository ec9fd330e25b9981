"""Episodes that can be resumed at each instant at which their score was a record."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from safe_envs.agents.evaluation.brownian_bridge import BrownianBridge, smallest
from safe_envs.agents.evaluation.targets import Env
from safe_envs.agents.policies.base import Policy
from safe_envs.errors import ConfigurationError
from safe_envs.wrappers.env_wrappers.safety_filter_vector import readable

MakeTiltedEnv = Callable[[np.ndarray], Env]
"""Makes a filtered `TiltedNoiseEnv` with drifts of given lengths."""

_FIRST_ROOM = 64
_FEWEST_ENVS = 64


class Records:
    """The instants at which each path was nearer to a violation than ever before.

    Arrays grow as they fill.

    Args:
        paths: how many.
        states: entries of a state.
        features: entries of an observation.
    """

    def __init__(self, paths: int, states: int, features: int) -> None:
        self._count = np.zeros(paths, dtype=np.int64)
        shape = (_FIRST_ROOM, paths)
        # Height, control instant, whether the episode ended, state, observation and integrals.
        self._kept = [
            np.full(shape, -np.inf),
            np.zeros(shape, dtype=np.int64),
            np.zeros(shape, dtype=bool),
            np.zeros((*shape, states)),
            np.zeros((*shape, features), dtype=np.float32),
            np.zeros((*shape, 2)),
        ]

    def clear(self, paths: np.ndarray) -> None:
        """Forget the records of some paths."""
        self._count[paths] = 0
        self._kept[0][:, paths] = -np.inf

    def add(self, paths: np.ndarray, *entries: np.ndarray) -> None:
        """Note a record of each of some paths.

        Args:
            paths: which.
            *entries: height, control instant, whether the episode ended there, state, observation,
              and `TiltedNoiseEnv.girsanov_integrals`.
        """
        rows = self._count[paths]
        if rows.size and int(rows.max()) == len(self._kept[0]):
            self._grow()
        for kept, values in zip(self._kept, entries, strict=True):
            kept[rows, paths] = values
        self._count[paths] += 1

    def first_below(self, levels: np.ndarray, paths: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the first records of paths below levels, as the arguments of `add`.

        Args:
            levels: heights, shape (B,).
            paths: shape (B,).
        """
        # Records fall along the first axis, and what was not filled is lower than all.
        rows = (self._kept[0][:, paths] >= levels).sum(axis=0)
        return tuple(kept[rows, paths] for kept in self._kept)

    def last(self, paths: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the last records of paths, in the order of the arguments of `add`."""
        return tuple(kept[self._count[paths] - 1, paths] for kept in self._kept)

    def _grow(self) -> None:
        self._kept = [
            np.concatenate([old, np.full_like(old, 0 if i else -np.inf)])
            for i, old in enumerate(self._kept)
        ]


class Particles:
    """Paths of a policy in an env, up to their first violations.

    The height of a path at control instant k of K is its smallest h since the last one, times (1 -
    k/(K + 1))^-p: for p = 0 that is h, and for p = 1/2 it is h against what a Brownian motion may
    do in the time that is left. It is 0 or less at a violation. Of several barriers, which may have
    units of their own, each is divided by its mean at the starts.

    Noise is drawn by the envs, whose generators are seeded once and run on, so that paths that were
    taken up again get fresh noise. What comes of it depends on the seed, and on the number of paths
    and of envs.

    Args:
        make: envs for the paths, made without a drift.
        policy: anything with Stable-Baselines3's `predict`, without memory.
        powers: p of each path.
        seed: of all randomness.
        num_envs: the most episodes side by side.
        bridge: gives the minimum h between control instants too.

    Attributes:
        lowest: smallest height of each path, shape (paths,).
        steps: control periods that were simulated.
        outside: how many paths start where h <= 0.
        kept_length: mean length of the paths from the starts that do not violate, in control
            periods; None without any.
    """

    def __init__(
        self,
        make: MakeTiltedEnv,
        policy: Any,
        powers: np.ndarray,
        seed: np.random.SeedSequence,
        num_envs: int,
        bridge: BrownianBridge | None = None,
    ) -> None:
        self.lowest = np.full(len(powers), np.inf)
        self.steps = self.outside = 0
        self.kept_length: float | None = None
        self._make, self._policy, self._bridge = make, policy, bridge
        self._envs: dict[int, Env] = {}
        self._largest = min(num_envs, len(powers))
        self._seed, self._generator = seed, np.random.default_rng(seed.spawn(1)[0])
        world: Any = readable(self._env(self._largest))
        self._horizon = world.problem.steps
        self._units = np.ones(len(world.problem.barriers))
        kinds, self._kind = np.unique(powers, return_inverse=True)
        left = 1.0 - np.arange(self._horizon + 1) / (self._horizon + 1)
        self._weights = left[:, None] ** -kinds
        self._records = Records(len(powers), world.problem.plant.n, len(world.problem.features))

    def begin(self) -> None:
        """Simulate all paths from their starts."""
        paths = np.arange(len(self.lowest))
        lengths = np.zeros(len(paths), dtype=np.int64)
        for first in range(0, len(paths), self._largest):
            some = paths[first : first + self._largest]
            env = self._env(len(some))
            observation, info = env.reset()
            world: Any = readable(env)
            count = len(some)
            if first == 0 and len(self._units) > 1:
                at_start = info["barrier"].mean(axis=0)
                self._units = np.where(at_start > 0.0, at_start, 1.0)
            h = smallest(info["barrier"][:count] / self._units)
            # At the start the weight is 1.
            begun = (
                h,
                np.zeros(count, dtype=np.int64),
                np.zeros(count, dtype=bool),
                world.state[:count],
                observation[:count],
                world.girsanov_integrals[:count],
            )
            self.outside += int(np.count_nonzero(h <= 0.0))
            lengths[some] = self._play(env, some, observation, begun)
        kept = lengths[self.lowest > 0.0]
        self.kept_length = float(kept.mean()) if kept.size else None

    def h_at_lowest(self, paths: np.ndarray) -> np.ndarray:
        """Return h of paths where their heights were smallest, shape as given.

        Of several barriers it is relative to the starts.
        """
        return self.lowest[paths] / self._weights[self._records.last(paths)[1], self._kind[paths]]

    def girsanov_integrals(self, paths: np.ndarray) -> np.ndarray:
        """Return `girsanov_integrals` of paths where their heights were smallest, shape (B, 2)."""
        return self._records.last(paths)[5]

    def branch(self, paths: np.ndarray, parents: np.ndarray, levels: np.ndarray) -> None:
        """Replace paths by what goes on from where others of the same p first fell below levels.

        Args:
            paths: those that are replaced, shape (B,).
            parents: those that are continued, none of which is replaced, shape (B,).
            levels: heights, each above its parent's smallest, shape (B,).
        """
        entries = self._records.first_below(levels, parents)
        # Paths that have equally far to go share a batch, which takes as long as the longest of
        # them.
        order = np.argsort(entries[1], kind="stable")
        self._records.clear(paths)
        for first in range(0, len(paths), self._largest):
            some = order[first : first + self._largest]
            self._resume(paths[some], tuple(entry[some] for entry in entries))

    def _resume(self, paths: np.ndarray, entries: tuple[np.ndarray, ...]) -> None:
        env: Any = self._env(len(paths))
        snapshot = env.snapshot()
        for name, values in (
            ("state", entries[3]),
            ("steps", entries[1]),
            ("girsanov_integrals", entries[5]),
        ):
            snapshot[name][:] = values[0]
            snapshot[name][: len(paths)] = values
        snapshot["ended"][:] = False
        env.restore(snapshot)
        observation = np.repeat(entries[4][:1], env.num_envs, axis=0)
        observation[: len(paths)] = entries[4]
        self._play(env, paths, observation, entries)

    def _play(
        self, env: Env, paths: np.ndarray, observation: np.ndarray, entries: tuple[np.ndarray, ...]
    ) -> np.ndarray:
        """Simulate paths in the first rows of an env until they end or violate; return when.

        They begin with entries of `Records.add`.
        """
        world: Any = readable(env)
        count, records, kind = len(paths), self._records, self._kind[paths]
        lowest, time, ended = entries[0].copy(), entries[1].copy(), entries[2]
        ends = time.copy()
        records.add(paths, *entries)
        alive = (lowest > 0.0) & ~ended
        barriers = None if self._bridge is None else self._bridge.barriers(world.components)
        if isinstance(self._policy, Policy):
            self._policy.begin(range(env.num_envs), int(self._generator.integers(2**63)))
        while alive.any():
            x = world.components
            observation, _, terminated, truncated, info = env.step(self._act(observation))
            time += 1
            ends[alive] = time[alive]
            h = smallest(self._lowest(x, barriers, info["barrier"])[:count] / self._units)
            height = h * self._weights[np.minimum(time, self._horizon), kind]
            barriers = info["barrier"]
            self.steps += int(np.count_nonzero(alive))
            fell = np.flatnonzero(alive & (height < lowest))
            ended = (terminated | truncated)[:count]
            if fell.size:
                lowest[fell] = height[fell]
                state = np.stack([component[fell] for component in world.components], axis=-1)
                records.add(
                    paths[fell],
                    height[fell],
                    time[fell],
                    ended[fell],
                    state,
                    observation[fell],
                    world.girsanov_integrals[fell],
                )
            alive &= (lowest > 0.0) & ~ended
        self.lowest[paths] = lowest
        return ends

    def _act(self, observation: np.ndarray) -> np.ndarray:
        actions, memory = self._policy.predict(
            observation, None, np.zeros(len(observation), dtype=bool), deterministic=True
        )
        if memory is not None:
            raise ConfigurationError(
                "the policy has a memory, which splitting cannot take up again; estimate with plain"
                " episodes"
            )
        return actions

    def _lowest(self, x: Any, before: np.ndarray | None, after: np.ndarray) -> np.ndarray:
        if self._bridge is None or before is None:
            return after
        return self._bridge.sample_minimum(
            x, before, after, self._generator.standard_exponential(after.shape)
        )

    def _env(self, count: int) -> Env:
        """Return an env with at least so many episodes side by side, seeded at its first use."""
        size = self._largest
        while size // 2 >= max(count, _FEWEST_ENVS):
            size //= 2
        if size not in self._envs:
            env = self._envs[size] = self._make(np.zeros(size))
            env.reset(seed=self._seed.spawn(1)[0].generate_state(size, np.uint64).tolist())
        return self._envs[size]
