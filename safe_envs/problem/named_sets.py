"""The sets of states that a problem names: `safe`, `goal` and its regions."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import Components, compile_function, stacked
from safe_envs.errors import ConfigurationError, NumericalError, nearest, shown
from safe_envs.problem.problem import SafetyProblem
from safe_envs.problem.regions import GOAL, SAFE


def set_names(problem: SafetyProblem) -> tuple[str, ...]:
    """Return the names of the sets, `safe` first."""
    return (SAFE, *([] if problem.goal is None else [GOAL]), *problem.regions)


def set_expressions(problem: SafetyProblem, name: str) -> tuple[sp.Expr, ...]:
    """Return expressions of the states of which the smallest is the value of a set.

    A state is in `safe` where that value is positive, and in another set where it is >= 0.

    Args:
        problem: which has the set.
        name: of the set.

    Raises:
        ConfigurationError: The problem has no such set, or its goal depends on more than states.
    """
    if name == SAFE:
        return tuple(barrier.expression for barrier in problem.barriers)
    expression = problem.goal if name == GOAL else problem.regions.get(name)
    if expression is None:
        raise ConfigurationError(
            f"{problem.name} has no set {shown(name)}; {nearest(name, set_names(problem))}"
        )
    others = expression.free_symbols - {*problem.plant.states, *problem.plant.parameters}
    if others:
        raise ConfigurationError(
            f"the goal of {problem.name} depends on {', '.join(map(str, others))}; a set of a"
            " specification is a function of the states alone"
        )
    return (expression,)


class NamedSets:
    """Values of some sets of a problem, compiled.

    Attributes:
        names: of the sets.

    Args:
        problem: which has the sets.
        names: of those that are wanted.

    Raises:
        ConfigurationError: see `set_expressions`.
    """

    def __init__(self, problem: SafetyProblem, names: Iterable[str]) -> None:
        self.names = tuple(names)
        parts = [set_expressions(problem, name) for name in self.names]
        self._ends = np.cumsum([len(part) for part in parts])[:-1]
        self._problem = problem.name
        expressions = [problem.plant.numeric(e) for part in parts for e in part]
        self._values = compile_function(problem.plant.states, expressions, "arrays")
        self._least = np.array(
            [np.nextafter(0.0, 1.0) if name == SAFE else 0.0 for name in self.names]
        )[:, None]

    def values(self, x: Components) -> np.ndarray:
        """Return the values of the sets, positive inside, shape (number of sets, B).

        Args:
            x: n components of states, each (B,).

        Raises:
            NumericalError: One is NaN.
        """
        with np.errstate(all="ignore"):
            table = stacked(self._values(*x), len(x[0]))
        parts = np.split(table, self._ends, axis=1)
        for name, part in zip(self.names, parts, strict=True):
            if name == SAFE:  # a barrier without a value is not safe
                part[~np.isfinite(part)] = -np.inf
        values = np.array([part.min(axis=1) for part in parts])
        if np.isnan(values).any():
            i, b = np.argwhere(np.isnan(values))[0].tolist()
            raise NumericalError(
                f"the set {self.names[i]!r} of {self._problem} has no value at the state"
                f" {[float(component[b]) for component in x]}; check it there"
            )
        return values

    def inside(self, values: np.ndarray) -> np.ndarray:
        """Return whether states with these values of the sets are in them, a bool array.

        Args:
            values: shape (number of sets, B).
        """
        return values >= self._least
