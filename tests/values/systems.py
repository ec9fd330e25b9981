"""Small systems, tables of them, and their exact values by quadrature."""

from __future__ import annotations

from typing import Any

import numpy as np
import sympy as sp
from numpy.polynomial.legendre import leggauss
from scipy.special import ndtr

from safe_envs import ControlAffineSDE, SafetyProblem, state_problem
from safe_envs.dynamics.codegen import compile_function
from safe_envs.values.look_ahead import LookAhead
from safe_envs.values.solve import solve
from safe_envs.values.tables import ValueSettings, ValueTable

x, y, u, v, s = sp.symbols("x y u v s", real=True)


def scalar(
    drift: Any = 0, sigma: Any = s, barriers: Any = x, gain: Any = 1, **options: Any
) -> SafetyProblem:
    """Return dx = (drift + gain u) dt + sigma dW, with h = x on (-1, 2)."""
    size = options.pop("s", 0.4)
    used = sp.sympify(sigma).free_symbols | sp.sympify(drift).free_symbols
    system = ControlAffineSDE(
        states=[x],
        inputs=[u],
        drift=[drift],
        input_matrix=[[gain]],
        diffusion=[[sigma]],
        parameters={s: size} if s in used else {},
    )
    given = {
        "box": (-1.0, 1.0),
        "start": (0.5,),
        "dt": 0.1,
        "horizon": 1.0,
        "workspace": {x: (-1.0, 2.0)},
        "name": "scalar",
        "filter": "scbf",
        **options,
    }
    return state_problem(system, barriers, **given)


def pursued(**options):
    """Return a state that has to stay away from another one, which moves by itself."""
    system = ControlAffineSDE(
        states=[x, y],
        inputs=[u],
        drift=[0, sp.Rational(3, 2)],
        input_matrix=[[1], [0]],
        diffusion=[[s], [0]],
        parameters={s: 0.3},
    )
    return state_problem(
        system,
        (x - y) ** 2 - sp.Rational(1, 25),
        box=(-1.0, 1.0),
        start=(0.6, -0.8),
        dt=0.1,
        horizon=1.5,
        workspace={x: (-1.0, 1.5)},
        name="pursued",
        filter="scbf",
        **options,
    )


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
    system, dt = problem.plant, problem.dt
    rates = [system.numeric(e)[0] for e in (system.drift, system.input_matrix, system.diffusion)]
    drift, gain, sigma = (
        np.broadcast_to(e, q.shape) for e in compile_function(system.states, rates, "arrays")(q)
    )
    mean = q + dt * (drift + gain * np.asarray(inputs)[:, None])
    size = np.broadcast_to(np.abs(sigma) * np.sqrt(dt), mean.shape)
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


def require_around(
    table: ValueTable, q: np.ndarray, exact: list[np.ndarray], largest: list[np.ndarray]
) -> float:
    """Require lower <= exact and largest <= upper at all instants; return the mean gap."""
    cells, gap = table.grid.cell_of([q]), 0.0
    assert (cells >= 0).all()
    for k, (value, most) in enumerate(zip(exact, largest, strict=True)):
        lower, upper = (each[cells] for each in row(table, k))
        assert (lower <= value + 1e-9).all(), k
        assert (upper >= most - 1e-9).all(), k
        gap += float((upper - lower).mean()) / len(exact)
    return gap


def random_states(table: ValueTable, count: int, seed: int = 0) -> list[np.ndarray]:
    """Draw coordinates within a grid."""
    rng = np.random.default_rng(seed)
    return [
        a.edges[0] + (a.edges[-1] - a.edges[0]) * rng.random(count) * (1 - 1e-9)
        for a in table.grid.axes
    ]


def require_promised(problem: SafetyProblem, table: ValueTable, count: int = 200) -> None:
    """Require that the look-ahead never falls below the table, at random safe states and instants.

    The states are those of the coordinates, which have to be the problem's states.
    """
    ahead = LookAhead(table, problem)
    q = random_states(table, count)
    k = np.random.default_rng(1).integers(0, table.steps, count)
    _, ends = ahead.sets_at(k, q)
    lower, most = ahead.values(k, q), ahead.scanned(k, q).max(axis=1)
    assert (lower <= np.where(ends, 1.0, most) + 1e-7).all()
    assert (lower > 0).any()
    assert (ahead.largest(k, q) >= most - 1e-7).all()
