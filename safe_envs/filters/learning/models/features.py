"""Features on which unknown functions of the state are regressed: monomials of scaled states."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import tabulated
from safe_envs.errors import ConfigurationError, require_whole, shown
from safe_envs.filters.learning.data import require_finite, require_text
from safe_envs.problem.problem import SafetyProblem

_MOST = 300
"""Features; a regression holds the square of some multiple of their number, and their symbols take
minutes to write out."""


@dataclass(frozen=True)
class Features:
    """Monomials of the states up to a total degree, each state scaled from its range to [-1, 1].

    An angle enters by its cosine and sine; squares of the sine are left out, since they are 1 less
    those of the cosine.

    Attributes:
        states: n symbols.
        region: (low, high) of each state; what it is for an angle does not matter.
        degree: total degree, from 0.
        angles: names of the states that are angles.

    Raises:
        ConfigurationError: the degree is no whole number from 0, or makes more than 300 features.
    """

    states: tuple[sp.Symbol, ...]
    region: tuple[tuple[float, float], ...]
    degree: int
    angles: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        require_whole("degree", self.degree, 0)
        unknown = set(self.angles) - {s.name for s in self.states}
        if unknown or len(self.region) != len(self.states):
            raise ConfigurationError(
                f"features of {self.states} with the ranges {self.region} and the angles"
                f" {self.angles} do not fit"
            )
        if self.count > _MOST:
            names = ", ".join(s.name for s in self.states)
            raise ConfigurationError(
                f"degree = {self.degree} makes {self.count} features of {names}; give one with at"
                f" most {_MOST}"
            )

    @classmethod
    def of(cls, problem: SafetyProblem, degree: int, name: str = "degree") -> Features:
        """Make features over the region that is explored; unbounded states are the angles.

        Args:
            problem: whose region and states are taken.
            degree: total degree, from 0.
            name: by which the user knows the degree, for the messages.

        Raises:
            ConfigurationError: the degree is not allowed.
        """
        require_whole(name, degree, 0)
        return cls(problem.plant.states, problem.sampling_domain.region, degree, _angles(problem))

    def details(self) -> dict[str, Any]:
        """Return all but the states, for JSON."""
        region = [list(ends) for ends in self.region]
        return {"degree": self.degree, "region": region, "angles": list(self.angles)}

    @classmethod
    def restored(cls, states: tuple[sp.Symbol, ...], details: Mapping[str, Any]) -> Features:
        """Make features as a file describes them.

        Args:
            states: n symbols.
            details: see `details`; others among them do not matter.

        Raises:
            TypeError, ValueError: it describes none.
        """
        ranges = tuple(
            (require_finite(low), require_finite(high)) for low, high in details["region"]
        )
        angles = tuple(map(require_text, details["angles"]))
        found = cls(states, ranges, details["degree"], angles)
        if not all(0 < 0.5 * (high - low) < math.inf for low, high in ranges):
            raise ValueError(f"the ranges {shown(ranges)}")
        return found

    @classmethod
    def allowed(cls, problem: SafetyProblem, degree: int) -> bool:
        """Return whether there are not too many features for `of` with a degree from 0.

        Args:
            problem: whose states are taken.
            degree: total degree.
        """
        return _count(len(problem.states), len(_angles(problem)), degree) <= _MOST

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
        chosen = [
            c
            for total in range(self.degree + 1)
            for c in itertools.combinations_with_replacement(range(len(coordinates)), total)
        ]
        allowed = [
            c for c in chosen if all(c.count(k) <= most for k, (_, most) in enumerate(coordinates))
        ]
        return tuple(sp.Mul(*[coordinates[k][0] for k in c]) for c in allowed)

    @property
    def count(self) -> int:
        """M, the number of features."""
        return _count(len(self.states), len(self.angles), self.degree)

    @cached_property
    def _compiled(self) -> Any:
        return tabulated(self.states, self.expressions)

    def matrix(self, x: np.ndarray) -> np.ndarray:
        """Return the features at states (B, n), shape (B, M)."""
        return self._compiled(x)

    def combined(self, weights: Sequence[float]) -> sp.Expr:
        """Return the function with these M weights, multiplied out."""
        terms = [sp.Float(float(w), 17) * e for w, e in zip(weights, self.expressions, strict=True)]
        return sp.expand(sp.Add(*terms))


def _angles(problem: SafetyProblem) -> tuple[str, ...]:
    return tuple(s.symbol.name for s in problem.states if np.isinf(s.low) and np.isinf(s.high))


def _count(states: int, angles: int, degree: int) -> int:
    """Return the number of features: monomials in the states, each times some of the sines."""
    return sum(
        math.comb(angles, k) * math.comb(states + degree - k, states)
        for k in range(min(angles, degree) + 1)
    )
