"""States that are known in advance: they move by themselves, from a start without any choice."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import compile_function
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.problem.signals import TIME


def known_states(
    problem: SafetyProblem, system: ControlAffineSDE, moved: Sequence[Any]
) -> tuple[Mapping[sp.Symbol, np.ndarray], Mapping[sp.Symbol, sp.Expr]]:
    """Return the states that are functions of time, and those that are numbers.

    A state is known where neither inputs nor noise reach it, its drift depends on known states
    alone, and the start in use has one value for it.

    Args:
        problem: with the start in use.
        system: plant or model, whose further states, next to the problem's, are unknown.
        moved: its states after a sub-step.

    Returns:
        Values at each instant of a sub-step, shape (steps substeps + 1,), of the states that move
        and of `TIME`; and the value of each state that does not.

    Raises:
        ConfigurationError: A known state has no finite value at some time.
    """
    start = dict(zip(problem.plant.states, problem.starts[problem.start].state, strict=True))
    following = dict(zip(system.states, moved, strict=True))
    known = {s: sp.sympify(e) for s, e in start.items() if not sp.sympify(e).free_symbols}
    while True:
        # Inputs, normals and uncertain parameters are no states that could be known.
        fewer = {s: e for s, e in known.items() if following[s].free_symbols <= set(known)}
        if len(fewer) == len(known):
            break
        known = fewer
    constant = {s: sp.Float(float(e), 17) for s, e in known.items() if following[s] == s}
    moving = tuple(s for s in known if s not in constant)
    count = problem.steps * problem.substeps
    times = np.arange(count + 1) / problem.substeps * problem.dt
    if not moving:
        return {TIME: times}, constant
    advance = compile_function(moving, [following[s].xreplace(constant) for s in moving], "floats")
    path = np.empty((count + 1, len(moving)))
    path[0] = [float(known[s]) for s in moving]
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
