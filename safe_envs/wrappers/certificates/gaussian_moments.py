"""Moments of a Gaussian move, which may depend on a variable, and sums of Taylor's formula."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import sympy as sp

from safe_envs.dynamics.polynomial import Polynomial

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
