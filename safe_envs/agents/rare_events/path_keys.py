"""Keys of the paths of rare events, from which each draws its start and all of its noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from safe_envs.dynamics.philox import StreamReader, key_of


@dataclass(frozen=True)
class PathKeys:
    """The keys of paths, of which each generation has its own.

    Whatever is drawn for a path is a function of the seed, the path, its generation and the control
    period.

    Attributes:
        seed: of all randomness.
        purpose: what the paths are for: `PILOTS`, `SPLIT` or `DRIFTING` of
            `safe_envs.dynamics.philox`.
    """

    seed: int
    purpose: int

    def of(self, paths: int, generation: int) -> np.ndarray:
        """Return the keys of paths 0, ..., `paths` - 1 of a generation, uint64 (paths,).

        Args:
            paths: how many.
            generation: 0 for paths from the start, and one more for each level from which paths
                are continued.
        """
        reader = StreamReader().seek(key_of(self.seed), generation, self.purpose)
        return reader.words(paths)

    def generator(self, repetition: int) -> np.random.Generator:
        """Return the generator that chooses among the paths of a repetition."""
        return np.random.default_rng(
            np.random.SeedSequence(self.seed, spawn_key=(self.purpose, repetition))
        )
