"""Stand-ins for what was learned, exact or arbitrary, and what their rows are held against."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import compile_function, filled, stacked
from safe_envs.dynamics.lie import derivatives, generator, lie_derivative_f, lie_derivative_g
from safe_envs.filters.learning.collection import draw_states
from safe_envs.filters.learning.data import Signature
from safe_envs.filters.learning.models.base import Record
from safe_envs.filters.learning.models.generator import GeneratorModel
from safe_envs.filters.learning.models.network import Network
from safe_envs.filters.learning.models.residual import ResidualModel

NO_RECORD = Record(0, 0.0, 0.0)


def some_network(rng, inputs, outputs, activation):
    """As training might have left it; none of these tests asks what it is good for."""
    weights, biases = (
        (rng.normal(size=(12, inputs)), rng.normal(size=(outputs, 12)) / 12),
        (rng.normal(size=12), rng.normal(size=outputs)),
    )
    return Network(
        weights,
        biases,
        activation,
        np.zeros(inputs),
        np.ones(inputs),
        np.zeros(outputs),
        np.full(outputs, 0.3),
    )


class Terms:
    """Given functions in the place of a network."""

    def __init__(self, system, degree, expressions, errors=()):
        numbers = [system.numeric(e) for e in expressions]
        self.symbols = tuple(sp.Dummy(f"term_{i}", real=True) for i in range(len(numbers)))
        self.degree, self.errors = degree, np.array(errors)
        self._floats = compile_function(system.states, numbers, "floats")
        self._arrays = compile_function(system.states, numbers, "arrays")

    def floats(self, x):
        return self._floats(*x)

    def arrays(self, x):
        return tuple(filled(c, x[0].shape) for c in self._arrays(*x))

    def eps(self, _):
        return self.errors


class Undefined(Terms):
    """Has no value of one of its terms where the first state is above a limit."""

    def __init__(self, of, which, limit):
        vars(self).update(vars(of))
        self._which, self._limit = which, limit

    def floats(self, x):
        return [
            math.nan if i == self._which and x[0] > self._limit else v
            for i, v in enumerate(super().floats(x))
        ]

    def arrays(self, x):
        return tuple(
            np.where((i == self._which) & (x[0] > self._limit), np.nan, v)
            for i, v in enumerate(super().arrays(x))
        )


def lie(system, barrier, degree):
    """L_f h, ..., L_f^r h and the entries of L_g L_f^(r-1) h, with the numbers of the system."""
    along = derivatives(system, barrier.expression, degree, lie_derivative_f)
    return [system.numeric(e) for e in (*along[1:], *lie_derivative_g(system, along[degree - 1]))]


def residual_of(problem, errors=()) -> Any:
    """The exact residuals."""
    parts = []
    for i, barrier in enumerate(problem.barriers):
        r = len(problem.gains_of(i))
        truth, believed = (lie(system, barrier, r) for system in (problem.plant, problem.model))
        parts.append(
            Terms(problem.plant, r, [p - m for p, m in zip(truth, believed, strict=True)], errors)
        )
    return ResidualModel(Signature.of(problem), NO_RECORD, tuple(parts))


def generator_of(problem, degree) -> Any:
    """The exact part of the noise, and of the order below its slopes."""
    plant, h = problem.plant, problem.barriers[0].expression
    noisy, plain = (derivatives(plant, h, degree, d) for d in (generator, lie_derivative_f))
    parts = [a - b for a, b in zip(noisy, plain, strict=True)]
    slopes = [sp.diff(parts[-2], s) for s in plant.states] if degree > 1 else []
    return GeneratorModel(
        Signature.of(problem), NO_RECORD, (Terms(plant, degree, [parts[-1], *slopes]),)
    )  # pyright: ignore[reportArgumentType]


def values(system, expressions, x):
    compiled = compile_function(system.states, [system.numeric(e) for e in expressions], "arrays")
    return stacked(compiled(*np.ascontiguousarray(x.T)), len(x))


def situations(problem, count, seed=0):
    """States where the problem is explored, and inputs from a box twice as wide as its own."""
    rng = np.random.default_rng(seed)
    low, high = np.array(problem.input_bounds).T
    return draw_states(problem, count, rng), rng.uniform(
        1.5 * low - 0.5 * high, 1.5 * high - 0.5 * low, (count, len(low))
    )


def assert_same_decisions(problem, one, other, count=200, tolerance=1e-9):
    """In both flavours; relative to the box, and to what the margins reach."""
    x, u = situations(problem, count)
    width = np.ptp(problem.input_bounds, axis=1)
    mine, theirs = one.filter(x, u), other.filter(x, u)
    assert (mine.action != u).any()
    assert (abs(mine.action - theirs.action) <= tolerance * width).all()
    assert (abs(mine.margin - theirs.margin) <= tolerance * (1.0 + abs(theirs.margin).max())).all()
    assert (mine.feasible == theirs.feasible).all()
    for i in range(20):
        single = one.filter(x[i], u[i])
        assert (abs(single.action - theirs.action[i]) <= tolerance * width).all()
        assert single.feasible == theirs.feasible[i]


def assert_floats_are_arrays(safety_filter, x, u, tolerance=1e-9):
    batch = safety_filter.filter(x, u)
    for i in range(len(x)):
        single = safety_filter.filter(x[i], u[i])
        for ours, theirs in zip(single, batch, strict=True):
            np.testing.assert_allclose(ours, theirs[i], rtol=tolerance, atol=tolerance)
    return batch


def worst_row(problem, x, u, errors):
    """The least of h^(r) + ... + k_0 h under an input over the corners of the errors of exact
    residuals."""
    r, (p_1, p_2) = 2, problem.gains_of(0)
    h = values(problem.plant, [problem.barriers[0].expression], x)[:, 0]
    first, second, *gains = values(problem.plant, lie(problem.plant, problem.barriers[0], r), x).T
    rows = []
    for e_1, e_2, *e_u in itertools.product(*[(-e, e) for e in errors]):
        highest = (
            second
            + e_2
            + sum((g + e) * u[:, j] for j, (g, e) in enumerate(zip(gains, e_u, strict=True)))
        )
        rows.append(highest + (p_1 + p_2) * (first + e_1) + p_1 * p_2 * h)
    return np.min(rows, axis=0)
