"""Conditions that ignore the noise: CBF, ECBF, HOCBF."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import sympy as sp

from safe_envs.barrier import Barrier
from safe_envs.calculus import derivatives, drift_derivative, relative_degree
from safe_envs.errors import ConfigurationError, RelativeDegreeError
from safe_envs.sde import ControlAffineSDE
from wrappers.conditions.base import AffineConstraint, Condition, linear_chain, positive_rates


@dataclass(frozen=True)
class CBF(Condition):
    """L_f h + L_g h u + alpha h >= 0, for relative degree 1.

    Attributes:
        alpha: rate in 1/s.

    Source: thesis Def. 3.1.2.
    """

    alpha: float = 1.0
    name = "cbf"

    def __post_init__(self) -> None:
        object.__setattr__(self, "alpha", positive_rates("alpha", (self.alpha,))[0])

    def constraint(self, model: ControlAffineSDE, barrier: Barrier) -> AffineConstraint:
        """Derive the constraint.

        Raises:
            RelativeDegreeError: the relative degree is not 1.
        """
        try:
            return linear_chain(model, barrier, (self.alpha,), drift_derivative)
        except RelativeDegreeError as error:
            raise RelativeDegreeError(f"{error}. A cbf is for relative degree 1; use hocbf or ecbf") from error

    @classmethod
    def for_gains(cls, gains: Sequence[float]) -> CBF:
        """The CBF with the first rate."""
        return cls(gains[0])


@dataclass(frozen=True)
class HOCBF(Condition):
    """b_0 = h, b_j = L_f b_(j-1) + p_j b_(j-1), and b_r(x, u) >= 0.

    The set that it keeps is the intersection of {b_j >= 0}, j < r, not C itself: a start in C alone is no guarantee.

    Attributes:
        p: rates p_1..p_r in 1/s, as many as the relative degree.

    Source: thesis Eq. (3.7), (3.10) with alpha_j(s) = s.
    """

    p: tuple[float, ...] = (1.0,)
    name = "hocbf"

    def __post_init__(self) -> None:
        object.__setattr__(self, "p", positive_rates("p", self.p))

    def constraint(self, model: ControlAffineSDE, barrier: Barrier) -> AffineConstraint:
        """Derive the constraint; see `linear_chain` for what it raises."""
        return linear_chain(model, barrier, self.p, drift_derivative)

    @classmethod
    def for_gains(cls, gains: Sequence[float]) -> HOCBF:
        """The HOCBF with all rates."""
        return cls(tuple(gains))


@dataclass(frozen=True)
class ECBF(Condition):
    """L_f^r h + L_g L_f^(r-1) h u + k_0 h + k_1 L_f h + ... + k_(r-1) L_f^(r-1) h >= 0.

    Attributes:
        k: gains k_0..k_(r-1). The polynomial s^r + k_(r-1) s^(r-1) + ... + k_0 needs real negative roots: stability
            alone, as thesis Def. 3.1.5 prints it, lets h undershoot below 0.

    Raises:
        ConfigurationError: a root is complex or not negative.

    Source: thesis Eq. (3.6).
    """

    k: tuple[float, ...] = (1.0,)
    name = "ecbf"

    def __post_init__(self) -> None:
        gains = positive_rates("k", self.k)
        object.__setattr__(self, "k", gains)
        s = sp.Symbol("s")
        polynomial = sp.Poly([1, *(sp.Rational(repr(g)) for g in reversed(gains))], s)
        roots = polynomial.nroots(maxsteps=200)
        # Rounding splits a multiple pole into a ring about it: what oscillates a thousand times slower than it decays is real.
        if any(sp.re(root) >= 0 or abs(sp.im(root)) > 1e-3 * abs(root) for root in roots):
            roots = ", ".join(str(sp.N(root, 4)) for root in roots)
            raise ConfigurationError(
                f"k = {gains} places complex poles ({roots}), so that h would oscillate through 0; place real negative ones"
            )

    def constraint(self, model: ControlAffineSDE, barrier: Barrier) -> AffineConstraint:
        """Derive the constraint.

        Raises:
            RelativeDegreeError: the number of gains is not the relative degree, or there is none.
        """
        degree = relative_degree(model, barrier.expression)
        if len(self.k) != degree:
            raise RelativeDegreeError(f"barrier {barrier.name} has relative degree {degree} and needs as many gains; {len(self.k)} given")
        chain = derivatives(model, barrier.expression, degree - 1, drift_derivative)
        offset = drift_derivative(model, chain[-1]) + sum(sp.Float(k, 17) * eta for k, eta in zip(self.k, chain, strict=True))
        return AffineConstraint.after(model, chain, offset)

    @classmethod
    def for_gains(cls, gains: Sequence[float]) -> ECBF:
        """The ECBF with its poles at minus the rates."""
        s = sp.Symbol("s")
        polynomial = sp.Poly(sp.Mul(*[s + sp.Rational(repr(float(p))) for p in gains]), s)
        return cls(tuple(float(c) for c in reversed(polynomial.all_coeffs()[1:])))
