"""The random streams of a batch: those of each env are the ones that it would have alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from gymnasium.utils import seeding

from safe_envs.dynamics.philox import Key, StreamReader, key_of
from safe_envs.errors import ConfigurationError, require_whole

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
