"""A world that is known exactly: a Markov chain of a few states on a line, with its values."""

from __future__ import annotations

import numpy as np
import sympy as sp

from safe_envs import ControlAffineSDE, SafetyProblem
from safe_envs.problem.builder import state_problem

STATES, STEPS = 30, 40
SAFE = slice(3, 27)
MOVES = {
    1: (0.25, 0.2, 0.0),
    -1: (0.25, -0.2, 0.0),
    3: (0.01, 0.0, 0.02),
    -3: (0.01, 0.0, 0.02),
    0: (0.48, 0.0, -0.04),
}
"""Probabilities of moves: coefficients of 1, u and u^2."""

X, U = sp.symbols("x u", real=True)


def chain_problem(steps: int = STEPS) -> SafetyProblem:
    """Return a problem with the chain's safe set, input bounds and horizon; its dynamics do not
    count."""
    return state_problem(
        ControlAffineSDE((X,), (U,), [0], [[1]], [[0]]),
        (X - (SAFE.start - 0.5)) * (SAFE.stop - 0.5 - X),
        box=(-1.0, 1.0),
        start=[15.0],
        dt=1.0,
        horizon=float(steps),
    )


class Chain:
    """The values of the chain, for scanned inputs in [-1, 1].

    Expectations are quadratic in u: three numbers a state.

    Args:
        factor: by which q is too high.
        scanned: number of inputs.
    """

    def __init__(self, factor: float = 1.0, scanned: int = 9) -> None:
        self.steps = STEPS
        self.inputs = np.linspace(-1.0, 1.0, scanned)[:, None]
        self._factor, laws = factor, np.zeros((3, STATES, STATES))
        for i in range(STATES):
            for move, coefficients in MOVES.items():
                laws[:, i, min(max(i + move, 0), STATES - 1)] += coefficients
        inside = np.zeros(STATES)
        inside[SAFE] = 1.0
        self.table, self.ahead = [inside], []
        powers = self.inputs ** np.arange(3)
        for _ in range(STEPS):
            coefficients = laws @ self.table[0]
            self.ahead.insert(0, coefficients)
            self.table.insert(0, inside * (powers @ coefficients).max(axis=0))
        self.table, self.ahead = np.array(self.table), np.array(self.ahead)

    def values(self, k, x):
        return self.table[k, x[0].astype(int)]

    def expected(self, k, x, u):
        c = self.ahead[k, :, x[0].astype(int)].T[:, :, None]
        q = c[0] + u[..., 0] * (c[1] + u[..., 0] * c[2])
        return np.minimum(self._factor * q, 1.0)

    def scanned(self, k, x):
        return self.expected(k, x, np.broadcast_to(self.inputs, (len(k), *self.inputs.shape)))

    def best_input(self, k, x):
        q = self.scanned(k, x)
        return self.inputs[q.argmax(axis=1)], q.max(axis=1)

    def sufficient(self, k, x, u, levels):
        return self.expected(k, x, u[:, None, :])[:, 0], np.full(len(u), np.inf)

    def moved(self, x, u, rng):
        """Return the states (B,) after a step from states (B,) under inputs (B,)."""
        laws = [c[0] + u * (c[1] + u * c[2]) for c in MOVES.values()]
        chosen = (np.cumsum(laws, axis=0)[:-1] < rng.random(len(x))).sum(axis=0)
        return np.clip(x + np.array([*MOVES])[chosen], 0.0, STATES - 1.0)
