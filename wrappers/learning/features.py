"""Features on which unknown functions of the state are regressed: monomials of scaled coordinates."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.codegen import compile_function, stacked
from safe_envs.errors import ConfigurationError, require_whole
from safe_envs.problem import SafetyProblem


@dataclass(frozen=True)
class Features:
    """Monomials of the states up to a total degree, each state scaled from its range to [-1, 1].

    An angle enters by its cosine and sine; squares of the sine are left out, since they are 1 less those of the cosine.

    Attributes:
        states: n symbols.
        region: (low, high) of each state; what it is for an angle does not matter.
        degree: total degree, from 0.
        angles: names of the states that are angles.

    Raises:
        ConfigurationError: the degree is no whole number from 0.
    """

    states: tuple[sp.Symbol, ...]
    region: tuple[tuple[float, float], ...]
    degree: int
    angles: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        require_whole("degree", self.degree, 0)
        unknown = set(self.angles) - {s.name for s in self.states}
        if unknown or len(self.region) != len(self.states):
            raise ConfigurationError(f"features of {self.states} with the ranges {self.region} and the angles {self.angles} do not fit")

    @classmethod
    def of(cls, problem: SafetyProblem, degree: int) -> Features:
        """Features over the region in which a problem is explored; its unbounded states are the angles."""
        angles = tuple(s.symbol.name for s in problem.states if np.isinf(s.low) and np.isinf(s.high))
        return cls(problem.plant.states, problem.exploration.region, degree, angles)

    @cached_property
    def expressions(self) -> tuple[Any, ...]:
        """M expressions of the states; the first is 1."""
        found = []
        for state, (low, high) in zip(self.states, self.region, strict=True):
            if state.name in self.angles:
                found.append([(sp.cos(state), self.degree), (sp.sin(state), 1)])
            else:
                center, half = 0.5 * (low + high), 0.5 * (high - low)
                found.append([((state - center) / half if center else state / half, self.degree)])
        coordinates = [entry for entries in found for entry in entries]
        chosen = [c for total in range(self.degree + 1) for c in itertools.combinations_with_replacement(range(len(coordinates)), total)]
        allowed = [c for c in chosen if all(c.count(k) <= most for k, (_, most) in enumerate(coordinates))]
        return tuple(sp.Mul(*[coordinates[k][0] for k in c]) for c in allowed)

    @property
    def count(self) -> int:
        """M, the number of features."""
        return len(self.expressions)

    @cached_property
    def _compiled(self) -> Any:
        return compile_function(self.states, self.expressions, "arrays")

    def matrix(self, x: np.ndarray) -> np.ndarray:
        """The features at states (B, n), shape (B, M)."""
        return stacked(self._compiled(*np.ascontiguousarray(x.T)), len(x))

    def combined(self, weights: Sequence[float]) -> sp.Expr:
        """The function with these M weights, multiplied out."""
        terms = [sp.Float(float(w), 17) * e for w, e in zip(weights, self.expressions, strict=True)]
        return sp.expand(sp.Add(*terms))
