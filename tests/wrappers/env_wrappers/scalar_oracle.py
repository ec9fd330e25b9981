"""Scalar envs that are stepped one by one, as vector envs have to step them."""

from __future__ import annotations

import numpy as np


class ScalarEnvs:
    """What a vector env does, by a loop.

    Args:
        make: makes one env.
        count: of envs; env i is seeded by seed + i.
        mode: "NextStep", "SameStep" or "Disabled", when the envs restart.
        seed: see above.
    """

    def __init__(self, make, count, mode, seed):
        self.envs, self.mode = [make() for _ in range(count)], mode
        self.ended = np.zeros(count, dtype=bool)
        for i, env in enumerate(self.envs):
            env.reset(seed=seed + i)

    def reset(self, mask):
        for i in np.flatnonzero(mask):
            self.envs[i].reset()
        self.ended &= ~mask

    def step(self, actions):
        """Return what each env's step returns, None for an env that was only reset."""
        found = []
        for i, env in enumerate(self.envs):
            if self.ended[i] and self.mode == "NextStep":
                env.reset()
                self.ended[i] = False
                found.append(None)
                continue
            five = env.step(actions[i])
            found.append(five)
            self.ended[i] = five[-3] or five[-2]
            if self.ended[i] and self.mode == "SameStep":
                env.reset()
        return found
