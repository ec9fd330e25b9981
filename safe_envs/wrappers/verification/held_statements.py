"""The statements of a held bound for the judge; see `held_bound` for the theorem."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import compile_function, stacked
from safe_envs.dynamics.polynomial import Polynomial
from safe_envs.wrappers.certificates.certificate import Plant
from safe_envs.wrappers.certificates.gaussian_moments import Order
from safe_envs.wrappers.certificates.held_step import HeldStep
from safe_envs.wrappers.verification.statements import PolynomialPart, Statement

_NEAR = 0.05
"""Distance from the edge of C, in half widths of B, within which the slope of psi is of use."""


@dataclass
class HeldStatements:
    """The statements of the theorem for the judge.

    Attributes:
        plant: the system; with a policy its inputs are those of the policy.
        psi: the barrier; B is the box where its scaled variables lie in [-1, 1].
        period: control period in s.
    """

    plant: Plant
    psi: Polynomial
    period: Fraction
    polynomials: dict[sp.Symbol, PolynomialPart] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        self._names: dict[tuple[int, Order], sp.Symbol] = {}
        self._kept: list[Polynomial] = []
        self.scaled_input: Any = sp.Dummy("v", real=True)
        self.value = self.symbol_of(self.psi, (0,) * self.psi.n)

    @cached_property
    def step(self) -> HeldStep:
        """The step of the env."""
        return HeldStep(self.plant, self.psi, self.period)

    def symbol_of(self, polynomial: Polynomial, order: Order) -> sp.Symbol:
        """Return the symbol of a derivative of a polynomial.

        Args:
            polynomial: whose derivative is taken.
            order: how often in each state.
        """
        key = (id(polynomial), order)
        if key not in self._names:
            self._kept.append(polynomial)  # As long as it lives, its id is its own.
            symbol: Any = sp.Dummy("psi_" + "_".join(map(str, order)), real=True)
            self._names[key] = symbol
            self.polynomials[symbol] = PolynomialPart(polynomial, order)
        return self._names[key]

    @property
    def box(self) -> tuple[tuple[Any, Any], ...]:
        """B."""
        pairs = zip(self.psi.center, self.psi.scale, strict=True)
        return tuple((sp.Rational(c - r), sp.Rational(c + r)) for c, r in pairs)

    @property
    def kept_box(self) -> tuple[tuple[Any, Any], ...]:
        """B inside the workspace."""
        return tuple(
            (sp.Max(low, a), sp.Min(high, b))
            for (low, high), (a, b) in zip(self.box, self.plant.workspace, strict=True)
        )

    def outside(self) -> list[Statement]:
        """Return statements whose regions are B minus S together, and whose claim gives psi <= 0.

        Where h <= 0, psi <= psi - l h for any l >= 0. With l the slope of psi across the edge of C,
        which is chosen on each box, this does not change across the edge.
        """
        states, box, parts = self.plant.states, self.box, self._own
        found = []
        for barrier in self.plant.barriers:
            slope: Any = sp.Dummy("slope", real=True)
            found.append(
                Statement(
                    "psi <= 0 where it is not safe",
                    states,
                    box,
                    slope * barrier - self.value,
                    nonnegative=(-barrier,),
                    polynomials=parts,
                    witnesses=(slope,),
                    witness=_slope_across(self.psi, barrier),
                )
            )
        for i, ((low, high), (a, b)) in enumerate(zip(box, self.plant.workspace, strict=True)):
            for end in ((low, a), (b, high)):
                if end[0] <= end[1]:
                    slab = (*box[:i], end, *box[i + 1 :])
                    name = "psi <= 0 outside the workspace"
                    found.append(Statement(name, states, slab, -self.value, polynomials=parts))
        return found

    def region(
        self,
        name: str,
        claim: Any,
        further: tuple[sp.Symbol, ...] = (),
        polynomials: Mapping[sp.Symbol, PolynomialPart] | None = None,
    ) -> Statement:
        """Return a statement about G, where psi and all h are above 0 in B and in the workspace.

        Args:
            name: in words.
            claim: that is to be at least 0.
            further: symbols that take all values: inputs, or `scaled_input`.
            polynomials: what symbols in the claim stand for, if others than `value` do.
        """
        plant = self.plant
        ends = {self.scaled_input: (sp.Integer(-1), sp.Integer(1))}
        ends |= dict(zip(plant.inputs, plant.bounds, strict=True))
        positive = (self.value, *plant.barriers)
        return Statement(
            name,
            (*plant.states, *further),
            (*self.kept_box, *(ends[symbol] for symbol in further)),
            claim,
            positive=positive,
            polynomials=self._own if polynomials is None else polynomials,
        )

    def step_claims(self, shortfall: Any, sag: Any) -> list[Statement]:
        """Return the statements that the inputs keep E psi(X') >= psi(x) - m.

        Under a policy it is one statement. For every input under the constraint, one says that an
        end of the bounds meets it, the other one that psi sags by no more below the chord between.

        Args:
            shortfall: m of the policy or of the constraint.
            sag: how far the expectation may be below its chord, over (1 - v^2) with the scaled
                input v.
        """
        if self.plant.policy:
            gain = self.step.gain(self.plant.policy, self.symbol_of)
            name = "E psi(X') >= psi - m along the policy"
            return [self.region(name, gain + shortfall, polynomials=self.polynomials)]
        by_input = self.step.gain_by_input(self.symbol_of)
        ends = [sum(c * v**j for j, c in enumerate(by_input)) for v in (-1, 1)]
        v = self.scaled_input
        # Each power but the first two is below its chord by a multiple of 1 - v^2.
        above = -sum(
            c * sum(v ** (2 * k + j % 2) for k in range(j // 2)) for j, c in enumerate(by_input)
        )
        return [
            self.region(
                "E psi(X') >= psi - m at an end of the bounds",
                sp.Max(*ends, evaluate=False) + shortfall,
                polynomials=self.polynomials,
            ),
            self.region(
                "E psi(X') above its chord over the bounds",
                above + sag,
                (v,),
                polynomials=self.polynomials,
            ),
        ]

    def moves(self) -> list[tuple[Statement, Any]]:
        """Return, for each state, a region and how far the mean of X' is from the middle of B."""
        chosen = dict(zip(self.plant.inputs, self.plant.policy, strict=False))
        further = () if self.plant.policy else self.plant.inputs
        found = []
        for state, move, center in zip(
            self.plant.states, self.step.moves, self.psi.center, strict=True
        ):
            away = sp.Abs(state - sp.Rational(center) + move.xreplace(chosen))
            found.append((self.region("the mean of X'", sp.Integer(0), further), away))
        return found

    @property
    def _own(self) -> dict[sp.Symbol, PolynomialPart]:
        return {self.value: self.polynomials[self.value]}


def _slope_across(psi: Polynomial, barrier: Any) -> Callable[[np.ndarray], np.ndarray]:
    """Return the function of states that gives the slope of psi with h on the edge next to them."""
    slopes = [sp.diff(barrier, s) for s in psi.states]
    values = compile_function(psi.states, [sp.N(e, 17) for e in (barrier, *slopes)], "arrays")
    gradient = [psi.derivative(i) for i in range(psi.n)]
    reach = _NEAR * float(min(psi.scale))

    def at(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        found = stacked(values(*np.ascontiguousarray(x.T)), len(x))
        h, slopes = found[:, 0], found[:, 1:]
        return h, slopes, (slopes**2).sum(axis=1) + 1e-300

    def slope(x: np.ndarray) -> np.ndarray:
        h, edge = at(x)[0], x
        # Two steps of Newton's method lead to the edge, where psi and h are near 0 together.
        for _ in range(2):
            level, slopes, square = at(edge)
            edge = edge - slopes * (level / square)[:, None]
        _, slopes, square = at(edge)
        across = sum(p.values(edge) * slopes[:, i] for i, p in enumerate(gradient)) / square
        # Below the edge no more than what keeps psi - l h below 0, and nothing farther away.
        with np.errstate(all="ignore"):
            across = np.where(h < 0.0, np.minimum(across, psi.values(x) / h), across)
        near = np.maximum(0.0, 1.0 - np.abs(h) / np.sqrt(square) / reach)
        return np.nan_to_num(near * np.maximum(across, 0.0), posinf=0.0)[:, None]

    return slope
