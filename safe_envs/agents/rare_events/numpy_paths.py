"""Paths side by side in vector envs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.agents.evaluation.brownian_bridge import BrownianBridge, Exponentials
from safe_envs.agents.evaluation.resolve import Env
from safe_envs.agents.jobs import job
from safe_envs.agents.policies.base import Policy
from safe_envs.agents.rare_events.splitting import Heights, Records
from safe_envs.dynamics.codegen import compile_function, stacked
from safe_envs.dynamics.defined import BarrierFunction
from safe_envs.dynamics.lie import gradient
from safe_envs.dynamics.noise import NOISE, standard_normals
from safe_envs.envs.simulation import Simulation
from safe_envs.envs.spaces import center_and_half_width
from safe_envs.envs.starts import EpisodeStreams
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.envs.world_source import noise_channels
from safe_envs.errors import ConfigurationError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.safety_filter import readable

MakeTiltedEnv = Callable[[np.ndarray], Env]
"""Makes a filtered `TiltedNoiseEnv` with drifts of given lengths."""

_FEWEST_ENVS = 64


class NumpyPaths:
    """Simulates paths in vector envs.

    Args:
        problem: what they simulate.
        make: makes them.
        policy: anything with Stable-Baselines3's `predict`, without memory.
        num_envs: the most paths side by side, which changes nothing but the time it takes.
        continuous: whether to look at h between control instants too.

    Attributes:
        steps: control periods of an episode.
    """

    def __init__(
        self,
        problem: SafetyProblem,
        make: MakeTiltedEnv,
        policy: Any,
        num_envs: int,
        continuous: bool = False,
    ) -> None:
        self.steps = problem.steps
        self._make, self._policy, self._num_envs = make, policy, num_envs
        self._bridge = BrownianBridge(problem) if continuous else None
        self._envs: dict[tuple[int, float], Any] = {}
        self._simulation = Simulation(problem, "arrays")

    def starts(self, keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `safe_envs.agents.rare_events.splitting.PathPlayer`."""
        found = []
        for first in range(0, len(keys), self._num_envs):
            some = keys[first : first + self._num_envs]
            env = self._env(len(some), 0.0)
            _, info = env.reset(seed=_filled(some, env.num_envs).tolist())
            world: Any = readable(env)
            found.append((world.state[: len(some)], info["barrier"][: len(some)]))
        states, barriers = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return states, barriers

    def play(
        self,
        paths: np.ndarray,
        keys: np.ndarray,
        heights: Heights,
        records: Records,
        length: float,
    ) -> np.ndarray:
        """See `safe_envs.agents.rare_events.splitting.PathPlayer`."""
        ends = np.empty(len(paths), dtype=np.int64)
        # Paths that have equally far to go share a batch, which takes as long as the longest of
        # them.
        order = np.argsort(records.last(paths)[1], kind="stable")
        with job.limited():
            for first in range(0, len(paths), self._num_envs):
                some = order[first : first + self._num_envs]
                env = self._env(len(some), length)
                batch = _Batch(env, paths[some], keys[paths[some]], records)
                batch.begin(self._policy, self._bridge, first)
                ends[some] = batch.play(self._policy, heights, self._simulation)
        return ends

    def _env(self, count: int, length: float) -> Any:
        """Return an env with at least so many episodes side by side."""
        size = self._num_envs
        while size // 2 >= max(count, _FEWEST_ENVS):
            size //= 2
        if (size, length) not in self._envs:
            env = self._envs[size, length] = self._make(np.full(size, length))
            env.reset(seed=0)
        return self._envs[size, length]


