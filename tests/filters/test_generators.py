"""Every chain against a derivation by another route: the mean change of a function over a short
step, by quadrature.

E[phi(x + (f + g u) t + sigma sqrt(t) W)] is a Gauss-Hermite sum; its rate of change at t = 0,
extrapolated from three small steps, is the generator. Nothing here differentiates.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

import safe_envs
from safe_envs.dynamics.codegen import compile_function
from safe_envs.dynamics.lie import relative_degree
from safe_envs.wrappers import parse_conditions
from tests.conftest import problem_of

_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(7)
_WEIGHTS = _WEIGHTS / _WEIGHTS.sum()
_STEP = 2e-3


class Motion:
    """The parts of a system as functions of a state, compiled entry by entry."""

    def __init__(self, system, noisy):
        parts = [*system.drift, *system.input_matrix, *system.diffusion]
        self.n, self.m = system.n, system.m
        self._read = compile_function(system.states, [system.numeric(e) for e in parts], "arrays")
        self._noisy = noisy

    def rate(self, phi, x, u):
        """(A phi)(x, u) at states of shape (n, ...), for a function from such states to numbers of
        shape (...)."""
        shape = x.shape[1:]
        values = np.array([np.broadcast_to(value, shape) for value in self._read(*x)])
        drift = values[: self.n] + np.einsum(
            "ij...,j->i...",
            values[self.n : self.n * (1 + self.m)].reshape(self.n, self.m, *shape),
            u,
        )
        sigma = values[self.n * (1 + self.m) :].reshape(self.n, -1, *shape) * self._noisy
        live = sigma[:, [bool(np.any(column != 0)) for column in np.moveaxis(sigma, 1, 0)]]
        grid = list(itertools.product(range(len(_NODES)), repeat=live.shape[1]))
        nodes = np.array([[_NODES[i] for i in point] for point in grid]).reshape(len(grid), -1)
        weights = np.array([math.prod(_WEIGHTS[i] for i in point) for point in grid])
        jumps = np.einsum("ij...,pj->i...p", live, nodes)

        def slope(t):
            return (phi((x + drift * t)[..., None] + math.sqrt(t) * jumps) @ weights - phi(x)) / t

        first, second, third, fourth = (slope(_STEP / 2**k) for k in range(4))
        firsts = [2 * b - a for a, b in itertools.pairwise((first, second, third, fourth))]
        seconds = [(4 * b - a) / 3 for a, b in itertools.pairwise(firsts)]
        return (8 * seconds[1] - seconds[0]) / 7


def states_of(problem, rng):
    """A few states in C: starts, moved a little so that nothing vanishes by chance."""
    low = np.array([max(s.low, -1.0) for s in problem.states])
    high = np.array([min(s.high, 1.0) for s in problem.states])
    h = compile_function(problem.plant.states, [b.expression for b in problem.barriers], "floats")
    found = []
    start = {"safe_envs/ACC-v0": (15.0, 20.0, 60.0), "safe_envs/ACCGap-v0": (10.0, 12.0)}.get(
        problem_id(problem)
    )
    for _ in range(10_000):
        x = (
            rng.uniform(low, high)
            if start is None
            else np.array(start) + rng.uniform(-1, 1, len(start))
        )
        if "z" in {str(s) for s in problem.plant.states} and start is None:
            x[[str(s) for s in problem.plant.states].index("z")] = rng.uniform(3.5, 6.5)
        if min(h(*x)) > 0.05:
            found.append(x)
        if len(found) == 2:
            return found
    raise AssertionError("no state in C")


def problem_id(problem):
    return f"safe_envs/{problem.name}-v0"


OF_ANY_DEGREE = ("hocbf", "ecbf", "szcbf", "scbf")
OF_DEGREE_1 = ("cbf", "rcbf", "rcbf:form=log", "srcbf", "srcbf:form=log")
IDS_OF_DEGREE_1 = [
    f"safe_envs/{name}-v0" for name in ("ACC", "Pendulum", "CubicSDE", "CubicSDEDisk", "Scalar")
]
# Twelve states take long: one condition without noise and one with it cover the two that have them.
TWELVE = {"safe_envs/Quadrotor-v0": ("szcbf",), "safe_envs/QuadrotorLimits-v0": ("ecbf",)}
# Of degree 1, of degree 2, and ACC.
OFTEN = {"safe_envs/Scalar-v0", "safe_envs/StochasticDubins-v0", "safe_envs/ACC-v0"}
CASES = [
    pytest.param(i, text, marks=[] if i in OFTEN else pytest.mark.oracle)
    for i in safe_envs.ENV_IDS
    for text in (
        *TWELVE.get(i, OF_ANY_DEGREE),
        *(OF_DEGREE_1 if i in IDS_OF_DEGREE_1 else ()),
    )
]


@pytest.mark.parametrize(("env_id", "text"), CASES)
def test_rows_equal_the_mean_change_of_their_chain(env_id, text):
    problem = problem_of(env_id)
    problem = problem_of(env_id, noise=[0.3 + 0.1 * j for j in range(len(problem.noise))])
    condition = parse_conditions(text, problem)[0]
    barrier, model = problem.barriers[0], problem.plant
    found = condition.constraint(model, barrier)
    row = [*found.coefficient, found.offset, *([] if found.demand is None else [found.demand])]
    compiled = compile_function(model.states, [model.numeric(e) for e in row], "floats")
    h = compile_function(model.states, [barrier.expression], "arrays")
    motion = Motion(model, noisy=condition.stochastic)
    rng = np.random.default_rng(0)
    u = rng.normal(size=model.m)
    for x in states_of(problem, rng)[: 1 if env_id in TWELVE else 2]:
        values = compiled(*x)
        ours = (
            np.dot(values[: model.m], u)
            + values[model.m]
            - (values[model.m + 1] if found.demand is not None else 0.0)
        )
        theirs, size = by_quadrature(condition, text, motion, lambda y: h(*y)[0], x, u, problem)
        assert ours == pytest.approx(theirs, abs=2e-6 * max(1.0, size))


def by_quadrature(condition, text, motion, h, x, u, problem):
    """The row's value by the definitions of the thesis, and the size of its largest term."""
    if "rcbf" in text:
        beta = (lambda s: -np.log(s / (1 + s))) if "log" in text else (lambda s: 1 / s)
        slope = -1 / (h(x) * (1 + h(x))) if "log" in text else -1 / h(x) ** 2
        rate = motion.rate(lambda y: beta(h(y)), x, u)
        return (rate - condition.gamma / beta(h(x))) / slope, abs(rate / slope)
    gains = problem.gains_of(0)
    degree = relative_degree(problem.plant, problem.barriers[0].expression)
    alphas = {
        "cbf": gains[:1],
        "hocbf": gains,
        "ecbf": gains,
        "szcbf": gains,
        "scbf": (0.0,) * degree,
    }[text.partition(":")[0]]
    rest = np.zeros(motion.m)  # below the last level the input has no effect
    chain = [h]
    for alpha in alphas[:-1]:
        chain.append(lambda y, b=chain[-1], alpha=alpha: motion.rate(b, y, rest) + alpha * b(y))
    last = motion.rate(chain[-1], x, u)
    return last + alphas[-1] * chain[-1](x), abs(last) + abs(chain[-1](x))
