"""Exact laws of first passages, and the systems that follow them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import sympy as sp
from scipy.linalg import toeplitz
from scipy.special import ndtr
from scipy.stats import norm

from safe_envs import define_problem
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.problem.problem import SafetyProblem

X = sp.Symbol("x", real=True)


def brownian(
    dt: float, horizon: float, drift: float, sigma: float, barriers: Any = 1 - X
) -> SafetyProblem:
    """dx = drift dt + sigma dW from 0, below 1 unless told otherwise: the nominal input is the
    drift."""
    u, s = sp.symbols("u s", real=True)
    system = ControlAffineSDE(
        states=(X,), inputs=(u,), drift=[0], input_matrix=[1], diffusion=[s], parameters={s: sigma}
    )
    return define_problem(
        system,
        barriers,
        input_bounds=(-10.0, 10.0),
        start=[0.0],
        dt=dt,
        horizon=horizon,
        nominal=drift,
    )


def mean_reverting(
    theta: float, sigma: float, dt: float = 0.05, horizon: float = 2.0
) -> SafetyProblem:
    """dx = (u - theta x) dt + sigma dW from 0, which is to stay in [-1, 1], without an input."""
    u = sp.Symbol("u", real=True)
    system = ControlAffineSDE.from_rate((X,), (u,), [u - theta * X], diffusion=[sigma])
    return define_problem(
        system, 1 - X**2, input_bounds=(-1.0, 1.0), start=[0.0], dt=dt, horizon=horizon, nominal=0
    )


def mean_reverting_passage(
    theta: float, sigma: float, dt: float = 0.05, horizon: float = 2.0, nodes: int = 600
) -> float:
    """P(|x| reaches 1 at one of the Euler steps of `mean_reverting`), by Nystrom's method: the
    density of those that have not is known at the nodes of Gauss and Legendre."""
    x, weights = np.polynomial.legendre.leggauss(nodes)
    factor, deviation = 1.0 - theta * dt, sigma * math.sqrt(dt)
    kernel = weights[:, None] * density(x[:, None] - factor * x, deviation)
    leaving = norm.sf(1.0, factor * x, deviation) + norm.cdf(-1.0, factor * x, deviation)
    mass, reached = weights * density(x, deviation), 2.0 * norm.sf(1.0, 0.0, deviation)
    for _ in range(round(horizon / dt) - 1):
        reached += leaving @ mass
        mass = kernel @ mass
    return float(reached)


def density(x: np.ndarray, deviation: float) -> np.ndarray:
    """That of a normal variable with mean 0, without the checks of `scipy.stats`, which take longer
    than the exponential."""
    return np.exp(-0.5 * (x / deviation) ** 2) / (math.sqrt(2.0 * math.pi) * deviation)


def first_passage(distance: float, drift: float, sigma: float, horizon: float) -> float:
    """P(drift t + sigma W_t reaches a distance up to the horizon).

    Source: I. Karatzas and S. Shreve, Brownian Motion and Stochastic Calculus, Springer 1991, Sec.
        3.5.C.
    """
    deviation = sigma * math.sqrt(horizon)
    reflected = math.exp(2.0 * drift * distance / sigma**2) * ndtr(
        (-distance - drift * horizon) / deviation
    )
    return float(ndtr((drift * horizon - distance) / deviation) + reflected)


def walk_passage(distance: float, steps: int, mean: float, deviation: float) -> float:
    """P(a walk of Gaussian steps reaches a distance at one of its steps), by quadrature over each
    step."""
    spacing = deviation / 16
    grid = np.arange(spacing / 2, distance + 8 * deviation * math.sqrt(steps), spacing)
    # On an even grid the density depends on how far apart two points are.
    apart = spacing * np.arange(len(grid))
    kernel = toeplitz(
        spacing * density(mean - apart, deviation), spacing * density(mean + apart, deviation)
    )
    return _passage(grid, kernel, norm.cdf(0.0, grid - mean, deviation), distance, steps)


def survival(start, steps, factor, deviation):
    """P(h_1 > 0, ..., h_N > 0) of h_(k+1) = factor h_k + deviation N(0, 1), by quadrature over each
    step."""
    top, spacing = start + 8 * deviation * math.sqrt(steps), deviation / 8
    grid = np.arange(spacing / 2, top, spacing)
    kernel = spacing * density(grid[None, :] - factor * grid[:, None], deviation)
    beyond = norm.sf(top, factor * grid, deviation)
    probability = np.ones(len(grid))
    for _ in range(steps - 1):
        probability = kernel @ probability + beyond
    last = norm.pdf(grid, factor * start, deviation)
    return float(spacing * last @ probability + norm.sf(top, factor * start, deviation))


def martingale_passage(start: float, steps: int, dt: float) -> float:
    """P(|x| reaches 1 at one of the Euler steps of dx = -x/2 dt + x dW, the system of thesis Prop.
    4.2.8 under its SCBF).

    log |x| is a walk with the steps log |1 - dt/2 + sqrt(dt) N(0, 1)|; for small dt P is about
    start^2, and less for the looks between which x may come back.
    """
    deviation, spacing = math.sqrt(dt), math.sqrt(dt) / 8
    distance = -math.log(start)
    grid = np.arange(spacing / 2, distance + 8.0, spacing)
    to = np.exp(grid[:, None] - grid[None, :])
    rate = (density(to - (1 - dt / 2), deviation) + density(to + (1 - dt / 2), deviation)) * to
    outwards = np.exp(grid)
    beyond = norm.sf(outwards, 1 - dt / 2, deviation) + norm.cdf(-outwards, 1 - dt / 2, deviation)
    return _passage(grid, spacing * rate, beyond, distance, steps)


def _passage(
    grid: np.ndarray, kernel: np.ndarray, at_once: np.ndarray, distance: float, steps: int
) -> float:
    """P(reached within steps), linear between points of the grid, from kernels of one step."""
    reached = np.zeros(len(grid))
    for _ in range(steps):
        reached = at_once + kernel @ reached
    return float(np.exp(np.interp(distance, grid, np.log(reached))))
