"""Where episodes begin when a reset is given a state, a start distribution or a time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium.utils import seeding

from safe_envs.arrays import real_array
from safe_envs.dynamics.noise import Key, StreamReader, key_of
from safe_envs.envs.simulation import start_sampler
from safe_envs.errors import ConfigurationError, InvalidInputError, nearest, require_whole, shown
from safe_envs.problem.actuators import input_ranges
from safe_envs.problem.problem import SafetyProblem
from safe_envs.problem.starts import StartSampler

_NAMES = ("state", "start", "t")

_WHOLE = 1e-6
"""By how much of a control period a time may miss a whole number of them."""

_ROUNDING = 1e-12
"""By how much of its bounds' width an input that is a state may be beyond them, as simulated."""


class RequestedStart(NamedTuple):
    """Where a reset asks for the episodes of a batch of envs, or of one env, to begin.

    Attributes:
        states: shape (B, n), or None for draws; anything for envs that begin no episode.
        start: name of the distribution that is drawn from.
        steps: control periods that have passed, int64 (B,).
    """

    states: np.ndarray | None
    start: str
    steps: np.ndarray


class StartingPoints(NamedTuple):
    """Where envs of a batch begin their episodes.

    Attributes:
        states: shape (num_envs, n); anything for envs that begin no episode.
        steps: control periods that have passed, int64 (num_envs,).
    """

    states: np.ndarray
    steps: np.ndarray


class ResetOptions:
    """Reads the options of `reset`, and checks states that are given.

    Args:
        problem: of the envs.
        limit: control periods until an episode is truncated.
        num_envs: size of a batch; None for a scalar env, whose states have the shape (n,).
    """

    def __init__(self, problem: SafetyProblem, limit: int, num_envs: int | None = None) -> None:
        self._problem, self._limit, self._num_envs = problem, limit, num_envs
        self._samplers: dict[str, StartSampler] = {}

    def checked(self, options: Any) -> Mapping[str, Any]:
        """Return the options of `reset` as a mapping of known names.

        Raises:
            ConfigurationError: They are no mapping, or an option is unknown.
        """
        if not isinstance(options, Mapping | None):
            raise ConfigurationError(
                f"options = {shown(options)}; give a mapping, like {{'state': x, 't': 1.0}}"
            )
        known = _NAMES if self._num_envs is None else (*_NAMES, "reset_mask")
        for name in options or {}:
            if name not in known:
                raise ConfigurationError(
                    f"unknown option {shown(name)} of reset; {nearest(str(name), known)}"
                )
        return options or {}

    def read(
        self, options: Mapping[str, Any] | None, begins: np.ndarray | None = None
    ) -> RequestedStart | None:
        """Return what is asked for; None where nothing is.

        Args:
            options: of `reset`.
            begins: which envs of a batch begin an episode, bool (num_envs,).

        Raises:
            ConfigurationError: An option is unknown, the name of a start is, or both a state and a
                start are given.
            InvalidInputError: A state or a time is not allowed.
        """
        options = self.checked(options)
        state, start, time = [options.get(name) for name in _NAMES]
        if state is None and start is None and time is None:
            return None
        if state is not None and start is not None:
            raise ConfigurationError(
                f"reset was given both a state and the start {shown(start)}; give one of them"
            )
        return RequestedStart(
            None if state is None else self.states(state, begins),
            self._problem.start if start is None else self._named(start),
            self._steps(0.0 if time is None else time, begins),
        )

    def states(self, given: Any, wanted: np.ndarray | None = None) -> np.ndarray:
        """Return states as an array of doubles of their own, (1, n) or (num_envs, n).

        Args:
            given: shape (n,); of a batch this stands for all its envs, and (num_envs, n) will do.
            wanted: the envs of a batch whose states are looked at; None for all.

        Raises:
            InvalidInputError: The states have another shape, are not finite, or outside the
                workspace, or an input that is a state is beyond its bounds by more than rounding.
        """
        found, problem = real_array("state", given), self._problem
        n, count = problem.plant.n, self._num_envs
        shapes = [(n,)] if count is None else [(n,), (count, n)]
        if found.shape not in shapes:
            names = ", ".join(s.symbol.name for s in problem.states)
            raise InvalidInputError(
                f"the state has shape {found.shape}; {problem.name} takes"
                f" {' or '.join(map(str, shapes))}: {names}"
            )
        states = np.array(np.broadcast_to(found, (count or 1, n)), dtype=float)
        checked = states if wanted is None else states[wanted]
        inputs = input_ranges(problem)
        for v, values in zip(problem.states, checked.T, strict=True):
            low, high = inputs.get(v.symbol, (v.low, v.high))
            doubt = _ROUNDING * (high - low) if v.symbol in inputs else 0.0
            bad = ~(np.isfinite(values) & (values >= low - doubt) & (values <= high + doubt))
            if bad.any():
                where = "its bounds" if v.symbol in inputs else "the workspace"
                raise InvalidInputError(
                    f"the state has {v.symbol} = {values[bad][0]}; give a number in {where}"
                    f" [{low}, {high}]"
                )
        return states

    def sampler(self, start: str) -> StartSampler:
        """Return what draws from a start distribution, given by its name."""
        if start not in self._samplers:
            self._samplers[start] = start_sampler(self._problem, start)
        return self._samplers[start]

    def _named(self, start: Any) -> str:
        starts = self._problem.starts
        if not isinstance(start, str) or start not in starts:
            advice = nearest(str(start), starts, "a state is given by the option 'state'")
            raise ConfigurationError(f"unknown start {shown(start)}; {advice}")
        return start

    def _steps(self, given: Any, wanted: np.ndarray | None) -> np.ndarray:
        times, dt, count = _times(given), self._problem.dt, self._num_envs
        if times.shape != () and times.shape != (count,):
            raise InvalidInputError(
                f"t has shape {times.shape}; give a number in s"
                + ("" if count is None else f", or {count} of them")
            )
        times = np.array(np.broadcast_to(times, count or 1), dtype=float)
        if wanted is not None:
            times[~wanted] = 0.0
        with np.errstate(all="ignore"):
            periods = times / dt
            steps = np.rint(periods)
            bad = ~((abs(periods - steps) <= _WHOLE) & (steps >= 0) & (steps < self._limit))
        if bad.any():
            raise InvalidInputError(
                f"t = {times[bad][0]} s; give a whole number of control periods of {dt} s, from 0"
                f" to {(self._limit - 1) * dt:g} s, before the episode ends"
            )
        return steps.astype(np.int64)


