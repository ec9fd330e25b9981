"""A scalar linear Gaussian system with a sensor: exact survival by quadrature.

x' = x + dt (a x + u) + s sqrt(dt) w, y = x + r v, safe where x < 1 at each control instant. The
unnormalised density of the state, restricted to the safe states, is carried along on Gauss-Legendre
nodes. What is survived is not Gaussian, so that no Kalman filter tells its probability.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import sympy as sp

from safe_envs import ControlAffineSDE, define_problem
from safe_envs.problem.measurement import Channel, Measurement
from safe_envs.problem.problem import SafetyProblem

A, S, R, LIMIT = 1.0, 0.6, 0.3, 1.0
DT, STEPS, PUSH = 0.02, 50, 3.0
x, u, sigma = sp.symbols("x u sigma", real=True)


def problem(noise: float = R, start: float = 0.0, steps: int = STEPS) -> SafetyProblem:
    """Return the problem, measured with a standard deviation."""
    system = ControlAffineSDE.from_rate(
        (x,), (u,), [A * x + u], diffusion=[sigma], parameters={sigma: S}
    )
    found = define_problem(
        system,
        LIMIT - x,
        input_bounds=(-PUSH, PUSH),
        start=[start],
        dt=DT,
        horizon=steps * DT,
        name="line",
        nominal=2.0,
        gains=(2.0,),
    )
    return found.configured(measurement=Measurement((Channel("y", x, noise),)))


@dataclass(frozen=True)
class Grid:
    """Nodes below the limit and their weights."""

    nodes: np.ndarray
    weights: np.ndarray

    @classmethod
    def of(cls, count: int = 400, low: float = -7.0) -> Grid:
        nodes, weights = np.polynomial.legendre.leggauss(count)
        half = 0.5 * (LIMIT - low)
        return cls(LIMIT - half + half * nodes, half * weights)

    def moved(self, density: np.ndarray, inputs: float) -> np.ndarray:
        """Return the density after a control period, on the safe nodes."""
        mean = self.nodes + DT * (A * self.nodes + inputs)
        kernel = normal(self.nodes[:, None] - mean[None, :], S * np.sqrt(DT))
        return kernel @ (self.weights * density.T).T


def normal(difference: np.ndarray, deviation: float) -> np.ndarray:
    """Return the density of a centred Gaussian number."""
    scaled = difference / deviation
    return np.exp(-0.5 * scaled**2) / (deviation * np.sqrt(2.0 * np.pi))


def survival(inputs: np.ndarray, start: float = 0.0) -> float:
    """Return P(x_k < 1 for k = 0..K) under given inputs."""
    grid = Grid.of()
    density = normal(grid.nodes - (start + DT * (A * start + inputs[0])), S * np.sqrt(DT))
    for each in inputs[1:]:
        density = grid.moved(density, each)
    return float(grid.weights @ density)


def survival_given(inputs: np.ndarray, records: np.ndarray, noise: float = R) -> np.ndarray:
    """Return P(x_k < 1 for k = 0..K | y_1..y_K) of records (B, K), by unnormalised densities."""
    grid, count = Grid.of(), len(records)
    mean, variance, evidence = np.zeros(count), 0.0, np.zeros(count)
    density = np.zeros((len(grid.nodes), count))
    for k, (each, y) in enumerate(zip(inputs, records.T, strict=True)):
        if k == 0:
            first = normal(grid.nodes - DT * each, S * np.sqrt(DT))
            density = np.repeat(first[:, None], count, axis=1)
        else:
            density = grid.moved(density, each)
        density = density * normal(y - grid.nodes[:, None], noise)
        # What a record has without the limit: the innovations of a Kalman filter.
        mean, variance = mean + DT * (A * mean + each), (1 + DT * A) ** 2 * variance + S**2 * DT
        total = variance + noise**2
        evidence += -0.5 * (np.log(2.0 * np.pi * total) + (y - mean) ** 2 / total)
        mean, variance = mean + variance / total * (y - mean), variance * noise**2 / total
    return grid.weights @ density / np.exp(evidence)
