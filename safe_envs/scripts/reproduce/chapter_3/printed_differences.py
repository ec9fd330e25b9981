"""Residuals of a barrier of degree 2, learned from the printed differences of Eq. (3.28)."""

from __future__ import annotations

import numpy as np

from safe_envs import ControlAffineSDE, SafetyProblem
from safe_envs.dynamics.codegen import compile_function, stacked
from safe_envs.dynamics.lie import derivatives, lie_derivative_f, lie_derivative_g
from safe_envs.scripts.reproduce.chapter_3.learned_runs import learning_sizes
from safe_envs.scripts.reproduce.framework.artefact import Workload
from safe_envs.wrappers.learning.data.collection import collect_paths, draw_states
from safe_envs.wrappers.learning.data.signature import Signature
from safe_envs.wrappers.learning.fit import AdamSettings, train
from safe_envs.wrappers.learning.models.base import Record
from safe_envs.wrappers.learning.models.residual import LearnedResidual, ResidualModel


def printed_residuals(
    problem: SafetyProblem, sample: Workload, seed: int
) -> tuple[ResidualModel, float]:
    """Return what is learned from differences over control periods.

    Also return the median share of the input's gain in them.

    The backward period is driven straight on, the forward one under either of two inputs.

    Args:
        problem: with a single input.
        sample: how much is learned.
        seed: of the states and of the network.

    Source: thesis Eq. (3.28), with Eq. (3.24).
    """
    count, epochs = learning_sizes(sample)
    before = draw_states(problem, count, np.random.default_rng(seed))
    x = _stepped(problem, before, 0.0)
    first, second = problem.sampling_domain.inputs[0][0], problem.sampling_domain.inputs[-1][0]
    known, true = (
        _lie_derivatives(system, problem, x) for system in (problem.model, problem.plant)
    )
    slope = (_barrier(problem, x) - _barrier(problem, before)) / problem.dt
    excess = [
        _second_difference(problem, before, x, u) - known[2] - known[3] * u for u in (first, second)
    ]
    gain = (excess[1] - excess[0]) / (second - first)
    targets = np.stack([slope - known[1], excess[0] - gain * first, gain], axis=1)
    coordinates = problem.sampling_domain.coordinates
    inputs = stacked(
        compile_function(problem.plant.states, coordinates, "arrays")(*np.ascontiguousarray(x.T)),
        count,
    )
    trained = train(inputs, targets, AdamSettings(epochs=epochs), seed=seed)
    part = LearnedResidual(problem.plant.states, coordinates, 2, trained.network, trained.heldout)
    record = Record(3 * count, 3 * count * problem.dt, 0.0, seed)
    return ResidualModel(Signature.of(problem), record, (part,)), float(
        np.median((gain + known[3]) / true[3])
    )


def _stepped(problem: SafetyProblem, states: np.ndarray, u: float) -> np.ndarray:
    """Return states, shape (B, n), a control period later under one held input."""
    return collect_paths(problem, states, np.full((len(states), 1), u), 1, problem.dt)[:, 1]


def _second_difference(
    problem: SafetyProblem, before: np.ndarray, x: np.ndarray, u: float
) -> np.ndarray:
    h_before, h, h_after = (
        _barrier(problem, states) for states in (before, x, _stepped(problem, x, u))
    )
    return (h_after + h_before - 2 * h) / problem.dt**2


def _barrier(problem: SafetyProblem, states: np.ndarray) -> np.ndarray:
    return compile_function(problem.plant.states, [problem.barriers[0].expression], "arrays")(
        *np.ascontiguousarray(states.T)
    )[0]


def _lie_derivatives(
    system: ControlAffineSDE, problem: SafetyProblem, states: np.ndarray
) -> np.ndarray:
    """Return h, L_f h, L_f^2 h and L_g L_f h at states, shape (4, B)."""
    along = derivatives(system, problem.barriers[0].expression, 2, lie_derivative_f)
    expressions = [system.numeric(e) for e in (*along, *lie_derivative_g(system, along[1]))]
    return stacked(
        compile_function(system.states, expressions, "arrays")(*np.ascontiguousarray(states.T)),
        len(states),
    ).T
