"""Small systems, tables of them, and their exact values by quadrature."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import sympy as sp
from numpy.polynomial.legendre import leggauss
from scipy.special import ndtr

from safe_envs import ControlAffineSDE, SafetyProblem, define_problem
from safe_envs.dynamics.codegen import compile_function
from safe_envs.values.solve import solve
from safe_envs.values.tables import ValueSettings, ValueTable

x, y, u, v, s = sp.symbols("x y u v s", real=True)
Interval = tuple[float, float]
COMMON = {"input_bounds": (-1.0, 1.0), "dt": 0.1, "filter": "scbf"}


def scalar(
    drift: Any = 0, sigma: Any = s, barriers: Any = x, gain: Any = 1, **options: Any
) -> SafetyProblem:
    """Return dx = (drift + gain u) dt + sigma dW, with h = x on (-1, 2)."""
    size = options.pop("s", 0.4)
    used = sp.sympify(sigma).free_symbols | sp.sympify(drift).free_symbols
    parameters = {s: size} if s in used else {}
    system = ControlAffineSDE([x], [u], [drift], [[gain]], [[sigma]], parameters)
    given = {"start": (0.5,), "horizon": 1.0, "workspace": {x: (-1.0, 2.0)}, "name": "scalar"}
    return define_problem(system, barriers, **{**COMMON, **given, **options})


def pursued(**options):
    """Return a state that has to stay away from another one, which moves by itself."""
    system = ControlAffineSDE([x, y], [u], [0, sp.Rational(3, 2)], [1, 0], [s, 0], {s: 0.3})
    given = {"start": (0.6, -0.8), "horizon": 1.5, "workspace": {x: (-1.0, 1.5)}, "name": "pursued"}
    barrier = (x - y) ** 2 - sp.Rational(1, 25)
    return define_problem(system, barrier, **COMMON, **given, **options)


def solved(problem: SafetyProblem, *cells: int, **settings: Any) -> ValueTable:
    """Return a table with these numbers of cells."""
    return solve(problem, ValueSettings(cells=cells, **settings))


def row(table: ValueTable, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Return both envelopes at a control instant."""
    at = max(k - table.first, 0)
    return table.lower[at], table.upper[at]


def quadrature(
    problem: SafetyProblem,
    inputs: np.ndarray,
    ends: tuple[float, float],
    leaving: tuple[float, float] | None = None,
    period: float = 0.0,
    nodes: int = 300,
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return Gauss nodes of an interval that is safe, and the values there at the instants 0 to K.

    Args:
        problem: of one state, one input and one noise.
        inputs: of which the best one is taken, at every instant and state.
        ends: of the safe set.
        leaving: states between which an episode ends in safety, next to the safe set.
        period: of the state, 0 for none.
        nodes: how many.
    """
    places, weights = leggauss(nodes)
    low, high = ends
    q = 0.5 * (high - low) * places + 0.5 * (high + low)
    weights = 0.5 * (high - low) * weights
    mean, size = (each.T for each in _step(problem, q, inputs))
    density = np.zeros((*mean.shape, nodes))
    for turn in range(-40, 41) if period else (0,):
        apart = (q + turn * period - mean[..., None]) / size[..., None]
        density += np.exp(-0.5 * apart**2) / (size[..., None] * np.sqrt(2 * np.pi))
    ended = np.zeros(mean.shape)
    if leaving is not None:
        ended = ndtr((leaving[1] - mean) / size) - ndtr((leaving[0] - mean) / size)
    rows = [np.ones(nodes)]
    for _ in range(problem.steps):
        rows.append((density @ (weights * rows[-1]) + ended).max(axis=0))
    return q, rows[::-1]


def expected_after(
    problem: SafetyProblem,
    values: np.ndarray,
    edges: np.ndarray,
    q: np.ndarray,
    inputs: np.ndarray,
    *,
    safe: Sequence[Interval],
    ones: Sequence[Interval] = (),
    period: float = 0.0,
) -> np.ndarray:
    """Return E V(X_1) exactly, after a step of one state, one input and one noise, shape (Q, U).

    Args:
        problem: whose step is taken.
        values: V on each cell in the safe set; outside it is 0.
        edges: of the cells.
        q: states.
        inputs: of the step.
        safe: intervals of the safe set.
        ones: intervals where V is 1 instead.
        period: of the state, 0 for none.
    """
    ends = [e for interval in (*safe, *ones) for e in interval if math.isfinite(e)]
    cuts = np.unique([*edges, *ends])
    if ones:
        cuts = np.array([-1e30, *cuts, 1e30])
    middle = 0.5 * (cuts[:-1] + cuts[1:])
    cells = np.searchsorted(edges, middle, side="right") - 1
    inside = (cells >= 0) & (cells < len(values)) & _is_in(safe, middle)
    held = np.where(inside, values[np.clip(cells, 0, len(values) - 1)], 0.0)
    held = np.where(_is_in(ones, middle), 1.0, held)
    mean, size = _step(problem, q, inputs)
    total = np.zeros(mean.shape)
    for turn in np.arange(-40, 41) * period if period else (0.0,):
        passed = ndtr((cuts + turn - mean[..., None]) / size[..., None])
        total += np.diff(passed, axis=-1) @ held
    return total


def _is_in(intervals: Sequence[Interval], q: np.ndarray) -> np.ndarray:
    return np.any([(a < q) & (q < b) for a, b in [*intervals, (1.0, 0.0)]], axis=0)


def _step(
    problem: SafetyProblem, q: np.ndarray, inputs: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return means and standard deviations of the next states, shape (Q, U)."""
    system, dt = problem.plant, problem.dt
    rates = [system.numeric(e)[0] for e in (system.drift, system.input_matrix, system.diffusion)]
    drift, gain, sigma = (
        np.broadcast_to(e, q.shape)[:, None]
        for e in compile_function(system.states, rates, "arrays")(q)
    )
    mean = q[:, None] + dt * (drift + gain * np.asarray(inputs))
    return mean, np.broadcast_to(np.abs(sigma) * np.sqrt(dt), mean.shape)