class _Batch:
    """Paths in the first rows of an env, which go on from their last records."""

    def __init__(self, env: Any, paths: np.ndarray, keys: np.ndarray, records: Records) -> None:
        self._env, self._paths, self._records = env, paths, records
        self._world: Any = readable(env)
        self._lowest, self._time, self._over, states, integrals = records.last(paths)
        rows = env.num_envs
        self._seeds, self._begun = _filled(keys, rows).tolist(), _filled(self._time, rows)
        snapshot = env.snapshot()
        snapshot["state"], snapshot["steps"] = _filled(states, rows), self._begun
        snapshot["girsanov_integrals"] = _filled(integrals, rows)
        snapshot["ended"][:] = False
        env.restore(snapshot, seed=self._seeds)

    def begin(self, policy: Any, bridge: BrownianBridge | None, first: int) -> None:
        """Begin the streams of a policy and of the bridges."""
        if isinstance(policy, Policy):
            rows = range(first, first + self._env.num_envs)
            policy.resume(rows, self._seeds, self._begun.tolist())
        self._bridge = bridge
        if bridge is not None:
            self._barriers = bridge.barriers(self._world.components)
            self._draws = Exponentials(self._seeds, bridge.draws, self._begun.tolist())

    def play(self, policy: Any, heights: Heights, simulation: Simulation) -> np.ndarray:
        """Simulate the paths until they end or violate; return when."""
        count, world, lowest, time = len(self._paths), self._world, self._lowest, self._time
        x = world.components
        rest, _ = center_and_half_width(world.problem)
        with np.errstate(all="ignore"):
            features = simulation.measure(x, rest, self._begun * world.problem.dt)[0]
        observation = stacked(features, len(x[0])).astype(np.float32)
        ends = time.copy()
        alive = (lowest > 0.0) & ~self._over
        while alive.any():
            x = world.components
            observation, _, terminated, truncated, info = self._env.step(_act(policy, observation))
            time += 1
            ends[alive] = time[alive]
            weights = heights.weight(np.minimum(time, len(heights.weights) - 1), self._paths)
            height = heights.relative(self._looked_at(x, info["barrier"])[:count]) * weights
            over = (terminated | truncated)[:count]
            fell = np.flatnonzero(alive & (height < lowest))
            if fell.size:
                lowest[fell] = height[fell]
                self._records.add(
                    self._paths[fell],
                    height[fell],
                    time[fell],
                    over[fell],
                    np.stack([component[fell] for component in world.components], axis=-1),
                    world.girsanov_integrals[fell],
                )
            alive &= (lowest > 0.0) & ~over
        return ends

    def _looked_at(self, x: Any, after: np.ndarray) -> np.ndarray:
        """Return the smallest values of the barriers in a period that began at the states x."""
        if self._bridge is None:
            return after
        before, self._barriers = self._barriers, after
        return self._bridge.sample_minimum(x, before, after, self._draws.next())


def _act(policy: Any, observation: np.ndarray) -> np.ndarray:
    actions, memory = policy.predict(
        observation, None, np.zeros(len(observation), dtype=bool), deterministic=True
    )
    if memory is not None:
        raise ConfigurationError(
            "the policy has a memory, which splitting cannot take up again; estimate with plain"
            " episodes"
        )
    return actions


def _filled(values: np.ndarray, rows: int) -> np.ndarray:
    """Return values with the first of them once more for each further row."""
    return np.concatenate([values, np.repeat(values[:1], rows - len(values), axis=0)])


_FIRST_CHUNK, _CHUNK = 64, 256


class PathNoise:
    """The standard normals of a batch in which each env plays one episode, or the rest of one.

    It takes the place of `safe_envs.envs.noise.NoiseStreams`, which is for envs that go on with
    further episodes. Here those have no noise: nobody looks at them.

    Args:
        streams: of the envs.
        channels: numbers in a control period.
        periods: of an episode.
    """

    def __init__(self, streams: EpisodeStreams, channels: int, periods: int) -> None:
        self._streams, self._channels, self._periods = streams, channels, periods
        self._begun = np.zeros(streams.num_envs, dtype=np.int64)
        self._over = np.zeros(streams.num_envs, dtype=bool)
        self._restart()

    def seek(self, envs: Sequence[int] | np.ndarray, periods: Any = 0) -> None:
        """Go to a control period of new streams of some envs.

        Args:
            envs: their indices.
            periods: the control period of each, or of all.
        """
        self._begun += self._passed
        self._begun[envs], self._over[envs] = periods, False
        self._restart()

    def begin(self, envs: np.ndarray) -> None:
        """Begin the next episodes of some envs, given by their indices."""
        later = self._streams.episodes[envs] > 0
        self._over[envs[later]] = True
        if not later.all():
            self.seek(envs[~later])

    def next(self, stepping: np.ndarray | None) -> np.ndarray:
        """Return the draws of the next control period, shape (channels, num_envs).

        Args:
            stepping: of no meaning here.
        """
        if not self._channels:
            return self._chunk.reshape(0, self._streams.num_envs)
        if self._position == self._chunk.shape[1]:
            self._draw()
        self._position += 1
        self._passed += 1
        return self._chunk[:, self._position - 1].T

    def _restart(self) -> None:
        self._passed = self._position = 0
        self._chunk = np.empty((self._streams.num_envs, 0, self._channels))

    def _draw(self) -> None:
        """Draw ahead for the envs whose episodes are not over."""
        periods = self._begun + self._passed
        left = np.where(self._over, 0, np.maximum(self._periods - periods, 0))
        # An episode that has lasted is likely to last: chunks grow with it.
        count = min(max(self._passed, _FIRST_CHUNK), _CHUNK)
        most = max(int(left.max()), 1)
        count = most if most <= 2 * count else count
        envs = np.flatnonzero(left)
        # The normal number of 1/2 is next to 0.
        drawn = np.full((len(envs), count, self._channels), 0.5)
        words, ends = periods[envs] * self._channels, np.minimum(left[envs], count)
        for i, word, end, out in zip(
            envs.tolist(), words.tolist(), ends.tolist(), drawn, strict=True
        ):
            self._streams.reader.seek(self._streams.keys[i], 0, NOISE, word).fill(out[:end])
        self._chunk = np.zeros((self._streams.num_envs, count, self._channels))
        self._chunk[envs] = standard_normals(drawn, out=drawn)
        self._position = 0


