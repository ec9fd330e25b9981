"""Reciprocal conditions, whose barrier function B is unbounded at the edge: RCBF, SRCBF."""

from __future__ import annotations

from dataclasses import dataclass

import sympy as sp

from safe_envs.dynamics.lie import quadratic_variation_rate, relative_degree
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError, RelativeDegreeError, nearest, shown
from safe_envs.filters.conditions.base import AffineConstraint, Condition, resolved
from safe_envs.filters.conditions.class_k import positive_rates
from safe_envs.problem.problem import Barrier

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
