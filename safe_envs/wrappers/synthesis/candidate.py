"""A barrier with numbers that hold at many states."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from safe_envs.wrappers.synthesis.basis import ChebyshevBasis
from safe_envs.wrappers.synthesis.linear_program import MeanBound


@dataclass(frozen=True)
class BarrierCandidate:
    """A barrier psi whose numbers hold at many states, which proves nothing.

    Attributes:
        basis: of psi.
        coefficients: of its members, shape (K,).
        bound: with the rate and the horizon.
        shortfall: m, as sampled.
        supremum: c, as sampled.
        mean: of the bound over the starts.
        program: mean of the bound by the linear program, which knows fewer states.
        rounds: linear programs that were solved.
    """

    basis: ChebyshevBasis
    coefficients: np.ndarray
    bound: MeanBound
    shortfall: float
    supremum: float
    mean: float
    program: float
    rounds: int

    def embedded(self, basis: ChebyshevBasis) -> BarrierCandidate:
        """Return the same barrier in a basis that has all members of its own."""
        coefficients = basis.embedded(self.basis, self.coefficients)
        return replace(self, basis=basis, coefficients=coefficients)

    def psi(self, x: np.ndarray) -> np.ndarray:
        """Return psi of states (B, n), shape (B,)."""
        return self.basis.values(x) @ self.coefficients