def refuse_time(options: Mapping[str, Any] | None, judge: str) -> None:
    """Raise ConfigurationError where a reset sets the time of an episode that is judged as a whole.

    Args:
        options: of `reset`.
        judge: what judges it.

    Raises:
        InvalidInputError: The time is no number.
    """
    time = options.get("t") if isinstance(options, Mapping) else None
    if time is not None and np.any(_times(time) != 0):
        raise ConfigurationError(
            f"t = {shown(time)}: {judge} is of whole episodes, from time 0 on; leave t out"
        )


def _times(given: Any) -> np.ndarray:
    """Return times as an array of floats; raises InvalidInputError for what is no time."""
    times = real_array("time", given)
    if np.asarray(given).dtype.kind == "b":
        raise InvalidInputError(f"t = {shown(given)}; give a number in s")
    return times


Seeds = int | Sequence[int | None] | None
"""A seed of env 0, with env i seeded by seed + i, or a seed (or None) for each env."""


class EpisodeStreams:
    """The streams that the envs of a batch draw from in their current episodes.

    Attributes:
        reader: reads the streams.
        keys: of the seed of each env; empty before the first use.
        words: the same, uint64 (num_envs, 2).
        episodes: number of the episode of each env since its seed, int64 (num_envs,); -1 before
            the first.
        seeds: of each env.
    """

    def __init__(self, num_envs: int) -> None:
        self.num_envs = num_envs
        self.reader = StreamReader()
        self.keys: list[Key] = []
        self.words = np.zeros((num_envs, 2), dtype=np.uint64)
        self.episodes = np.full(num_envs, -1, dtype=np.int64)
        self.seeds: list[int] = []
        self._generators: list[np.random.Generator | None] = [None] * num_envs

    def generators(self) -> tuple[np.random.Generator, ...]:
        """Return a generator for each env, seeded as Gymnasium does; nothing here draws from it."""
        self._generators = [
            seeding.np_random(seed)[0] if generator is None else generator
            for generator, seed in zip(self._generators, self.seeds, strict=True)
        ]
        return tuple(self._generators)  # pyright: ignore[reportReturnType]

    def for_each_env(self, seed: Seeds) -> list[int | None]:
        """Return a seed, or None, for each env.

        Args:
            seed: that of env 0, with env i seeded by seed + i, or one (or None) for each env.

        Raises:
            ConfigurationError: There are not as many seeds as envs, or one is no whole number from
                0.
        """
        if seed is None:
            return [None] * self.num_envs
        if not isinstance(seed, Sequence | np.ndarray):
            require_whole("seed", seed, 0)
            return [int(seed) + i for i in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise ConfigurationError(f"{len(seed)} seeds were given for {self.num_envs} envs")
        for each in seed:
            if each is not None:
                require_whole("seed", each, 0)
        return [None if each is None else int(each) for each in seed]

    def seed(self, seeds: Sequence[int | None]) -> list[int]:
        """Seed the envs that have a seed, at the first use all; return their indices.

        Their next episode is number 0.

        Raises:
            ConfigurationError: A seed is negative.
        """
        if not self.keys:
            seeds = [_entropy() if seed is None else seed for seed in seeds]
        chosen = {i: (seed, key_of(seed)) for i, seed in enumerate(seeds) if seed is not None}
        if not self.keys:
            self.keys, self.seeds = [(0, 0)] * self.num_envs, [0] * self.num_envs
        for i, (seed, key) in chosen.items():
            self.seeds[i], self.keys[i], self.words[i] = seed, key, key
            self.episodes[i], self._generators[i] = -1, None
        return list(chosen)

    def begin_episodes(
        self, envs: Sequence[int] | np.ndarray
    ) -> tuple[Sequence[Key], Sequence[int]]:
        """Go on to the next episode of some envs, given by their indices.

        Returns:
            The keys of their seeds, and the numbers of their episodes.
        """
        self.episodes[envs] += 1
        return [self.keys[i] for i in envs], self.episodes[envs].tolist()


def _entropy() -> int:
    """Return a seed from the operating system, of as many bits as Gymnasium takes."""
    return int(np.random.SeedSequence().entropy)  # pyright: ignore[reportArgumentType]
