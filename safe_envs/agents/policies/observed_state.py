"""The state of the plant, read off observations."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import Components, compile_function
from safe_envs.errors import ConfigurationError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.problem.signals import TIME


class ObservedState:
    """Solves the features of a problem for its states.

    A state is a feature itself; an angle whose cosine and sine are features, if a whole turn
    changes nothing; or the only unknown of a feature that is linear in it, such as the relative
    position of an obstacle once the own position is known.

    Args:
        problem: whose features they are.
        needed: states that must be read; the others are 0 where the observation does not hold
            them.

    Raises:
        ConfigurationError: The observation does not hold one of the states that are needed.
    """

    def __init__(self, problem: SafetyProblem, needed: Collection[sp.Basic]) -> None:
        columns = tuple(sp.Dummy(feature.name, real=True) for feature in problem.features)
        given: list[tuple[Any, Any]] = [
            (problem.plant.numeric(feature.expression), column)
            for feature, column in zip(problem.features, columns, strict=True)
            if not feature.expression.has(TIME)
        ]
        found = _solved(problem, given)
        missing = [str(s) for s in problem.plant.states if s in needed and s not in found]
        if missing:
            raise ConfigurationError(
                f"the observation of {problem.name} does not determine {', '.join(missing)}, which"
                " the policy best needs; add features: each of these states, or the cosine and the"
                " sine of an angle"
            )
        values = [found.get(s, sp.Integer(0)) for s in problem.plant.states]
        self._function = compile_function(columns, values, "arrays")

    def __call__(self, observations: np.ndarray) -> Components:
        """Return the components of the states, n arrays (B,), of observations (B, k)."""
        values = self._function(*np.ascontiguousarray(observations.T))
        return tuple(np.broadcast_to(value, len(observations)) for value in values)


def _solved(problem: SafetyProblem, given: list[tuple[Any, Any]]) -> dict[Any, Any]:
    """Return the states that features determine, as expressions of the features' values.

    Args:
        problem: whose states they are.
        given: expressions of the states, with the symbols of their values.
    """
    found: dict[Any, Any] = {s: value for s, value in given if s.is_Symbol}
    of = dict(given)
    for s in problem.plant.states:
        if s not in found and {sp.cos(s), sp.sin(s)} <= of.keys() and _turns(problem, s):
            found[s] = sp.atan2(of[sp.sin(s)], of[sp.cos(s)])
    known = -1
    while known < len(found):
        known = len(found)
        for expression, value in given:
            unknown = expression.free_symbols & set(problem.plant.states) - found.keys()
            if len(unknown) != 1:
                continue
            (s,) = unknown
            slope = sp.expand(expression).coeff(s)
            rest = sp.expand(expression - slope * s)
            if slope.is_number and not rest.has(s):
                found[s] = (value - rest.xreplace(found)) / slope
    return found


def _turns(problem: SafetyProblem, angle: sp.Symbol) -> bool:
    """Return whether a whole turn of an angle changes neither the motion nor what is safe."""
    plant = problem.plant
    parts = [
        *plant.drift,
        *plant.input_matrix,
        *plant.diffusion,
        *(barrier.expression for barrier in problem.barriers),
        problem.outside,
        sp.Integer(0) if problem.goal is None else problem.goal,
    ]
    return all(sp.expand(e - e.subs(angle, angle + 2 * sp.pi)) == 0 for e in parts)