class TiltedNoiseEnv(SafeVectorEnv):
    """`SafeVectorEnv` with dW - c e dt in place of dW.

    Here e = sigma' grad h/|sigma' grad h| is the direction in which h rises fastest.

    An env plays one episode after it was seeded; later ones have no noise.

    Of several barriers the smallest counts. Where no noise reaches it, e = 0. The e of a control
    period is that of its beginning.

    Args:
        problem: what to simulate.
        lengths: c of each env, in 1/sqrt(s), shape (num_envs,); 0 for the noise as it is.

    Attributes:
        girsanov_integrals: of each episode the integrals of e'dW, where W is what drives the
            system, and of e'e dt; shape (num_envs, 2). They give the density of the noise so far
            over that with a drift: see
            `safe_envs.agents.rare_events.splitting.log_ratio`.
    """

    def __init__(self, problem: SafetyProblem, lengths: np.ndarray) -> None:
        super().__init__(problem, len(lengths))
        plant = problem.plant
        self._slopes = compile_function(plant.states, barrier_slopes(problem), "arrays")
        self._barriers = BarrierFunction(
            plant.states,
            [plant.numeric(barrier.expression) for barrier in problem.barriers],
            "arrays",
        )
        self._shape = (len(problem.barriers), len(plant.noise_channels), len(lengths))
        self._lengths = lengths
        self.girsanov_integrals = np.zeros((len(lengths), 2))
        batch: Any = self._batch
        batch.noise = _TiltedNoise(self)

    def tilt_direction(self) -> np.ndarray:
        """Return the direction e of the coming period, shape (noise channels, num_envs)."""
        slopes = stacked(self._slopes(*self.components), self.num_envs).T.reshape(self._shape)
        if len(slopes) == 1:
            steepest = slopes[0]
        else:
            barriers = stacked(self._barriers(*self.components), self.num_envs)
            steepest = slopes[barriers.argmin(axis=1), :, np.arange(self.num_envs)].T
        steepness = np.sqrt(_sum_of_products(steepest, steepest))
        return np.where(steepness > 0.0, steepest / np.where(steepness > 0.0, steepness, 1.0), 0.0)

    def tilted(self, draws: np.ndarray) -> np.ndarray:
        """Return the draws of a period with the drift in them, substep by substep.

        Adds to `girsanov_integrals`.
        """
        if not draws.size:
            return draws
        root = math.sqrt(self.problem.dt / self.problem.substeps)
        direction = np.tile(self.tilt_direction(), (self.problem.substeps, 1))
        moved = draws - self._lengths * root * direction
        self.girsanov_integrals[:, 0] += root * _sum_of_products(direction, moved)
        self.girsanov_integrals[:, 1] += root * root * _sum_of_products(direction, direction)
        return moved

    def snapshot(self) -> dict[str, np.ndarray]:
        """See `SafeVectorEnv.snapshot`."""
        return {**super().snapshot(), "girsanov_integrals": self.girsanov_integrals.copy()}

    def restore(
        self, snapshot: Mapping[str, np.ndarray], seed: int | Sequence[int | None] | None = None
    ) -> None:
        """See `SafeVectorEnv.restore`."""
        super().restore(snapshot, seed)
        self.girsanov_integrals = np.array(snapshot["girsanov_integrals"])


def barrier_slopes(problem: SafetyProblem) -> list[sp.Expr]:
    """Return sigma' grad h of each barrier, entry by entry for the channels with noise."""
    plant = problem.plant
    diffusion = plant.numeric(plant.diffusion)
    rows = [
        plant.numeric(gradient(plant, barrier.expression)) * diffusion
        for barrier in problem.barriers
    ]
    return [row[0, j] for row in rows for j in plant.noise_channels]


class _TiltedNoise(PathNoise):
    """The draws of an env with its drift."""

    def __init__(self, env: TiltedNoiseEnv) -> None:
        problem = env.problem
        super().__init__(env._streams, noise_channels(problem), problem.steps)
        self._env = env

    def begin(self, envs: np.ndarray) -> None:
        """See `PathNoise.begin`."""
        super().begin(envs)
        self._env.girsanov_integrals[envs] = 0.0

    def next(self, stepping: np.ndarray | None) -> np.ndarray:
        """See `PathNoise.next`."""
        # A state that overflows is found by the env, whose message is better than a warning.
        with np.errstate(all="ignore"):
            return self._env.tilted(super().next(stepping))


def _sum_of_products(one: np.ndarray, other: np.ndarray) -> Any:
    """Return the sums along the first axis, one term after the other for any number of envs."""
    total = one[0] * other[0]
    for a, b in zip(one[1:], other[1:], strict=True):
        total = total + a * b
    return total
