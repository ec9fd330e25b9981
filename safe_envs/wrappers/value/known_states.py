"""States that are known in advance: they move by themselves, from a start without any choice."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import compile_function
from safe_envs.dynamics.integrators import rate
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.problem.signals import TIME


def known_states(problem: SafetyProblem, system: ControlAffineSDE) -> tuple[sp.Symbol, ...]:
    """Return the states that are known in advance.

    Neither inputs nor noise reach them, their drift depends on known states alone, and the start in
    use has one value for each.

    Args:
        problem: with the start in use.
        system: plant or model, whose further states, next to the problem's, are unknown.
    """
    rates = dict(zip(system.states, rate(system), strict=True))
    noise = system.numeric(system.diffusion)
    start = dict(zip(problem.plant.states, problem.starts[problem.start].state, strict=True))
    known = [
        s
        for i, s in enumerate(system.states)
        if s in start and not sp.sympify(start[s]).free_symbols and noise[i, :].is_zero_matrix
    ]
    while True:
        # Inputs and uncertain parameters are no states that could be known.
        fewer = [s for s in known if rates[s].free_symbols <= set(known)]
        if len(fewer) == len(known):
            return tuple(known)
        known = fewer


def known_values(
    problem: SafetyProblem, known: Sequence[sp.Symbol], following: Mapping[sp.Symbol, Any]
) -> tuple[Mapping[sp.Symbol, np.ndarray], Mapping[sp.Symbol, sp.Expr]]:
    """Return what known states are, as functions of time or as numbers.

    Args:
        problem: with the start in use.
        known: the states.
        following: each state after a sub-step.

    Returns:
        Values at each instant of a sub-step, shape (steps substeps + 1,), of the states that move
        and of `TIME`; and the value of each state that does not.

    Raises:
        ConfigurationError: A state has no finite value at some time.
    """
    start: Any = dict(zip(problem.plant.states, problem.starts[problem.start].state, strict=True))
    constant = {s: sp.Float(float(start[s]), 17) for s in known if following[s] == s}
    moving = tuple(s for s in known if s not in constant)
    count = problem.steps * problem.substeps
    times = np.arange(count + 1) / problem.substeps * problem.dt
    if not moving:
        return {TIME: times}, constant
    advance = compile_function(moving, [following[s].xreplace(constant) for s in moving], "floats")
    path = np.empty((count + 1, len(moving)))
    path[0] = [float(start[s]) for s in moving]
    for k in range(count):
        try:
            path[k + 1] = advance(*path[k].tolist())
        except (ArithmeticError, ValueError):
            path[k + 1] = np.nan
        if not np.isfinite(path[k + 1]).all():
            raise ConfigurationError(
                f"{', '.join(map(str, moving))} of {problem.name} have no finite value"
                f" {times[k + 1]:g} s after the start; shorten the horizon"
            )
    return {**dict(zip(moving, path.T.copy(), strict=True)), TIME: times}, constant
