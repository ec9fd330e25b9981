"""The random generators of a batch: one for each env, as if the envs were alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from gymnasium.utils import seeding

from safe_envs.errors import ConfigurationError

Seeds = int | Sequence[int | None] | None
"""A seed of env 0, with env i seeded by seed + i, or a seed (or None) for each env."""


class Generators:
    """A random generator for each env of a batch, seeded at the first use.

    Attributes:
        rngs: the generators; empty before the first use.
        seeds: by which they were seeded.
    """

    def __init__(self, num_envs: int) -> None:
        self._num_envs = num_envs
        self.rngs: list[np.random.Generator] = []
        self.seeds: list[int] = []

    def for_each_env(self, seed: Seeds) -> list[int | None]:
        """Return a seed, or None, for each env.

        Args:
            seed: that of env 0, with env i seeded by seed + i, or one (or None) for each env.

        Raises:
            ConfigurationError: There are not as many seeds as envs.
        """
        if seed is None:
            return [None] * self._num_envs
        if isinstance(seed, int | np.integer):
            return [int(seed) + i for i in range(self._num_envs)]
        if len(seed) != self._num_envs:
            raise ConfigurationError(f"{len(seed)} seeds were given for {self._num_envs} envs")
        return [None if s is None else int(s) for s in seed]

    def seed(self, seeds: Sequence[int | None]) -> list[int]:
        """Seed the envs that have a seed, at the first use all; return their indices."""
        first = not self.rngs
        if first:
            self.rngs, self.seeds = [None] * self._num_envs, [0] * self._num_envs  # pyright: ignore[reportAttributeAccessIssue]
        chosen = [i for i, seed in enumerate(seeds) if first or seed is not None]
        for i in chosen:
            self.rngs[i], self.seeds[i] = seeding.np_random(seeds[i])
        return chosen
