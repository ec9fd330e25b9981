"""Tables that are no bounds, but quickly made, for what does not depend on that."""

from __future__ import annotations

import numpy as np

from safe_envs.values.promise_filter import PromiseFilter, PromiseSettings
from tests.conftest import problem_of

SCALAR = "safe_envs/Scalar-v0"


class Guess:
    """Of the scalar env: the further below the limit, the better.

    Args:
        problem: the env's.
    """

    def __init__(self, problem) -> None:
        self.steps, self.inputs = problem.steps, np.linspace(-10.0, 10.0, 21)[:, None]

    def values(self, k, x):
        return np.where((x[0] < 1.0) & (x[0] > -3.0), np.clip(0.99 - 0.12 * x[0], 0.0, 1.0), 0.0)

    def expected(self, k, x, u):
        # Below what it would be without noise, so that p grows here and there, as with a bound.
        return 0.98 * self.values(k, ((x[0][:, None] + 0.01 * u[..., 0]),))

    def scanned(self, k, x):
        return self.expected(k, x, np.broadcast_to(self.inputs, (len(k), *self.inputs.shape)))

    def sufficient(self, k, x, u, levels):
        return self.expected(k, x, u[:, None, :])[:, 0], np.full(len(u), np.inf)

    def best_input(self, k, x):
        q = self.scanned(k, x)
        return self.inputs[q.argmax(axis=1)], q.max(axis=1)


def guess(p: float = 0.97, env_id: str = SCALAR, **options) -> PromiseFilter:
    """Return a promise filter of a guess, for the problem that `gym.make` makes with options."""
    problem = problem_of(env_id, **options)
    return PromiseFilter(Guess(problem), PromiseSettings(p), problem)
