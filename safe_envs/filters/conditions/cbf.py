"""Conditions that need nothing but a model.

CBF, ECBF, HOCBF and RCBF ignore the noise; SCBF, SZCBF and SRCBF have the Ito generator A in place
of the Lie derivative. The barrier function B of the reciprocal ones, RCBF and SRCBF, is unbounded
at the edge.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from numbers import Number
from typing import Any

import sympy as sp
from mpmath.libmp import NoConvergence  # pyright: ignore[reportMissingImports]

from safe_envs.dynamics.lie import (
    derivatives,
    generator,
    lie_derivative_f,
    quadratic_variation_rate,
    relative_degree,
)
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError, RelativeDegreeError, nearest, shortened, shown
from safe_envs.filters.conditions.base import AffineConstraint, Condition, chain_of, resolved
from safe_envs.filters.conditions.class_k import ClassK, Rate, entries_of, positive_rates, rates
from safe_envs.filters.conditions.names import ONLY_DEGREE_1
from safe_envs.problem.problem import Barrier

_STEPS = 100
"""Of the search for poles. Gains of real negative ones need fewer; others could keep it busy for
seconds."""


@dataclass(frozen=True)
class CBF(Condition):
    """L_f h + L_g h u + alpha(h) >= 0, for relative degree 1.

    Attributes:
        alpha: class-K function; a number is its rate in 1/s.

    Source: thesis Def. 3.1.2.
    """

    alpha: Rate = 1.0
    name = "cbf"

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "alpha", rates("alpha", (self.alpha,))[0])

    def derived(self, model: ControlAffineSDE, barrier: Barrier) -> AffineConstraint:
        """Derive the constraint; a relative degree other than 1 is a `RelativeDegreeError`."""
        try:
            return AffineConstraint.after(
                model, *chain_of(model, barrier, (self.alpha,), lie_derivative_f)
            )
        except RelativeDegreeError as error:
            raise RelativeDegreeError(f"{error}. {ONLY_DEGREE_1}") from error

    @classmethod
    def for_gains(cls, gains: Sequence[float]) -> CBF:
        """Return the CBF with the first rate."""
        return cls(gains[0])

    def chain_rates(self, degree: int) -> tuple[float, ...] | None:
        """Return alpha where it is linear; see `Condition.chain_rates`."""
        return None if isinstance(self.alpha, ClassK) else (self.alpha,)


@dataclass(frozen=True)
class HOCBF(Condition):
    """b_0 = h, b_j = L_f b_(j-1) + alpha_j(b_(j-1)), and b_r(x, u) >= 0.

    The set that it keeps is the intersection of {b_j >= 0}, j < r, not C itself: a start in C alone
    is no guarantee.

    Attributes:
        alpha: class-K functions alpha_1..alpha_r, as many as the relative degree; a number is the
            rate of a linear one in 1/s.

    Source: thesis Eq. (3.7), (3.10).
    """

    alpha: tuple[Rate, ...] = (1.0,)
    name = "hocbf"

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "alpha", rates("alpha", self.alpha))

    def derived(self, model: ControlAffineSDE, barrier: Barrier) -> AffineConstraint:
        """Derive the constraint; see `chain_of` for what it raises."""
        return AffineConstraint.after(
            model, *chain_of(model, barrier, self.alpha, lie_derivative_f)
        )

    @classmethod
    def for_gains(cls, gains: Sequence[float]) -> HOCBF:
        """Return the HOCBF with all rates."""
        return cls(tuple(gains))

    def chain_rates(self, degree: int) -> tuple[float, ...] | None:
        """Return the rates where all are linear; see `Condition.chain_rates`."""
        linear = tuple(a for a in self.alpha if not isinstance(a, ClassK))
        return linear if len(linear) == len(self.alpha) else None


@dataclass(frozen=True)
class ECBF(Condition):
    """L_f^r h + L_g L_f^(r-1) h u + k_0 h + k_1 L_f h + ... + k_(r-1) L_f^(r-1) h >= 0.

    It is the HOCBF whose rates are minus its poles, and keeps the same sets.

    Attributes:
        k: gains k_0..k_(r-1). The polynomial s^r + k_(r-1) s^(r-1) + ... + k_0 needs real negative
            roots: stability alone, as thesis Def. 3.1.5 prints it, lets h undershoot below 0.
        poles: these roots, in 1/s, if they are given in place of the gains.

    Raises:
        ConfigurationError: a pole is complex or not negative, or both gains and poles are given.

    Source: thesis Eq. (3.6).
    """

    k: tuple[float, ...] | None = None
    poles: tuple[float, ...] | None = field(default=None, compare=False)
    name = "ecbf"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.poles is None:
            gains = positive_rates("k", (1.0,) if self.k is None else self.k)
            _real_negative_roots(gains)
        else:
            poles = _real_negative_poles(self.poles)
            gains = gains_of_poles(poles)
            if self.k not in (None, gains):
                raise ConfigurationError(
                    f"ecbf takes gains or poles; k = {self.k} and poles = {poles} were given"
                )
            object.__setattr__(self, "poles", poles)
        object.__setattr__(self, "k", gains)

    def derived(self, model: ControlAffineSDE, barrier: Barrier) -> AffineConstraint:
        """Derive the constraint.

        Raises:
            RelativeDegreeError: the number of gains is not the relative degree, or there is none.
        """
        gains: tuple[float, ...] = self.k or ()
        degree = relative_degree(model, barrier.expression)
        if len(gains) != degree:
            raise RelativeDegreeError(
                f"barrier {barrier.name} has relative degree {degree} and needs as many gains;"
                f" {len(gains)} given"
            )
        eta = derivatives(model, barrier.expression, degree, lie_derivative_f)
        offset = eta[-1] + sum(sp.Float(k, 17) * e for k, e in zip(gains, eta, strict=False))
        chain, _ = chain_of(model, barrier, self.chain_rates(degree), lie_derivative_f)
        return AffineConstraint.after(model, chain, offset)

    @classmethod
    def for_gains(cls, gains: Sequence[float]) -> ECBF:
        """Return the ECBF with its poles at minus the rates."""
        return cls(poles=tuple(-rate for rate in gains))

    def chain_rates(self, degree: int) -> tuple[float, ...]:
        """Return minus the poles, the slowest first; see `Condition.chain_rates`."""
        return tuple(sorted(-pole for pole in self.poles or _real_negative_roots(self.k or ())))

    @property
    def parameters(self) -> dict[str, Any]:
        """The poles where they are given, else the gains."""
        return {"poles": self.poles} if self.poles else {"k": self.k}


_WHY = (
    "place real negative ones, one for each relative degree; with complex poles h would oscillate"
    " through 0, and with others it would not come back to the safe set"
)


def gains_of_poles(poles: Sequence[float]) -> tuple[float, ...]:
    """Return k_0..k_(r-1) of the monic polynomial with the given roots."""
    s = sp.Symbol("s")
    polynomial = sp.Poly(sp.Mul(*[s - sp.Rational(repr(p)) for p in poles]), s)
    return tuple(float(c) for c in reversed(polynomial.all_coeffs()[1:]))


def _real_negative_poles(given: Any) -> tuple[float, ...]:
    entries = entries_of(given)
    listing = shortened(", ".join(map(str, entries)) or "none")
    if not all(isinstance(pole, Number) and not isinstance(pole, bool) for pole in entries):
        raise ConfigurationError(
            f"poles = {listing}; give numbers in 1/s, one for each relative degree"
        )
    poles = [complex(pole) for pole in entries]
    if not poles or any(pole.imag or not -math.inf < pole.real < 0 for pole in poles):
        raise ConfigurationError(f"poles = {listing}: {_WHY}")
    return tuple(pole.real for pole in poles)


def _real_negative_roots(gains: Sequence[float]) -> tuple[float, ...]:
    polynomial = sp.Poly([1, *(sp.Rational(repr(k)) for k in reversed(gains))], sp.Symbol("s"))
    try:
        # A factor that is repeated exactly is solved once: the iteration does not converge at
        # multiple roots.
        roots = [
            root
            for factor, count in polynomial.sqf_list()[1]
            for root in factor.nroots(n=50, maxsteps=_STEPS) * count
        ]
    except NoConvergence as error:
        raise ConfigurationError(
            f"the poles of k = {shown(gains)} cannot be computed; give poles in place of gains"
        ) from error
    # Rounding of the gains splits a multiple pole into a ring about it: what oscillates so slowly
    # is real.
    if any(sp.re(root) >= 0 or abs(sp.im(root)) > 1e-3 * abs(root) for root in roots):
        listing = ", ".join(str(sp.N(root, 4)) for root in roots)
        raise ConfigurationError(
            f"k = {shown(gains)} has its poles at {shortened(listing)}: {_WHY}"
        )
    return tuple(float(sp.re(root)) for root in roots)


@dataclass(frozen=True)
class SCBF(Condition):
    """A^r h >= 0, with the Ito generator A and the stochastic relative degree r.

    Its bounds: `safe_envs.proofs.guarantees`.

    Source: thesis Def. 4.2.6, Prop. 4.2.8, Thm. 4.2.10. The thesis defines the relative degree by
        A^j h = 0; it means that L_g A^(j-1) h = 0 below r.
    """

    name = "scbf"
    stochastic = True

    def derived(self, model: ControlAffineSDE, barrier: Barrier) -> AffineConstraint:
        """Derive the constraint; see `chain_of` for what it raises."""
        return AffineConstraint.after(model, *chain_of(model, barrier, None, generator))

    def chain_rates(self, degree: int) -> tuple[float, ...]:
        """Return zeros; see `Condition.chain_rates`."""
        return (0.0,) * degree


@dataclass(frozen=True)
class SZCBF(Condition):
    """h_0 = h, h_j = A h_(j-1) + alpha_j h_(j-1), and h_r(x, u) >= 0, with the Ito generator A.

    Its bounds: `safe_envs.proofs.guarantees`.

    Attributes:
        alpha: rates alpha_1..alpha_r in 1/s, as many as the relative degree.

    Source: thesis Def. 4.2.4, Prop. 4.2.5 and, for higher degrees, Sec. 4.3.2, whose
        h_2 = A h_1 + alpha_2 h lets even noise-free trajectories leave the set.
    """

    alpha: tuple[float, ...] = (1.0,)
    name = "szcbf"
    stochastic = True

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "alpha", positive_rates("alpha", self.alpha))

    def derived(self, model: ControlAffineSDE, barrier: Barrier) -> AffineConstraint:
        """Derive the constraint; see `chain_of` for what it raises."""
        return AffineConstraint.after(model, *chain_of(model, barrier, self.alpha, generator))

    @classmethod
    def for_gains(cls, gains: Sequence[float]) -> SZCBF:
        """Return the SZCBF with all rates."""
        return cls(tuple(gains))

    def chain_rates(self, degree: int) -> tuple[float, ...]:
        """Return the rates; see `Condition.chain_rates`."""
        return self.alpha


_H = sp.Symbol("h", positive=True)
_FORMS = {"inverse": 1 / _H, "log": -sp.log(_H / (1 + _H))}


@dataclass(frozen=True)
class _Reciprocal(Condition):
    """A B <= gamma / B for B = beta(h), as a constraint on the rate of h.

    With A B = beta' A h + beta''/2 |sigma' grad h|^2 and beta' < 0, dividing by beta' gives

        A h >= (gamma/beta - beta''/2 |sigma' grad h|^2)/beta'

    whose slack has the units of h per s. It is defined where h > 0 only, by more than the
    rounding of h: beyond the edge the inequality would turn round, so that there the constraint is
    A h alone.
    """

    gamma: float = 1.0
    form: str = "inverse"

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "gamma", positive_rates("gamma", (self.gamma,))[0])
        if self.form not in _FORMS:
            raise ConfigurationError(
                f"form = {shown(self.form)}; {nearest(str(self.form), _FORMS)}"
            )

    def derived(self, model: ControlAffineSDE, barrier: Barrier) -> AffineConstraint:
        """Derive the constraint.

        Raises:
            RelativeDegreeError: the relative degree is not 1.
        """
        h = barrier.expression
        degree = relative_degree(model, h, self.derivative)
        if degree != 1:
            raise RelativeDegreeError(
                f"barrier {barrier.name} has relative degree {degree}; {self.name} is for relative"
                " degree 1. Use hocbf, scbf or szcbf"
            )
        beta = _FORMS[self.form]
        slope = sp.diff(beta, _H)
        demand = sp.simplify(sp.Float(self.gamma, 17) / beta / slope)
        if self.stochastic:
            demand -= sp.simplify(sp.diff(beta, _H, 2) / slope / 2) * quadratic_variation_rate(
                model, h
            )
        return AffineConstraint.after(
            model, (h,), resolved(self.derivative(model, h), barrier), demand.subs(_H, h)
        )


@dataclass(frozen=True)
class RCBF(_Reciprocal):
    """L_f B + L_g B u <= gamma / B, for relative degree 1, without noise.

    Outside C it has no meaning: the filter gives the action of the largest rate of h there, flagged
    as infeasible.

    Attributes:
        gamma: weight > 0, in 1/s times the square of the unit of B; no rate, so that the gains of a
            problem do not set it.
        form: "inverse" for B = 1/h, "log" for B = -log(h/(1 + h)).

    Source: thesis Sec. 2.1.2, Def. 2.1.6.
    """

    name = "rcbf"


@dataclass(frozen=True)
class SRCBF(_Reciprocal):
    """A B <= gamma / B with the Ito generator A, for relative degree 1.

    Under noise the second derivative of B asks for unbounded control towards the edge: a box breaks
    the condition there. Outside C it has no meaning: the filter gives the action of the largest A h
    there, flagged as infeasible.

    Attributes:
        gamma: weight > 0, in 1/s times the square of the unit of B; no rate, so that the gains of a
            problem do not set it.
        form: "inverse" for B = 1/h, "log" for B = -log(h/(1 + h)).

    Source: thesis Def. 4.2.1, Sec. 4.2.2 and 4.3.1.
    """

    name = "srcbf"
    stochastic = True
    almost_sure = True
