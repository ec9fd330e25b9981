"""What one step of an env does to a barrier psi: its expectation under a held input, exactly.

An env with noise advances by one step of Euler and Maruyama a control period dt,

    X' = x + d + s,   d = dt (f(x) + g(x) u),   s ~ N(0, v),   v = dt sigma(x) sigma(x)'.

For a polynomial psi, Taylor's formula about x ends, so that with multi-indices k

    E psi(X') = sum_k psi^(k)(x) M_k/k!,   M_k = E (d + s)^k,

a finite sum without an error. The moments follow from M_0 = 1 and Stein's identity
E s_i (d + s)^k = sum_j v_ij k_j E (d + s)^(k - e_j):

    M_(k + e_i) = d_i M_k + sum_j v_ij k_j M_(k - e_j).

Where v does not depend on the state, the noise is averaged once and for all: E psi(X') =
smoothed(x + d) with the polynomial smoothed = sum_j (1/2)^j (sum v_ab d_a d_b)^j psi/j!.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import Any

import sympy as sp

from safe_envs.dynamics.polynomial import Polynomial
from safe_envs.errors import ConfigurationError
from safe_envs.filters.certificates.certificate import Plant
from safe_envs.problem.problem import SafetyProblem

Order = tuple[int, ...]
SymbolOf = Callable[[Polynomial, Order], sp.Symbol]
"""Gives the symbol of a derivative of a polynomial."""
Series = list[Any]
"""Coefficients of a polynomial of one variable, the constant first."""


def moments_of(
    means: Sequence[Series], covariance: Sequence[Sequence[Any]]
) -> Callable[[Order], Series]:
    """Return the function of the moments M_k of a Gaussian move.

    Args:
        means: of its components.
        covariance: of its components.
    """
    known: dict[Order, Series] = {(0,) * len(means): [sp.Integer(1)]}

    def moment(k: Order) -> Series:
        if k not in known:
            i = next(i for i, e in enumerate(k) if e)
            lower = _less(k, i)
            found = times(means[i], moment(lower))
            for j, e in enumerate(lower):
                if e and covariance[i][j] != 0:
                    factor = covariance[i][j] * e
                    found = plus(found, [factor * part for part in moment(_less(lower, j))])
            known[k] = found
        return known[k]

    return moment


def taylor_sum(
    order: Order,
    base: Polynomial,
    axes: Sequence[tuple[Series, Any]],
    symbol_of: SymbolOf,
) -> Series:
    """Return the sum over k > 0 of base^(k) M_k/k! for independent axes, axis by axis.

    Args:
        order: exponents of the axes that are done.
        base: polynomial.
        axes: mean and variance of the move along each axis.
        symbol_of: gives the symbol of a derivative.
    """
    i = len(order)
    if i == len(axes):
        return [symbol_of(base, order) if any(order) else sp.Integer(0)]
    mean, variance = axes[i]
    inner = [
        taylor_sum((*order, k), base, axes, symbol_of) for k in range(base.degree - sum(order) + 1)
    ]
    found: Series = [sp.Integer(0)]
    if variance == 0:
        for k in range(len(inner) - 1, 0, -1):
            share = [part / k for part in mean]
            found = times(share, plus(inner[k], found))
        return plus(inner[0], found)
    # M_k/k! from the two before: M_(k + 1) = d M_k + v k M_(k - 1).
    last: Series = [sp.Integer(0)]
    moment: Series = [sp.Integer(1)]
    for k, part in enumerate(inner):
        found = plus(found, times(moment, part))
        following = plus(times(mean, moment), [variance * each for each in last])
        last, moment = moment, [each / (k + 1) for each in following]
    return found


def plus(a: Series, b: Series) -> Series:
    """Return the sum of two polynomials.

    Args:
        a: coefficients of one.
        b: of the other.
    """
    return [x + y for x, y in itertools.zip_longest(a, b, fillvalue=sp.Integer(0))]


def times(a: Series, b: Series) -> Series:
    """Return the product of two polynomials.

    Args:
        a: coefficients of one.
        b: of the other.
    """
    found: Series = [sp.Integer(0)] * (len(a) + len(b) - 1)
    for i, x in enumerate(a):
        for j, y in enumerate(b):
            found[i + j] += x * y
    return found


def _less(k: Order, i: int) -> Order:
    return (*k[:i], k[i] - 1, *k[i + 1 :])


def held_period(problem: SafetyProblem) -> Fraction:
    """Return the control period in s of an env whose step is the one of this module.

    Args:
        problem: of the env.

    Raises:
        ConfigurationError: A control period takes several steps, or one of Runge and Kutta.
    """
    if problem.substeps != 1:
        raise ConfigurationError(
            f"{problem.name} takes substeps = {problem.substeps} steps in a control period; a bound"
            " on its own step needs substeps = 1, with a smaller dt if need be"
        )
    if not problem.plant.noisy:
        raise ConfigurationError(
            f"{problem.name} has no noise, so that its step is one of Runge and Kutta; a bound on"
            " its own step needs noise"
        )
    return Fraction(repr(problem.dt))


@dataclass(frozen=True)
class HeldStep:
    """One step of a plant under an input that is held, as a polynomial psi sees it.

    Attributes:
        plant: the system.
        psi: of its states.
        period: control period dt in s.

    Raises:
        ConfigurationError: psi is of other states.
    """

    plant: Plant
    psi: Polynomial
    period: Fraction

    def __post_init__(self) -> None:
        if self.psi.states != self.plant.states:
            raise ConfigurationError(
                f"psi is a polynomial of {', '.join(map(str, self.psi.states))}; the system's"
                f" states are {', '.join(map(str, self.plant.states))}"
            )

    @cached_property
    def moves(self) -> tuple[sp.Expr, ...]:
        """The mean d of X' - x, expressions of the states and inputs."""
        dt, plant = sp.Rational(self.period), self.plant
        return tuple(
            dt * (f + sum(b * u for b, u in zip(row, plant.inputs, strict=True)))
            for f, row in zip(plant.drift, plant.input_matrix, strict=True)
        )

    @cached_property
    def covariance(self) -> tuple[tuple[sp.Expr, ...], ...]:
        """The covariance v of the noise of a step, expressions of the states."""
        dt, rows = sp.Rational(self.period), self.plant.diffusion
        return tuple(
            tuple(sp.expand(dt * sum(x * y for x, y in zip(a, b, strict=True))) for b in rows)
            for a in rows
        )

    @cached_property
    def smoothed(self) -> Polynomial | None:
        """The polynomial y -> E psi(y + s); None where the noise depends on the state."""
        if not all(entry.is_Rational for row in self.covariance for entry in row):
            return None
        v = [[Fraction(int(e.p), int(e.q)) for e in row] for row in self.covariance]  # type: ignore[attr-defined]
        found, term = dict(self.psi.coefficients), self.psi
        for j in itertools.count(1):
            # The j-th term from the one before: half of v applied to it, over j.
            halves = [
                (v[a][b] / (2 * j), term.derivative(a).derivative(b))
                for a, b in itertools.product(range(self.psi.n), repeat=2)
                if v[a][b]
            ]
            term = _with(self.psi, _sum(halves))
            if not any(term.coefficients.values()):
                return _with(self.psi, found)
            found = _sum([(Fraction(1), _with(self.psi, found)), (Fraction(1), term)])
        return None

    def expectation(self, inputs: Sequence[Any]) -> sp.Expr:
        """Return E psi(X') as an expression of the states.

        Args:
            inputs: that are held: numbers, symbols or expressions of the states.
        """
        held = dict(zip(self.plant.inputs, map(sp.sympify, inputs), strict=True))
        moved: Any = {
            x: x + d.xreplace(held) for x, d in zip(self.plant.states, self.moves, strict=True)
        }
        if self.smoothed is not None:
            known: Any = self.smoothed.expression
            return known.xreplace(moved)
        moments = moments_of([[sp.Integer(0)] for _ in moved], self.covariance)
        found: Any = sp.Integer(0)
        for order in self.orders:
            moment = moments(order)[0]
            if moment != 0:
                part: Any = derivative(self.psi, order).expression
                found += part.xreplace(moved) * moment / _factorial(order)
        return found

    def constraint(self, shortfall: Fraction) -> tuple[sp.Expr, sp.Expr]:
        """Return a and b of the constraint a u + b >= 0 that keeps psi from falling by more than m.

        With q(u) = E psi(F(x, u, xi)) it says that the chord of q between the bounds of the only
        input is at least psi - m. An end of the bounds meets it if any input does.

        Args:
            shortfall: m.

        Raises:
            ConfigurationError: There are several inputs.
        """
        self._require_one_input()
        ((low, high),) = self.plant.bounds
        at_low, at_high = self.expectation([low]), self.expectation([high])
        width = high - low
        level = self.psi.expression - sp.Rational(shortfall)
        return (at_high - at_low) / width, (high * at_low - low * at_high) / width - level

    def _require_one_input(self) -> None:
        if len(self.plant.inputs) != 1:
            raise ConfigurationError(
                f"the system has {len(self.plant.inputs)} inputs; a held bound for every input"
                " under a constraint is for one input. Give a policy"
            )

    @property
    def orders(self) -> list[Order]:
        """The multi-indices k up to the degree of psi."""
        degree, n = self.psi.degree, self.psi.n
        return [k for k in itertools.product(range(degree + 1), repeat=n) if sum(k) <= degree]

    def gain(self, inputs: Sequence[Any], symbol_of: SymbolOf) -> sp.Expr:
        """Return E psi(X') - psi(x), in symbols for derivatives of polynomials at x.

        Nothing large cancels in it: it is small where the step is.

        Args:
            inputs: that are held.
            symbol_of: gives the symbol of a derivative of a polynomial.
        """
        held = dict(zip(self.plant.inputs, map(sp.sympify, inputs), strict=True))
        return self._gain([[d.xreplace(held)] for d in self.moves], symbol_of)[0]

    def gain_by_input(self, symbol_of: SymbolOf) -> list[sp.Expr]:
        """Return c_0, c_1, ... of E psi(X') - psi(x) = sum_j c_j v^j for the only input.

        Here v is the input, scaled so that its bounds are -1 and 1.

        Args:
            symbol_of: gives the symbol of a derivative of a polynomial.

        Raises:
            ConfigurationError: There are several inputs.
        """
        self._require_one_input()
        (u,), ((low, high),) = self.plant.inputs, self.plant.bounds
        means: list[Series] = []
        for move, (effect,) in zip(self.moves, self.plant.input_matrix, strict=True):
            middle = move.xreplace({u: (low + high) / 2})
            slope = sp.Rational(self.period) * effect * (high - low) / 2
            means.append([middle] if slope == 0 else [middle, slope])
        return self._gain(means, symbol_of)

    def _gain(self, means: Sequence[Series], symbol_of: SymbolOf) -> Series:
        """Return the gain for moves that are polynomials of a variable."""
        origin = (0,) * self.psi.n
        base = self.psi if self.smoothed is None else self.smoothed
        found: Series = [sp.Integer(0)]
        if self.smoothed is not None:
            rest = _with(base, _sum([(Fraction(1), base), (Fraction(-1), self.psi)]))
            found = [symbol_of(rest, origin)]
        elif self._correlated:
            moments = moments_of(means, self.covariance)
            for k in self.orders:
                if k != origin:
                    factor = symbol_of(base, k) / _factorial(k)
                    found = plus(found, [factor * part for part in moments(k)])
            return found
        variances: list[Any] = [
            sp.Integer(0) if self.smoothed is not None else self.covariance[i][i]
            for i in range(self.psi.n)
        ]
        return plus(
            found, taylor_sum((), base, list(zip(means, variances, strict=True)), symbol_of)
        )

    @property
    def _correlated(self) -> bool:
        n = range(self.psi.n)
        return any(self.covariance[i][j] != 0 for i in n for j in n if i != j)


def derivative(polynomial: Polynomial, order: Order) -> Polynomial:
    """Return a derivative of a polynomial.

    Args:
        polynomial: whose derivative is taken.
        order: how often in each state.
    """
    for i, times in enumerate(order):
        for _ in range(times):
            polynomial = polynomial.derivative(i)
    return polynomial


def _sum(terms: Sequence[tuple[Fraction, Polynomial]]) -> dict[Order, Fraction]:
    found: dict[Order, Fraction] = {}
    for factor, polynomial in terms:
        for key, value in polynomial.coefficients.items():
            found[key] = found.get(key, Fraction(0)) + factor * value
    return found


def _with(like: Polynomial, coefficients: Mapping[Order, Fraction]) -> Polynomial:
    return Polynomial(like.states, like.center, like.scale, coefficients)


def _factorial(k: Order) -> int:
    return math.prod(map(math.factorial, k))
